"""Speed set-points through signal maps, bags and recordings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from dynssm_ros.errors import RecordingError
from dynssm_ros.runtime.plausibility import Plausibility, implausible_rows
from dynssm_ros.signals.extraction import extract
from dynssm_ros.signals.recording import Recording, concatenate
from dynssm_ros.signals.signal_map import SignalMap, load_signal_map
from dynssm_ros.signals.standard import recording_to_bag
from dynssm_ros.simulation.laps import Run, as_recording, simulate, write_run
from dynssm_ros.track.driver import Style
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import load_vehicle

CAR = load_vehicle("f1tenth")


@pytest.fixture(scope="module")
def run() -> Run:
    return simulate(CAR, load_track("club").scaled(10.0), duration=4.0, plant="rk4", style=Style(0.7, 0.5))


@pytest.fixture(scope="module")
def recording(run: Run, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    bag = tmp_path_factory.mktemp("run") / "bag"
    write_run(run, bag)
    return extract([bag], load_signal_map("default_speed"), 50.0)


def test_a_simulated_drive_is_extracted_as_it_was_driven(recording: Recording, run: Run) -> None:
    driven = as_recording(run)
    assert recording.info.set_point == driven.info.set_point == "speed"
    np.testing.assert_allclose(recording.matrix, driven.matrix, atol=1e-9)
    assert np.ptp(recording["r_fb"]) > 1.0


def test_the_file_says_that_its_first_input_is_in_metres_per_second(recording: Recording, tmp_path: Path) -> None:
    recording.save(tmp_path / "laps.parquet")
    schema = pq.read_schema(tmp_path / "laps.parquet")
    assert [schema.field(name).metadata[b"unit"] for name in ("r_fb", "r_cmd", "delta_fb")] == [b"m/s", b"m/s", b"rad"]
    assert Recording.load(tmp_path / "laps.parquet").info.set_point == "speed"


def test_a_recording_becomes_a_bag_and_the_same_recording(recording: Recording, tmp_path: Path) -> None:
    recording_to_bag(recording, tmp_path / "bag")
    again = extract([tmp_path / "bag"], load_signal_map("default_speed"), 50.0)
    np.testing.assert_allclose(again.matrix, recording.matrix, atol=1e-9)


def test_another_kind_of_car_is_refused_in_one_line(recording: Recording) -> None:
    recording.require_set_point("speed", "vehicle f1tenth")
    with pytest.raises(RecordingError) as caught:
        recording.require_set_point("throttle", "vehicle orca")
    assert str(caught.value) == (
        "recording bag: its first input is a speed set-point, but vehicle orca takes a throttle "
        "(inputs.set_point: throttle); `dynssm vehicle new --set-point speed` writes a file that fits"
    )


def test_recordings_of_both_kinds_are_not_joined(recording: Recording) -> None:
    info = recording.info.model_copy(update={"set_point": "throttle"})
    other = Recording(info, recording.time, recording.segment, recording.columns)
    with pytest.raises(RecordingError, match="set_point throttle, but bag has speed; expected the same"):
        concatenate([recording, other])


def test_a_set_point_is_plausible_up_to_what_the_car_takes(recording: Recording) -> None:
    assert not list(implausible_rows(recording, CAR))
    checked = Plausibility(CAR)
    assert not checked.is_beyond({"speed_feedback": 19.0, "steering_feedback": 0.1})
    assert checked.is_beyond({"speed_feedback": 70.0})  # km/h
    assert "speed_feedback = 70" in checked.last


@pytest.mark.parametrize("wrong", ["throttle_feedback", "brake_command"])
def test_a_map_has_a_speed_or_a_throttle(wrong: str) -> None:
    content = load_signal_map("f1tenth").model_dump(exclude_none=True)
    content["signals"][wrong] = content["signals"]["speed_feedback"]
    with pytest.raises(ValueError, match=f"signals.{wrong}: the input is a speed set-point"):
        SignalMap.model_validate(content)


def test_a_command_alone_lacks_what_acts() -> None:
    content = load_signal_map("default_speed").model_dump(exclude_none=True)
    del content["signals"]["speed_feedback"]
    with pytest.raises(ValueError, match="missing speed_feedback"):
        SignalMap.model_validate(content)
