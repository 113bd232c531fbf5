"""``dynssm calibrate``: the vehicle file, the figures for programs, and what the data do not say."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from dynssm_ros.identification.result.calibration import _ahead
from dynssm_ros.signals.extraction import extract
from dynssm_ros.signals.recording import Recording
from dynssm_ros.signals.signal_map import load_signal_map
from dynssm_ros.vehicle import COEFFICIENTS, load_vehicle
from dynssm_ros.vehicle.effects import EFFECTS

Run = Callable[..., tuple[int, str, str]]
Refused = Callable[..., str]
ONE_EULER_START = ("--starts", 1, "--integrator", "euler")  # is soon done


@pytest.fixture
def laps(laps_bag: Path, tmp_path: Path) -> Path:
    path = tmp_path / "laps.parquet"
    extract([laps_bag], load_signal_map("default"), 50.0).save(path)
    return path


def wrong_car(folder: Path, **bounds: tuple[float, float]) -> Path:
    """A vehicle file of the small car with mid-range values and other bounds."""
    car = load_vehicle("orca")
    content = car.with_nominal((car.lower + car.upper) / 2).model_dump(mode="json")
    for name, interval in bounds.items():
        content["coefficients"][name] |= {"bounds": list(interval), "nominal": sum(interval) / 2}
    for entry in content["coefficients"].values():
        entry["std"] = None
    path = folder / "wrong.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


def test_a_wrong_car_becomes_the_right_one(dynssm: Run, laps: Path, tmp_path: Path) -> None:
    car, out_json = tmp_path / "car.yaml", tmp_path / "car.json"
    arguments = ["--vehicle", wrong_car(tmp_path), *ONE_EULER_START, "--out", car, "--json", out_json]
    status, out, err = dynssm("calibrate", laps, *arguments)
    assert status == 0, err
    assert not [line for line in err.splitlines() if not line.startswith("calibrating:")]  # slow machines say how far
    found, truth = load_vehicle(car), load_vehicle("orca")
    np.testing.assert_allclose(found.nominal, truth.nominal, rtol=1e-3)
    assert f"{car} written" in out.replace("\n", "")
    assert "Calibrated on " in car.read_text().splitlines()[0]

    result = json.loads(out_json.read_text())
    assert list(result["coefficients"]) == list(COEFFICIENTS)
    assert result["coefficients"]["D_f"]["value"] == pytest.approx(truth.coefficients["D_f"].nominal, rel=1e-3)
    assert result["coefficients"]["D_f"]["unit"] == "N"
    assert max(result["rmse_after"].values()) < 1e-6 < min(result["rmse_before"].values())
    assert (result["on_bound"], result["unidentified"]) == ([], [])
    assert result["horizon_s"] == pytest.approx(0.52)
    assert 0 < result["rows"] < len(Recording.load(laps))


def test_a_car_that_predicts_worse_than_that_nothing_changes_is_written_by_force_alone(
    dynssm: Run, laps: Path, tmp_path: Path
) -> None:
    """As with a steering whose sign is wrong."""
    recording, car = Recording.load(laps).select(slice(0, 500)), tmp_path / "car.yaml"
    turned = {name: -recording[name] for name in ("delta_fb", "delta_cmd")}
    replace(recording, columns=recording.columns | turned).save(laps)
    arguments = ["calibrate", laps, "--vehicle", "orca", *ONE_EULER_START, "--holdout", 0.2, "--out", car]
    status, _, err = dynssm(*arguments)
    (line,) = [line for line in err.splitlines() if line.startswith("error: ")]
    assert (status, car.exists()) == (1, False)
    assert re.search(r"s ahead .* omega [\d.]+ against [\d.]+ rad/s\).* sign, unit and time", line)
    status, _, err = dynssm(*arguments, "--force")
    assert (status, car.exists()) == (0, True)
    assert line.removeprefix("error: ").split(";")[0] in err
    assert load_vehicle(car).held_out == {recording.beginning: 0.2}


@pytest.mark.parametrize("command", [("calibrate",), ("train", "--model", "ridge")])
@pytest.mark.parametrize("still", ["exactly", "noise", "creeps", "a glitch"])
def test_of_a_log_in_which_the_car_stands_nothing_is_written(
    dynssm: Run, laps: Path, tmp_path: Path, still: str, command: tuple[str, ...]
) -> None:
    """Somebody turns the wheel in the pit, and sensors have noise, an offset or a jump."""
    recording = Recording.load(laps)
    rng, N = np.random.default_rng(0), len(recording)
    velocity = {name: np.zeros(N) for name in ("v_x", "v_y", "omega")}
    if still != "exactly":
        velocity = {name: 0.03 * rng.standard_normal(N) for name in velocity}
        velocity["v_x"] += {"noise": 0.0, "creeps": 0.05, "a glitch": 4.0 * (np.arange(N) == 100)}[still]
    replace(recording, columns=recording.columns | velocity).save(laps)
    status, _, err = dynssm(*command, laps, "--vehicle", "orca", "--out", tmp_path / "out")
    (line,) = [line for line in err.splitlines() if line.startswith("error: ")]
    assert (status, (tmp_path / "out").exists()) == (1, False)
    assert re.search(r"the car stands: .* expected a drive, 0.097 m/s or more; --force writes it all the same", line)


def test_errors_are_compared_with_those_of_nothing_state_by_state() -> None:
    """Changes by 1, 2 and 4; errors of a half, a quarter and twice as much."""
    windows = SimpleNamespace(
        target=np.array([[[0.0, 0, 0], [1, 2, 4]]] * 3),
        starts=np.arange(3),
        data=SimpleNamespace(rows=np.zeros((7, 3))),
    )
    errors = np.array([[[9.0, 9, 9], [0.5, 0.5, 8]]] * 3)
    np.testing.assert_allclose(_ahead(windows, errors), [[0.5, 0.5, 8], [1, 2, 4]])  # type: ignore[arg-type]


def test_a_coefficient_on_its_bound_is_told_and_marked(dynssm: Run, laps: Path, tmp_path: Path) -> None:
    car = wrong_car(tmp_path, I_z=(4e-5, 5e-5))
    status, out, _ = dynssm(
        "calibrate", laps, "--vehicle", car, "--starts", 1, "--integrator", "euler", "--out", tmp_path / "car.yaml"
    )
    assert status == 0
    line = next(line for line in out.splitlines() if line.startswith("on a bound: "))
    assert "I_z" in line
    assert line.endswith(" - the data want more than the vehicle file admits")
    assert "I_z *" in out


def test_a_straight_drive_says_what_it_cannot_determine(dynssm: Run, laps: Path, tmp_path: Path) -> None:
    recording = Recording.load(laps)
    rng, N, T_s = np.random.default_rng(0), len(recording), recording.T_s
    columns = {name: np.zeros(N) for name in recording.columns}
    columns["r_fb"] = 0.4 + 0.1 * np.sin(0.7 * np.arange(N) * T_s)
    columns["v_x"][0] = 1.5
    for k in range(N - 1):
        v_x, r = columns["v_x"][k], columns["r_fb"][k]
        force = (0.287 - 0.0545 * v_x) * r - 0.0518 - 0.00035 * v_x**2
        columns["v_x"][k + 1] = v_x + T_s * force / 0.041 + 1e-4 * rng.standard_normal()
    columns["v_y"], columns["omega"] = 1e-4 * rng.standard_normal(N), 1e-3 * rng.standard_normal(N)
    straight = tmp_path / "straight.parquet"
    Recording(recording.info, recording.time, recording.segment, columns).save(straight)
    quick = ("--starts", 1, "--integrator", "euler")
    status, out, _ = dynssm("calibrate", straight, "--vehicle", "orca", *quick, "--out", tmp_path / "car.yaml")
    assert status == 0
    open_lines = [line for line in out.splitlines() if line.startswith("not determined by these data: ")]
    assert len(open_lines) >= 4
    assert all(line.endswith("(in units of what was known before)") for line in open_lines)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--vehicle", "av21"], "sampling time 0.02 s, but vehicle av21 has 0.04 s; extract with --rate 25"),
        (["--vehicle", "orca", "--min-speed", "90"], "0 stretches of 0.1 s at 90 m/s or more"),
        (["--vehicle", "gone"], "'gone' is neither a file nor a shipped name"),
    ],
)
def test_what_does_not_fit_is_one_line_and_leaves_nothing(
    refused: Refused, laps: Path, tmp_path: Path, options: list[str], words: str
) -> None:
    line = refused("calibrate", laps, *options, "--out", tmp_path / "car.yaml")
    assert words in line
    assert [path.name for path in tmp_path.iterdir()] == ["laps.parquet"]


@pytest.mark.parametrize(
    "command",
    ["train", *(pytest.param(each, marks=pytest.mark.slow) for each in ("calibrate", "evaluate", "diagnose"))],
)
def test_rows_that_the_car_cannot_have_driven_are_named_in_a_line(
    dynssm: Run, laps: Path, tmp_path: Path, command
) -> None:
    recording = Recording.load(laps)
    omega = np.where(np.arange(len(recording)) == 40, 500.0, recording["omega"])
    replace(recording, columns=recording.columns | {"omega": omega}).save(laps)
    tiny = tmp_path / "tiny.yaml"
    tiny.write_text("base: dynssm_paper_orca\nname: tiny\nphysics: {nominal: vehicle}\nresidual: null\n")
    quick = {
        "calibrate": ("--starts", 1, "--integrator", "euler"),
        "train": ("--model", tiny, "--epochs", 1),
        "evaluate": ("--model", "persistence", "--model", "single_track"),
        "diagnose": (
            "--integrator",
            "euler",
            *(word for name in EFFECTS if name != "drag" for word in ("--exclude", name)),
        ),
    }[command]
    status, _, words = dynssm(command, laps, "--vehicle", "orca", *quick, "--out", tmp_path / "out.yaml")
    assert status == 0, words
    warned = [line for line in words.splitlines() if line.startswith("warning: ")]
    assert len(warned) == 1
    assert "row 40 at 0.80 s: omega = 500; expected" in warned[0]
