"""The rivals as plugins: their files by name, what is refused, and one command after the other with one of them."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml

import benchmarks.rivals
from dynssm_ros.errors import ConfigurationError
from dynssm_ros.learning.export import TOLERANCE, load_torch, save_artifact
from dynssm_ros.learning.models.base import ModelConfig
from dynssm_ros.learning.models.registry import build_model, load_model_config
from dynssm_ros.learning.stages import train
from dynssm_ros.runtime.artifact import Normalisation
from dynssm_ros.runtime.onnx_model import OnnxModel
from dynssm_ros.signals.recording import Recording
from dynssm_ros.vehicle import Vehicle, load_vehicle

MakeConfig = Callable[..., ModelConfig]
FOLDER = Path(benchmarks.rivals.__file__).parent
UNIT = Normalisation(input_mean=(0.0,) * 7, input_std=(1.0,) * 7, state_scale=(1.0,) * 3, increment_scale=(1.0,) * 3)


def write(folder: Path, name: str, content: dict[str, Any]) -> Path:
    path = folder / f"{name}.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


@pytest.mark.parametrize("name", sorted(path.stem for path in FOLDER.glob("*.yaml")))
def test_every_file_is_found_by_its_name_and_its_model_can_be_built(name: str) -> None:
    config = load_model_config(name)
    assert config.name == name
    output = build_model(config, load_vehicle("orca"), UNIT)(torch.ones(2, config.rows(0.02), 7))
    assert output.increment.shape == (2, 3)


@pytest.mark.parametrize("kind", ["ddm", "fthd"])
def test_the_deployed_graph_is_the_trained_model(
    make_ddm: MakeConfig, make_fthd: MakeConfig, laps: Recording, orca: Vehicle, tmp_path: Path, kind: str
) -> None:
    config = {"ddm": make_ddm, "fthd": make_fthd}[kind]().with_training(epochs=2, learning_rate=0.03)
    trained = train(laps, config, orca, tmp_path / "c.pt")
    artifact = save_artifact(trained, tmp_path / "model")
    loaded = load_torch(artifact)
    for name, value in trained.model.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], value), name
    windows = laps.windows(np.linspace(4, len(laps) - 2, 7).astype(int), 4)
    with torch.no_grad():
        expected = trained.model(torch.tensor(windows, dtype=torch.float32))
    found = OnnxModel(artifact).predict(windows)
    width = trained.vehicle.upper - trained.vehicle.lower
    moved = (found.state - windows[:, -1, :3] - expected.increment.numpy()) / trained.normalisation.state_scale
    assert np.abs(moved).max() < TOLERANCE
    assert np.abs((found.theta - expected.theta.numpy()) / width).max() < TOLERANCE
    gru, dense = 4 * ((7 + 3) * 9 + (3 + 3) * 9), 4 * 3 * 6 + 6 * 6 + 6 * 17
    assert artifact.card.flops == 2 * (gru + dense)  # of its matrix products
    assert artifact.card.parameters == gru // 4 + 4 * 9 + dense + 6 + 6 + 17  # frozen or not


@pytest.mark.slow
def test_a_rival_is_trained_by_the_plugin_evaluated_replayed_and_raced(
    dynssm: Callable[..., tuple[int, str, str]], laps: Recording, laps_bag: Path, tmp_path: Path
) -> None:
    """Training is a process of its own, to which the environment names the plugin; the exported model needs none."""
    sizes = {"history": 0.08, "gru": {"hidden": 3, "layers": 2}, "dense": {"layers": 1, "width": 16}}
    tiny = {"base": "ddm_orca", "name": "tiny", "loss": {"scale": "increment"}} | sizes
    rates = {"epochs": 15, "learning_rate": 0.01, "batch_size": 64}
    config, log, model = (
        write(tmp_path, "tiny", tiny | {"training": rates}),
        tmp_path / "laps.parquet",
        tmp_path / "model",
    )
    laps.save(log)
    words = ["train", log, "--model", config, "--vehicle", "orca", "--out", model]
    program = [str(Path(sys.executable).with_name("dynssm")), *map(str, words)]
    trainings = [
        subprocess.run(
            program, capture_output=True, text=True, check=False, cwd=FOLDER.parents[1], env=os.environ | more
        )
        for more in ({"DYNSSM_PLUGINS": ""}, {"DYNSSM_PLUGINS": "benchmarks.rivals"})
    ]
    assert [done.returncode for done in trainings] == [1, 0], trainings
    assert "'ddm_orca' is neither a file nor a shipped name" in trainings[0].stderr
    for words in (
        ["evaluate", log, "--model", model, "--stride", "50", "--out", tmp_path / "evaluation"],
        ["replay", laps_bag, "--model", model, "--out", tmp_path / "replay"],
        ["race", "--vehicle", "orca", "--track", "club", "--model", model, "--plant", "euler", "--speed-scale", "0.6",
         "--out", tmp_path / "race"],
    ):  # fmt: skip
        status, _, err = dynssm(*words)
        assert status == 0, err
    scores = json.loads((tmp_path / "evaluation" / "results.json").read_text())["models"]
    assert scores["tiny"]["rmse"]["v_x"] > 0
    races = json.loads((tmp_path / "race" / "results.json").read_text())["models"]
    assert races["tiny"]["completed"]


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
