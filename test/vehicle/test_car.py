"""A bound car over windows: effect states are carried as the full equations carry them, also where those are left out."""

from __future__ import annotations

import pickle
from copy import deepcopy

import casadi
import numpy as np
import pytest
import torch

from dynssm_ros.vehicle import Applied, CarModel, Coefficients, State, load_vehicle
from dynssm_ros.vehicle.effects import build_effect, initial_effect_states
from dynssm_ros.vehicle.kinematics import SCALAR

CAR = load_vehicle("orca")
THETA = Coefficients(*CAR.nominal)
LAGS = {"steering_lag": 0.05, "throttle_lag": 0.12}
ROWS = 20


def bound(*names: str, how: tuple = (), **parts: object) -> CarModel:
    effects = tuple(build_effect(name, {"time_constant": LAGS.get(name, 0.08)}) for name in names)
    return CarModel(CAR.constants, 0.02, effects, *how, **parts)


def drive() -> tuple[State, Applied, Applied]:
    """Columns of shape ``(1, ROWS)``: states, applied inputs, feedback."""
    rng, k = np.random.default_rng(3), np.arange(ROWS)[None]
    states = State(2.0 + 0.02 * k, 0.05 + 0.0 * k, 0.5 + 0.1 * k)
    applied = Applied(rng.uniform(-0.5, 1.0, k.shape), rng.uniform(-0.3, 0.3, k.shape))
    return states, applied, Applied(0.3 + 0.0 * k, 0.1 + 0.0 * k)


@pytest.mark.parametrize("integrator", ["euler", "rk4"])
@pytest.mark.parametrize("substeps", [1, 3])
@pytest.mark.parametrize(
    "names", [("steering_lag",), ("throttle_lag", "steering_lag"), ("steering_lag", "yaw_rate_lag")]
)
def test_states_are_carried_as_the_whole_car_carries_them(integrator, substeps, names) -> None:
    car = bound(*names, how=(integrator, substeps))
    states, applied, feedback = drive()
    found = car.effect_states_along(states, applied, feedback, THETA)
    moved = car.over(states, applied, feedback, THETA)
    assert len(found) == ROWS
    assert {name for at in found for name in at} == {*car.effect_states}
    for k in range(ROWS):
        here = State(*(each[:, k] for each in states)), Applied(*(each[:, k] for each in applied))
        increment, changed = car.increment(*here, THETA, found[k])
        np.testing.assert_array_equal([each[:, k] for each in moved], increment)
        for name, value in found[k].items() if k < ROWS - 1 else ():
            np.testing.assert_allclose(found[k + 1][name], value + changed[name], rtol=1e-12, atol=1e-15)
    settled = initial_effect_states(car.effects, 0.3, 0.1)
    assert all(found[0][name] == value for name, value in settled.items())
    latest = car.over(states, applied, feedback, THETA, 3)
    np.testing.assert_array_equal(latest, [each[:, -3:] for each in moved])


@pytest.mark.parametrize("names", [(), ("steering_lag",), ("steering_lag", "yaw_rate_lag")])
def test_over_a_window_torch_and_batched_coefficients_agree_with_numpy(names) -> None:
    car, (states, applied, feedback) = bound(*names, how=("rk4",)), drive()
    thetas = np.array(THETA) * np.linspace(0.9, 1.1, 4)[:, None]
    expected = np.array([np.concatenate(car.over(states, applied, feedback, Coefficients(*theta))) for theta in thetas])
    batch = [type(rows)(*(np.tile(each, (4, 1)) for each in rows)) for rows in (states, applied, feedback)]
    found = np.stack(car.over(*batch, Coefficients(*thetas.T[:, :, None])), axis=1)
    np.testing.assert_array_equal(found, expected)
    tensors = [type(rows)(*map(torch.from_numpy, rows)) for rows in batch]
    theta = Coefficients(*torch.from_numpy(thetas.T[:, :, None].copy()))
    by_torch = torch.stack(list(car.under(torch).over(*tensors, theta)), dim=1).numpy()
    np.testing.assert_allclose(by_torch, expected, rtol=1e-12, atol=1e-12)


def test_a_lag_follows_its_exponential_as_far_as_runge_kutta_does() -> None:
    states, _, feedback = drive()
    held = Applied(0.0 * feedback.r, 0.2 + 0.0 * feedback.r)
    car = CarModel(CAR.constants, 0.02, (build_effect("steering_lag", {"time_constant": 0.1}),), "rk4")
    found = car.effect_states_along(states, held, Applied(0.0 * feedback.r, 0.0 * feedback.r), THETA)
    steered = [at["steering_lag.delta"][0] for at in found]
    z = 0.02 / 0.1
    kept = 1 - z + z**2 / 2 - z**3 / 6 + z**4 / 24  # the series of exp(-z) to the fourth order
    np.testing.assert_allclose(steered, 0.2 * (1 - kept ** np.arange(ROWS)), rtol=1e-12)


@pytest.mark.parametrize("xp", [np, torch, casadi, SCALAR], ids=["numpy", "torch", "casadi", "scalar"])
def test_a_car_is_copied_and_pickled_with_its_array_namespace(xp) -> None:
    car = bound("steering_lag", xp=xp, measured=False)
    for copy in (deepcopy(car), pickle.loads(pickle.dumps(car))):
        assert copy.effects == car.effects
        assert not copy.measured
        assert copy.xp is xp or copy.xp == xp
