"""``dynssm train`` beyond the straight way: interruptions, what is in the way, what is not there."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

import benchmarks.rivals  # noqa: F401 - one is fine-tuned
from dynssm_ros.learning import optimisation as training
from dynssm_ros.learning import stages
from dynssm_ros.runtime.artifact import open_artifact
from dynssm_ros.signals.extraction import extract
from dynssm_ros.signals.recording import Recording
from dynssm_ros.signals.signal_map import load_signal_map
from dynssm_ros.vehicle import Vehicle, load_vehicle, save_vehicle

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def arguments(laps_bag: Path, tiny_model: Path, tmp_path: Path) -> list[str]:
    """A training of four epochs on the simulated laps."""
    extract([laps_bag], load_signal_map("default"), 50.0).save(tmp_path / "laps.parquet")
    model = ["--model", str(tiny_model), "--vehicle", "orca", "--out", str(tmp_path / "model")]
    return ["train", str(tmp_path / "laps.parquet"), *model]


@pytest.mark.slow
def test_an_interrupted_training_says_how_to_go_on_and_does(
    dynssm: Run, arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    validate, epochs = training.Optimisation._validate, [0]

    def interrupted(self: training.Optimisation) -> dict[str, float]:
        epochs[0] += 1
        if epochs[0] == 4:  # the first is of the untrained model
            raise KeyboardInterrupt
        return validate(self)

    with monkeypatch.context() as patched:
        patched.setattr(training.Optimisation, "_validate", interrupted)
        status, _, err = dynssm(*arguments)
    assert status == 130
    assert err.split("\n")[-2] == "interrupted; the same command continues from model.checkpoint.pt"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["laps.parquet", "model.checkpoint.pt", "tiny.yaml"]

    status, out, _ = dynssm(*arguments)
    assert status == 0
    assert "continued from epoch 2" in out
    resumed = (tmp_path / "model" / "weights.safetensors").read_bytes()
    status, out, _ = dynssm(*arguments)
    assert "continued" not in out
    assert (tmp_path / "model" / "weights.safetensors").read_bytes() == resumed
    assert len(json.loads((tmp_path / "model" / "metrics.json").read_text())["history"]["train/prediction"]) == 4


def test_a_training_that_came_to_nothing_says_so_and_leaves_what_shows_why(
    dynssm: Run, arguments: list[str], tmp_path: Path, tiny_model: Path
) -> None:
    tiny_model.write_text(tiny_model.read_text().replace("nominal: vehicle", "nominal: mid_range"))
    status, _, err = dynssm(*arguments, "--epochs", "1")
    assert status == 1
    assert "error: model tiny: the training failed" in err
    assert (tmp_path / "model" / "losses.png").is_file()


@pytest.mark.slow
def test_fine_tuning_takes_one_command_and_goes_on_in_the_stage_where_it_was(
    dynssm: Run, arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "tiny_ddm.yaml").write_text("{base: fthd_orca_ddm, name: tiny_ddm, dense: {layers: 2, width: 8}}")
    (tmp_path / "tiny.yaml").write_text(
        "{base: fthd_orca, name: tiny, dense: {layers: 2, width: 8}, fine_tuning: {starts_from: tiny_ddm}}"
    )
    train_epoch, epochs = training.Optimisation._epoch, [0]

    def interrupted(self: training.Optimisation) -> dict[str, float]:
        epochs[0] += 1
        if epochs[0] in (2, 5):  # in the first stage, and in the second
            raise KeyboardInterrupt
        return train_epoch(self)

    monkeypatch.setattr(training.Optimisation, "_epoch", interrupted)
    for kept in ("model.checkpoint.start.pt", "model.checkpoint.pt"):
        status, _, err = dynssm(*arguments, "--epochs", 2, "--seed", 7)
        assert status == 130
        assert err.split("\n")[-2] == f"interrupted; the same command continues from {kept}"
    status, out, err = dynssm(*arguments, "--epochs", 2, "--seed", 7)
    assert status == 1
    assert "the training failed" in err, "so few epochs come to nothing"
    assert "continued from epoch 3" in out
    assert not list(tmp_path.glob("*.pt"))
    card = open_artifact(tmp_path / "model").card
    assert card.kind == "fthd"
    stages = (card.architecture, card.architecture["fine_tuning"]["starts_from"])
    assert [(each["training"]["seed"], each["training"]["epochs"]) for each in stages] == [(7, 2), (7, 2)]


def test_seed_epochs_and_commands_of_the_command_line_win(dynssm: Run, arguments: list[str], tmp_path: Path) -> None:
    status, out, _ = dynssm(*arguments, "--epochs", 1, "--seed", 9, "--commands", "none")
    assert status == 0
    assert "(commands: none)" in out
    card = open_artifact(tmp_path / "model").card
    assert card.commands == "none"
    assert (card.architecture["training"]["seed"], card.architecture["training"]["epochs"]) == (9, 1)


def test_a_folder_that_is_no_model_is_refused_before_a_training_is_spent_on_it(
    dynssm: Run, arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stages, "train", None)
    (tmp_path / "model").mkdir()
    (tmp_path / "model" / "thesis.tex").touch()
    status, _, err = dynssm(*arguments)
    assert status == 1
    assert err.strip() == f"error: {tmp_path / 'model'}: exists and is not a model folder; not replaced"
    assert [path.name for path in (tmp_path / "model").iterdir()] == ["thesis.tex"]


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_device_that_is_not_there_is_refused(refused: Callable[..., str], arguments: list[str]) -> None:
    assert refused(*arguments, "--device", "cuda") == "error: --device cuda: not available here; expected cpu"


@pytest.mark.slow
def test_the_present_folder_can_hold_the_model(
    dynssm: Run, arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert dynssm(*arguments, "--epochs", 1)[0] == 0
    monkeypatch.chdir(tmp_path / "model")
    assert dynssm(*arguments[:-1], ".", "--epochs", 1, "--seed", 5)[0] == 0
    assert open_artifact(tmp_path / "model").card.training["seed"] == 5


@pytest.mark.slow
def test_without_a_terminal_there_is_no_progress_bar(arguments: list[str]) -> None:
    """A line every ten seconds, as a slow machine may need."""
    command = [sys.executable, "-m", "dynssm_ros.cli.main", *arguments, "--epochs", "1"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0
    assert all(re.fullmatch(r"training: \d+ % [^\r\x1b]*", line) for line in done.stderr.split("\n")[:-1]), done.stderr
    assert "parameters, best epoch 0, seed 0; one-step RMSE on" in done.stdout


def test_a_car_that_was_calibrated_on_these_laps_is_not_calibrated_again(
    dynssm: Run, laps_bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is on others."""
    laps = tmp_path / "laps.parquet"
    extract([laps_bag], load_signal_map("default"), 50.0).save(laps)
    asked: list[int] = []

    def calibrated(recording: Recording, car: Vehicle, **_: object) -> SimpleNamespace:
        asked.append(len(recording))
        return SimpleNamespace(vehicle=car, tells_nothing_of=[])

    monkeypatch.setattr("dynssm_ros.identification.result.calibration.calibrate", calibrated)
    recording, car = Recording.load(laps), load_vehicle("orca")
    save_vehicle(car.calibrated_on(recording.fingerprints, car), tmp_path / "car.yaml")
    for vehicle in (tmp_path / "car.yaml", "orca"):
        status, _, words = dynssm("train", laps, "--model", "rls", "--vehicle", vehicle, "--out", tmp_path / "model")
        assert status == 0, words
        assert len(asked) == (vehicle == "orca")
