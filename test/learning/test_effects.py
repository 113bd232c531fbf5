"""Effects of the vehicle file where models are fitted: the physics layer under torch, calibration, the deployed graph."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

from dynssm_ros.errors import ConfigurationError
from dynssm_ros.learning.models.dynssm.network import PhysicsLayer
from dynssm_ros.learning.models.physics import PhysicsConfig
from dynssm_ros.runtime.models import SingleTrack
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
