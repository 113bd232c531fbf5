"""Calibration with effects that read signals beside state and inputs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dynssm_ros.errors import ConfigurationError
from dynssm_ros.identification.problem.car import CarEstimate
from dynssm_ros.identification.problem.windows import SimulationWindows, recorded_rows
from dynssm_ros.identification.result.calibration import _context, calibrate
from dynssm_ros.signals.recording import Recording
from dynssm_ros.simulation.laps import as_recording, simulate
from dynssm_ros.track.lap_position import lap_context
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import Vehicle, load_vehicle

NOISE = (0.02, 0.02, 0.003)
AV21 = load_vehicle("av21")
WIND, FADE = ("crosswind", {"x": 2.0, "y": 8.0}), ("grip_drift", {"rate": -0.003})


@pytest.fixture(scope="module")
def windy() -> Recording:
    """A car in wind whose grip fades, with its pose; the signals of the track are not recorded."""
    car = AV21.with_effect(*WIND).with_effect(*FADE)
    return as_recording(simulate(car, load_track("road_course"), duration=30.0))


def errors(recording: Recording, car: Vehicle) -> np.ndarray:
    data = recorded_rows(recording, lap_context(recording, None))
    return SimulationWindows(data, recording.window_ends(1, horizon=3), 3, 0, "euler").errors(CarEstimate.of(car))


def test_time_and_heading_are_known(windy: Recording) -> None:
    assert np.abs(errors(windy, AV21.with_effect(*WIND).with_effect(*FADE))).max() < 1e-9
    assert np.abs(errors(windy, AV21)).max() > 1e-3


def test_the_signal_that_the_recording_has_not_is_named(windy: Recording) -> None:
    patchy = AV21.with_effect("grip_patch", {"factor": 0.7})
    with pytest.raises(ConfigurationError, match=r"effect grip_patch needs the signal s \(m\)"):
        calibrate(windy, patchy)
    cambered = AV21.with_effect("road_bank", {"camber": 0.1})
    with pytest.raises(ConfigurationError, match=r"effect road_bank needs the signal bend \(1\)"):
        calibrate(windy, cambered)
    lap = {"s": np.linspace(0, 300, len(windy)), "lap_length": np.full(len(windy), 1000.0)}
    with_values = replace(windy, columns=windy.columns | lap)
    assert np.isfinite(calibrate(with_values, patchy, integrator="euler", starts=1).theta).all()


def test_where_a_lap_starts_comes_from_a_track_and_how_the_road_bends_from_a_lap() -> None:
    road = load_track("oval").scaled(0.3)
    laps = as_recording(
        simulate(AV21.with_effect("road_bank", {"camber": 0.15}), road, duration=50.0, seed=3, noise=NOISE)
    )
    for line in (None, road.centre):
        context = _context(laps, AV21.with_effect("road_bank", {"camber": 0.15}), line)
        measured = road.centre.bend(road.project(np.stack([laps["x"], laps["y"]], axis=1))[0])
        assert np.corrcoef(context["bend"], measured)[0, 1] > 0.98
        assert ("s" in context) == (line is not None)
    patchy = AV21.with_effect("grip_patch", {"factor": 0.7})
    with pytest.raises(ConfigurationError, match="needs the signal s"):
        calibrate(laps, patchy, starts=1)
    assert np.isfinite(calibrate(laps, patchy, horizon=0.2, integrator="rk4", starts=1, line=road.centre).theta).all()
