"""The lap that a drive closes, and where on it the errors are."""

from __future__ import annotations

import numpy as np
import pytest

from dynssm_ros.signals.extraction import extract
from dynssm_ros.signals.inputs import WINDOW_COLUMNS
from dynssm_ros.signals.recording import Recording, RecordingInfo
from dynssm_ros.signals.signal_map import load_signal_map
from dynssm_ros.track.lap_position import first_lap, lap_context, rms_along, track_position


def drive(positions, segment=None):
    """A recording of a car that was at ``positions`` (N, 2)."""
    N = len(positions)
    columns = {name: np.zeros(N) for name in WINDOW_COLUMNS}
    columns |= {"x": positions[:, 0].copy(), "y": positions[:, 1].copy(), "theta": np.zeros(N)}
    info = RecordingInfo(sampling_time=0.04, commands="none", source=("planted",))
    segment = np.zeros(N, np.int32) if segment is None else segment
    return Recording(info, np.arange(N) * 40_000_000, segment, columns)


def ellipse(turns, radius=100.0, N=900):
    """Laps of an ellipse, counter-clockwise from its rightmost point."""
    angle = np.linspace(0.0, 2 * np.pi * turns, N)
    return np.stack([2 * radius * np.cos(angle), radius * np.sin(angle)], axis=1)


CIRCUMFERENCE = 968.845  # of the ellipse with half axes 200 and 100 m


def test_a_lap_is_as_long_as_the_track():
    assert first_lap(drive(ellipse(1.5))).length == pytest.approx(CIRCUMFERENCE, rel=1e-3)


def test_an_out_lap_from_the_pits_a_stop_and_laps_that_differ_do_no_harm():
    laps = ellipse(2.3, N=2000)
    laps *= 1 + 0.01 * np.sin(np.linspace(0, 9, len(laps)))[:, None]  # up to 2 m off the line
    pits = np.linspace([150.0, -160.0], laps[0], 200, endpoint=False)
    stop = np.tile(pits[0], (100, 1))
    assert first_lap(drive(np.concatenate([stop, pits, laps]))).length == pytest.approx(CIRCUMFERENCE, rel=0.02)


@pytest.mark.parametrize(
    "positions",
    [
        ellipse(0.9),
        np.concatenate([ellipse(0.5), ellipse(0.5)[::-1]]),  # back on the same road, the other way
        np.linspace([0.0, 0.0], [500.0, 20.0], 300),
        np.zeros((50, 2)),
    ],
)
def test_a_drive_that_does_not_close_has_no_lap(positions):
    assert first_lap(drive(positions)) is None


def test_a_gap_is_never_driven_across():
    path = ellipse(1.5)
    halves = np.repeat([0, 1], len(path) // 2).astype(np.int32)
    assert first_lap(drive(path, halves)) is None
    later = np.concatenate([path[:100], path])
    segment = np.repeat([0, 1], [100, len(path)]).astype(np.int32)
    assert first_lap(drive(later, segment)).length == pytest.approx(CIRCUMFERENCE, rel=1e-3)


def test_without_positions_there_is_no_lap():
    recording = drive(ellipse(1.5))
    del recording.columns["theta"]
    assert first_lap(recording) is None


def test_the_position_on_the_lap_starts_anew_with_every_lap():
    recording = drive(ellipse(2.0, N=801))
    position = track_position(first_lap(recording), recording)
    gap = (position[400:] - position[:401] + CIRCUMFERENCE / 2) % CIRCUMFERENCE - CIRCUMFERENCE / 2
    assert np.abs(gap).max() < 1.0
    assert np.median(np.diff(position)) == pytest.approx(2 * CIRCUMFERENCE / 800, rel=0.2)


def test_positions_in_blocks_are_those_at_once(monkeypatch):
    recording = drive(ellipse(2.5))
    line = first_lap(recording)
    at_once = track_position(line, recording)
    monkeypatch.setattr("dynssm_ros.track.lap_position._AT_ONCE", 7)
    np.testing.assert_allclose(track_position(line, recording), at_once, atol=1e-6)


def test_effects_may_read_time_from_the_first_row_and_what_else_was_recorded() -> None:
    columns = {name: np.arange(5) + 10.0 * k for k, name in enumerate((*WINDOW_COLUMNS, "x", "y", "theta", "s"))}
    time = np.array([7, 8, 9, 30, 31], dtype=np.int64) * 40_000_000
    info = RecordingInfo(sampling_time=0.04, commands="none")
    found = lap_context(Recording(info, time, np.array([0, 0, 0, 1, 1], dtype=np.int32), columns), None)
    assert set(found) == {"t", "clock", "x", "y", "theta", "s"}
    np.testing.assert_allclose(found["clock"], [0.28, 0.32, 0.36, 1.2, 1.24])
    np.testing.assert_allclose(found["t"], np.array([0, 1, 2, 23, 24]) * 0.04)
    np.testing.assert_array_equal(found["theta"], np.arange(5) + 90.0)


def test_errors_are_averaged_over_stretches_of_the_lap():
    position = np.array([0.0, 9.0, 10.0, 35.0, 39.999])
    errors = np.array([[3.0, 0.0], [4.0, 0.0], [2.0, 1.0], [1.0, -1.0], [1.0, np.nan]])
    along = rms_along(position, errors, length=40.0, bins=4)
    np.testing.assert_allclose(along[:, 0], [np.sqrt(12.5), 2.0, np.nan, 1.0])
    np.testing.assert_allclose(along[:, 1], [0.0, 1.0, np.nan, np.nan])


def test_the_published_orca_run_closes_the_lap_of_its_track(orca_bag, data):
    recording = extract([orca_bag], load_signal_map("default"), 50.0)
    line = np.loadtxt(data / "tracks" / "ethz.csv", delimiter=",", comments="#")[:, :2]
    length = np.hypot(*np.diff(line, axis=0, append=line[:1]).T).sum()
    assert 0.85 * length < first_lap(recording).length < length  # it cuts the corners of the centre line
