"""Effects of the vehicle file where models are fitted: the physics layer under torch, calibration, the deployed graph."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from dynssm_ros.errors import ConfigurationError
from dynssm_ros.learning.calibration import PredictionErrors
from dynssm_ros.learning.models.dynssm.network import PhysicsLayer
from dynssm_ros.learning.models.physics import PhysicsConfig
from dynssm_ros.runtime.models import SingleTrack
from dynssm_ros.signals.recording import Recording, RecordingInfo
from dynssm_ros.simulation.laps import simulate
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import Vehicle, load_vehicle
from dynssm_ros.vehicle.effects import EFFECTS

Acting = Callable[..., dict[str, float]]
AV21 = load_vehicle("av21")
ANYWHERE = sorted(name for name, effect in EFFECTS.items() if not effect.signals(effect.variants()[0]))
ELSEWHERE = sorted(set(EFFECTS) - set(ANYWHERE))


def with_effect(name: str, acting: Acting) -> Vehicle:
    first = EFFECTS[name].variants()[0]
    return AV21.with_effect(name, {key: value for key, value in acting(name, 0.1).items() if key in first})


def rows(n: int = 30) -> np.ndarray:
    random = np.random.default_rng(5)
    low, high = [5, -1, -0.4, -0.5, -0.1, -0.1, -0.01], [60, 1, 0.4, 0.9, 0.1, 0.1, 0.01]
    return random.uniform(low, high, (n, 7))


@pytest.mark.parametrize("name", ANYWHERE)
def test_the_physics_layer_steps_as_the_deployed_model_does(name: str, acting: Acting) -> None:
    car, data = with_effect(name, acting), rows()
    layer = PhysicsLayer(car, PhysicsConfig(integrator="rk4", substeps=2))
    theta = torch.tensor(car.nominal).requires_grad_()
    found = layer(torch.from_numpy(data), theta.expand(len(data), -1))
    expected = SingleTrack(car, "rk4", 2).predict(data[:, None]).state - data[:, :3]
    np.testing.assert_allclose(found.detach().numpy(), expected, atol=1e-12)
    plain = SingleTrack(AV21, "rk4", 2).predict(data[:, None]).state - data[:, :3]
    assert np.abs(found.detach().numpy() - plain).max() > 1e-4
    found.sum().backward()
    assert theta.grad is not None
    assert theta.grad.isfinite().all()


@pytest.mark.parametrize("name", ELSEWHERE)
def test_a_window_without_the_signal_that_an_effect_needs_is_one_clear_line(name: str, acting: Acting) -> None:
    car = with_effect(name, acting)
    with pytest.raises(
        ConfigurationError, match=rf"^effect {name} needs the signal \w+ .*, which is not known here \(none\)$"
    ):
        SingleTrack(car).predict(rows()[:, None])


@pytest.fixture(scope="module")
def windy() -> Recording:
    """A car in wind whose grip fades, with its pose; the signals of the track are not recorded."""
    car = AV21.with_effect("crosswind", {"x": 2.0, "y": 8.0}).with_effect("grip_drift", {"rate": -0.003})
    run = simulate(car, load_track("road_course"), duration=8.0)
    applied = (run.command - run.feedback).T
    names = ("v_x", "v_y", "omega", "r_fb", "delta_fb", "r_cmd", "delta_cmd", "x", "y", "theta")
    columns = dict(zip(names, (*run.measured.T, *run.feedback.T, *applied, *run.pose.T), strict=True))
    info = RecordingInfo(sampling_time=0.04, commands="topics", source=("windy",))
    return Recording(info, run.time, np.zeros(len(run.time), dtype=np.int32), columns)


def test_calibration_knows_time_and_heading(windy: Recording) -> None:
    car = AV21.with_effect("crosswind", {"x": 2.0, "y": 8.0}).with_effect("grip_drift", {"rate": -0.003})
    assert PredictionErrors(windy, car, steps=3).one_step_rmse(car.nominal).max() < 1e-9
    assert np.abs(PredictionErrors(windy, car, steps=3)(car.nominal)).max() < 1e-9
    assert PredictionErrors(windy, AV21).one_step_rmse(AV21.nominal).max() > 1e-3


def test_calibration_names_the_signal_that_the_recording_has_not(windy: Recording) -> None:
    patchy = AV21.with_effect("grip_patch", {"factor": 0.7})
    with pytest.raises(ConfigurationError, match=r"recording windy: effect grip_patch needs the signal s \(m\)"):
        PredictionErrors(windy, patchy)
    lap = {"s": np.linspace(0, 300, len(windy)), "lap_length": np.full(len(windy), 1000.0)}
    placed = replace(windy, columns=windy.columns | lap)
    assert np.isfinite(PredictionErrors(placed, patchy).one_step_rmse(patchy.nominal)).all()
