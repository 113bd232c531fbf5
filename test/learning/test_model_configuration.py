"""Model files: the shipped ones, `base:`, and what is refused."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from pydantic import ValidationError

from dynssm_ros.configuration import config_root
from dynssm_ros.errors import ConfigurationError
from dynssm_ros.learning.models.registry import load_model_config

SHIPPED = sorted(path.stem for path in (config_root() / "models").glob("*.yaml"))


@pytest.mark.parametrize("name", SHIPPED)
def test_every_shipped_file_is_valid_and_carries_its_own_name(name: str) -> None:
    assert load_model_config(name).name == name


def write(folder: Path, name: str, content: dict[str, Any]) -> Path:
    path = folder / f"{name}.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


def test_base_gives_what_a_file_leaves_out_block_by_block(tmp_path: Path) -> None:
    write(tmp_path, "middle", {"base": "dynssm", "history": 2.0, "training": {"epochs": 7}})
    config = load_model_config(write(tmp_path, "leaf", {"base": "middle", "name": "leaf", "ssm": None}))
    shipped = load_model_config("dynssm")
    assert (config.name, config.history, config.ssm) == ("leaf", 2.0, None)
    assert config.training == shipped.training.model_copy(update={"epochs": 7})
    assert config.gru == shipped.gru


def test_files_that_refer_to_each_other_in_a_circle_are_refused(tmp_path: Path) -> None:
    write(tmp_path, "a", {"base": "b"})
    with pytest.raises(ConfigurationError, match="circle"):
        load_model_config(write(tmp_path, "b", {"base": "a"}))


def test_a_base_that_does_not_exist_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="'nowhere' is neither a file nor a shipped name"):
        load_model_config(write(tmp_path, "a", {"base": "nowhere", "name": "a"}))


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"ssm": None, "gru": None}, "at least one encoder is needed: ssm or gru"),
        ({"fusion": None}, "fusion: Input should be"),
        ({"loss": None}, "loss: Input should be"),
        ({"physics": None}, "inputs.physics_errors and innovation need physics"),
        (
            {"physics": None, "residual": None, "innovation": None, "inputs": {"physics_errors": False}},
            "without physics there must be a residual network",
        ),
        ({"residual": None}, "nothing to learn"),
        (
            {"adaptation": {"hidden": 4, "alpha": 1.5}},
            "adaptation.alpha: Input should be less than or equal to 1 (got 1.5)",
        ),
        ({"base": "dynssm_paper_av21", "physics": None}, "adaptation needs physics to adapt"),
        ({"history": 0}, "history: Input should be greater than 0 (got 0)"),
        ({"gru": {"width": 3}}, "gru.width: Extra inputs are not permitted (got 3)"),
        ({"residual": {"hidden": []}}, "residual.hidden"),
        ({"training": {"validation_every": 1}}, "training.validation_every"),
        ({"loss": {"scale": "state"}}, "loss.scale: Input should be 'target', 'increment' or 'none' (got 'state')"),
        (
            {"kind": "transformer"},
            "kind: 'transformer'; expected one of ddm, dynssm, ekf_fthd, fthd, gp, on_track, ridge, rls",
        ),
        ({"dense": {"layers": 2, "width": 4}}, "dense: Extra inputs are not permitted"),
    ],
)
def test_what_does_not_fit_is_refused_with_field_and_value(
    tmp_path: Path, changes: dict[str, Any], expected: str
) -> None:
    path = write(tmp_path, "bad", {"base": "dynssm", **changes})
    with pytest.raises(ConfigurationError, match=re.escape(expected)) as refused:
        load_model_config(path)
    assert str(path) in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("base", "changes", "expected"),
    [
        ("ddm_av21", {"dense": None}, "dense: Input should be"),
        ("ddm_av21", {"residual": {"hidden": [8], "scale": 1.0}}, "residual: Extra inputs are not permitted"),
        ("ddm_av21", {"innovation": {"history": 0.06}}, "innovation: Extra inputs are not permitted"),
        (
            "ddm_av21",
            {"fine_tuning": {"starts_from": "ddm_av21", "frozen": 0.5, "physics": 0.1}},
            "fine_tuning: Extra inputs are not permitted",
        ),
        ("ddm_av21", {"training": {"validation": "none"}}, "training.validation: Input should be 'blocks' or 'random'"),
        ("fthd_av21", {"fine_tuning": None}, "fine_tuning: Input should be"),
        (
            "fthd_av21",
            {"fine_tuning": {"starts_from": "ridge"}},
            "fine_tuning.starts_from.kind: Input should be 'ddm', 'fthd' or 'ekf_fthd' (got 'ridge')",
        ),
        ("fthd_av21", {"fine_tuning": {"starts_from": "ddm_mars"}}, "'ddm_mars' is neither a file nor a shipped name"),
        ("fthd_av21", {"fine_tuning": {"starts_from": "fthd_av21"}}, "fine_tuning.starts_from"),
        ("fthd_av21", {"fine_tuning": {"frozen": 1.0}}, "fine_tuning.frozen: Input should be less than 1 (got 1.0)"),
        (
            "fthd_av21",
            {"dense": {"width": 9}},
            "dense: differs from that of fthd_av21_ddm, which fine_tuning starts from",
        ),
        ("fthd_av21", {"training": {"seed": 3}}, "seed: differs from that of fthd_av21_ddm"),
    ],
)
def test_what_does_not_fit_a_rival_is_refused(
    tmp_path: Path, base: str, changes: dict[str, Any], expected: str
) -> None:
    with pytest.raises(ConfigurationError, match=re.escape(expected)) as refused:
        load_model_config(write(tmp_path, "bad", {"base": base, **changes}))
    assert "\n" not in str(refused.value)


def test_the_model_that_fine_tuning_starts_from_is_read_with_it(tmp_path: Path) -> None:
    write(tmp_path, "ddm_own", {"base": "fthd_av21_ddm", "name": "ddm_own", "training": {"epochs": 7}})
    settings = {"fine_tuning": {"starts_from": "ddm_own"}, "training": {"epochs": 3}}
    config = load_model_config(write(tmp_path, "own", {"base": "fthd_av21", **settings}))
    assert config.fine_tuning is not None
    assert config.fine_tuning.starts_from == load_model_config(tmp_path / "ddm_own.yaml")
    assert (config.training.epochs, config.fine_tuning.starts_from.training.epochs) == (3, 7)


def test_other_training_settings_hold_in_all_stages() -> None:
    shipped = load_model_config("fthd_av21")
    config = shipped.with_training(seed=5)
    assert config.fine_tuning is not None
    assert config.training.seed == config.fine_tuning.starts_from.training.seed == 5
    assert config.with_training(seed=0) == shipped
    assert config.training.epochs == shipped.training.epochs


def test_a_configuration_cannot_be_changed_behind_a_model(make_config: Any) -> None:
    config = make_config()
    with pytest.raises(ValidationError, match="frozen"):
        config.history = 3.0
