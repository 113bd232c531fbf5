"""From a bag to a model and its predictions by the commands alone, as the README has it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml

from dynssm_ros.runtime.artifact import open_artifact
from dynssm_ros.signals.bags import open_bag
from dynssm_ros.signals.recording import Recording
from dynssm_ros.vehicle import load_vehicle

ONE_EULER_START = ("--starts", 1, "--integrator", "euler")  # is soon done


def test_the_commands_lead_from_a_bag_to_predictions(dynssm, laps_bag: Path, tiny_model: Path, tmp_path: Path) -> None:
    laps, car, model = tmp_path / "laps.parquet", tmp_path / "car.yaml", tmp_path / "model"
    standard = tmp_path / "standard"
    assert dynssm("extract", laps_bag, "--signals", "default", "--rate", 50, "--out", laps, "--bag", standard)[0] == 0
    with open_bag(standard) as bag:
        assert set(bag.types) == {"/vehicle/odometry", "/vehicle/actuator_feedback", "/vehicle/actuator_command"}

    status, out, _ = dynssm(
        "calibrate", laps, "--vehicle", "orca", *ONE_EULER_START, "--out", car, "--json", tmp_path / "car.json"
    )
    assert status == 0
    assert "one-step RMSE v_x" in out
    assert load_vehicle(car).coefficients["D_f"].std is not None
    assert json.loads((tmp_path / "car.json").read_text())["coefficients"]["I_z"]["unit"] == "kg m^2"

    status, out, _ = dynssm(
        "train",
        laps,
        "--model",
        tmp_path / "tiny.yaml",
        "--vehicle",
        car,
        "--holdout",
        0.2,
        "--seed",
        3,
        "--out",
        model,
    )
    assert status == 0
    assert "seed 3" in out
    card = open_artifact(model).card
    assert (card.name, card.window, card.training["seed"], card.training["holdout"]) == ("tiny", 4, 3, 0.2)
    assert (model / "losses.png").stat().st_size > 1000
    assert not list(tmp_path.glob("*checkpoint*"))

    arguments = ["--model", model, "--model", "single_track", "--model", "persistence", "--vehicle", car]
    status, out, _ = dynssm(
        "evaluate", laps, *arguments, "--holdout", 0.2, "--out", tmp_path / "e", "--json", tmp_path / "e.json"
    )
    assert status == 0
    result = json.loads((tmp_path / "e.json").read_text())
    assert set(result["models"]) == {"tiny", "single_track", "persistence"}
    assert result["models"]["single_track"]["rmse"]["omega"] < 1e-6
    assert result["commands"] == "topics"

    status, out, _ = dynssm("replay", laps_bag, "--model", model, "--out", tmp_path / "replayed")
    assert status == 0
    assert f"{len(Recording.load(laps)) - 3} predictions" in out


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"vehicle": "av21"}, "sampling time 0.02 s, but vehicle av21 has 0.04 s"),
        ({"model": "gpt", "commands": "topics"}, "neither a file nor a shipped name"),
        ({"commands": "topics", "recording": "gone.parquet"}, "no such recording"),
    ],
)
def test_what_does_not_fit_is_one_line_and_leaves_nothing(
    dynssm, refused, laps_bag: Path, tmp_path: Path, changes: dict[str, str], words: str
) -> None:
    laps = tmp_path / "laps.parquet"
    assert dynssm("extract", laps_bag, "--signals", "default", "--rate", 50, "--out", laps)[0] == 0
    given = {"recording": str(laps), "model": "ridge", "vehicle": "orca"} | changes
    recording = given.pop("recording")
    options = [part for name, value in given.items() for part in (f"--{name}", value)]
    line = refused("train", recording, *options, "--out", tmp_path / "model")
    assert any(word in line for word in words.split("|"))
    assert [path.name for path in tmp_path.iterdir()] == ["laps.parquet"]


def test_a_model_file_with_a_wrong_field_names_it(dynssm, refused, laps_bag: Path, tmp_path: Path) -> None:
    laps, model = tmp_path / "laps.parquet", tmp_path / "model.yaml"
    dynssm("extract", laps_bag, "--signals", "default", "--rate", 50, "--out", laps)
    model.write_text(yaml.safe_dump({"base": "dynssm", "name": "x", "gru": {"hidden": -1}}))
    line = refused("train", laps, "--model", model, "--vehicle", "orca", "--out", tmp_path / "m")
    assert "model.yaml: gru.hidden" in line
    assert "-1" in line
