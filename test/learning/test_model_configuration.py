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
from dynssm_ros.learning.models.registry import MODELS, load_model_config

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


def test_what_version_0_3_wrote_of_laps_that_are_not_mirrored_is_read(tmp_path: Path) -> None:
    written = write(tmp_path, "a", {"base": "dynssm", "training": {"augmentation": {"mirror": False}}})
    assert load_model_config(written) == load_model_config("dynssm")


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
        ({"dense": {"layers": 2, "width": 4}}, "dense: Extra inputs are not permitted"),
        ({"training": {"augmentation": {"mirror": True}}}, "augmentation: this version does not mirror laps"),
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


def test_of_an_unknown_kind_all_known_ones_are_named(tmp_path: Path) -> None:
    path = write(tmp_path, "bad", {"base": "dynssm", "kind": "transformer"})
    known = ", ".join(sorted(MODELS))  # now: the kinds of plugins that other tests have loaded are among them
    with pytest.raises(ConfigurationError, match=re.escape(f"{path}: kind: 'transformer'; expected one of {known}")):
        load_model_config(path)


def test_a_configuration_cannot_be_changed_behind_a_model(make_config: Any) -> None:
    config = make_config()
    with pytest.raises(ValidationError, match="frozen"):
        config.history = 3.0
