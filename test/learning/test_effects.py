"""Effects of the vehicle file where models are fitted: the physics layer under torch, calibration, the deployed graph."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

from dynssm_ros.errors import ConfigurationError
from dynssm_ros.learning.models.dynssm.network import PhysicsLayer
from dynssm_ros.learning.models.physics import PhysicsConfig
from dynssm_ros.runtime.baselines import SingleTrack
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


CARRYING = sorted(name for name in ANYWHERE if EFFECTS[name](**{}).EFFECT_STATES)


@pytest.mark.parametrize("name", CARRYING)
def test_the_layer_carries_effect_states_over_a_window_as_the_baseline_does(name: str, acting: Acting) -> None:
    car = with_effect(name, acting)
    model = SingleTrack(car, "rk4", 2)
    smooth = np.cumsum(rows(model.H * 4).reshape(4, model.H, 7) - rows(1), axis=1) * 0.002 + [0, 0, 0, 0.2, 0, 0, 0]
    smooth[..., 0] += np.linspace(18.0, 14.0, model.H)  # m/s, slower through where a gear depends on what was before
    layer = PhysicsLayer(car, PhysicsConfig(integrator="rk4", substeps=2))
    found = layer.over(torch.from_numpy(smooth), torch.tensor(car.nominal), 1)[:, 0].numpy()
    np.testing.assert_allclose(found, model.predict(smooth).state - smooth[:, -1, :3], atol=1e-12)
    settled = layer(torch.from_numpy(smooth[:, -1]), torch.tensor(car.nominal)).numpy()
    assert np.abs(found - settled).max() > 1e-5


@pytest.mark.parametrize(
    "effect", [{"steering_lag": {"time_constant": 0.05}}, {"yaw_rate_lag": {"time_constant": 0.05}}]
)
def test_a_vehicle_file_with_the_lag_predicts_what_one_without_it_cannot(effect: dict[str, dict[str, float]]) -> None:
    import dynssm_ros

    laps = dynssm_ros.recorded(dynssm_ros.simulate("orca", "club", duration=20.0, aggressiveness=0.6, effects=effect))
    with_lag = load_vehicle("orca").with_effects(effect.items())
    rmse = [
        dynssm_ros.evaluate(laps, {"car": SingleTrack(car)}).scores["car"].rmse
        for car in (with_lag, load_vehicle("orca"))
    ]
    assert np.all(rmse[0] < 0.2 * rmse[1])
