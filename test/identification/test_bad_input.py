"""What cannot be diagnosed is one clear line; what can only be diagnosed in part says which part."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from dynssm_ros.errors import ConfigurationError, RecordingError
from dynssm_ros.identification.problem.recordings import _cut
from dynssm_ros.identification.result.diagnose import _check_signals, _not_judged, _not_live, diagnose
from dynssm_ros.identification.result.diagnosis import Diagnosis
from dynssm_ros.signals.recording import Recording
from dynssm_ros.vehicle import Vehicle, load_vehicle, save_vehicle
from dynssm_ros.vehicle.effects import EFFECTS

Lagging = tuple[Recording, Vehicle, Diagnosis]


def one_line(raised: pytest.ExceptionInfo[Exception]) -> str:
    words = str(raised.value)
    assert "\n" not in words
    return words


@pytest.mark.parametrize("name", ["v_x", "v_y", "omega"])
def test_a_state_that_never_changes_is_refused(name: str, lagging: Lagging) -> None:
    recording, vehicle, _ = lagging
    dead = replace(recording, columns=recording.columns | {name: np.full(len(recording), 7.0)})
    with pytest.raises(RecordingError) as raised:
        diagnose(dead, vehicle)
    assert f"{name} is constant at 7; expected a measured channel" in one_line(raised)


@pytest.mark.parametrize(("column", "words"), [("r_fb", "throttle is constant"), ("delta_fb", "steering is constant")])
def test_an_input_that_never_changes_limits_the_diagnosis(column: str, words: str, lagging: Lagging) -> None:
    recording, _, _ = lagging
    N = len(recording)
    fixed = {column: np.full(N, 0.1), column.replace("fb", "cmd"): np.zeros(N)}
    (note,) = _check_signals(replace(recording, columns=recording.columns | fixed))
    assert note.startswith(words)


def test_a_missing_channel_is_refused_when_the_recording_is_read(lagging: Lagging, tmp_path: Path) -> None:
    recording, _, _ = lagging
    lacking = {name: values for name, values in recording.columns.items() if name != "v_y"}
    replace(recording, columns=lacking).save(tmp_path / "laps.parquet")
    with pytest.raises(RecordingError) as raised:
        Recording.load(tmp_path / "laps.parquet")
    assert "column v_y is missing" in one_line(raised)


@pytest.mark.parametrize("constant", ["m", "l_f", "h_cg", "F_z0"])
def test_a_vehicle_file_without_a_constant_is_refused_when_it_is_read(constant: str, tmp_path: Path) -> None:
    path = tmp_path / "car.yaml"
    save_vehicle(load_vehicle("av21"), path, "whole")
    content = yaml.safe_load(path.read_text())
    del content["constants"][constant]
    path.write_text(yaml.safe_dump(content))
    with pytest.raises(ConfigurationError) as raised:
        load_vehicle(path)
    assert f"constants.{constant}" in one_line(raised)


def test_too_few_laps_hold_out_a_block_at_the_end_and_say_so(lagging: Lagging) -> None:
    recording, _, found = lagging
    cut, words = _cut(recording.select(slice(0, 1000)), 0.25)
    assert (cut, words) == (750, "the last 25 % as one block (fewer than 3 laps)")
    assert "as one block" in found.protocol["Held out"]


def test_whole_laps_are_held_out_where_there_are_three(lagging: Lagging) -> None:
    recording, _, _ = lagging
    N, per_lap = 1000, 220
    angle = 2 * np.pi * np.arange(N) / per_lap
    circle = {"x": 50 * np.cos(angle), "y": 50 * np.sin(angle), "theta": angle + np.pi / 2}
    some = recording.select(slice(0, N))
    cut, words = _cut(replace(some, columns=some.columns | circle), 0.25)
    assert words == "the last 1 of 4 laps and what follows"
    assert cut == pytest.approx(N - (N % per_lap) - per_lap, abs=0.15 * per_lap)


def test_too_little_to_hold_out_is_refused(lagging: Lagging) -> None:
    recording, vehicle, _ = lagging
    with pytest.raises(RecordingError) as raised:
        diagnose(recording.select(slice(0, 600)), vehicle, holdout=0.05)
    assert "rows in the held-out part" in one_line(raised)
    assert "record longer or hold out more" in one_line(raised)


def test_an_effect_that_needs_a_constant_says_which(lagging: Lagging) -> None:
    _, vehicle, found = lagging
    assert "load_sensitivity" not in [one.effect for one in found.not_judged]
    flat = vehicle.model_copy(update={"constants": vehicle.constants.model_copy(update={"load_transfer": False})})
    others = set(EFFECTS) - {"load_sensitivity", "drag"}
    limited = diagnose(lagging[0], flat, integrator="euler", exclude=others)
    (told,) = [one for one in limited.not_judged if one.effect == "load_sensitivity"]
    assert "load_transfer false; expected axle loads that change" in told.why
    assert told.manoeuvre == ""


def test_an_extended_car_that_no_live_window_can_serve_says_so() -> None:
    car = load_vehicle("av21").with_effect("steering_lag", {"time_constant": 0.1})
    assert list(_not_live(car)) == []
    (note,) = _not_live(car.with_effect("grip_patch", {"factor": 0.8, "centre": 0.3, "length": 0.1}))
    assert note.startswith("grip_patch reads s, lap_length: simulate, race, calibrate and diagnose know it")


def test_what_cannot_be_noticed_is_listed_with_the_driving_that_shows_it() -> None:
    assert list(_not_judged({}, {"steering_lag": 0.1, "drag": 1.9})) == []
    told = list(_not_judged({"grip_patch": "no place"}, {"steering_lag": np.inf, "drag": 2.1, "mass": 0.1}))
    assert [one.effect for one in told] == ["grip_patch", "steering_lag", "drag"]
    assert [one.manoeuvre for one in told] == ["", EFFECTS["steering_lag"].MANOEUVRE, EFFECTS["drag"].MANOEUVRE]
