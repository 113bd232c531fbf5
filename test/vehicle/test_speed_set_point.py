"""A car that is asked for a speed: its controller's closed forms, one source over three array namespaces, its file."""

from __future__ import annotations

from typing import Any

import casadi
import numpy as np
import pytest
import torch

from dynssm_ros.configuration import validate
from dynssm_ros.errors import ConfigurationError
from dynssm_ros.vehicle import Applied, CarModel, Coefficients, State, Vehicle, load_vehicle
from dynssm_ros.vehicle.limits import vehicle_limits
from dynssm_ros.vehicle.single_track import speed_controller_force, speed_error_for

CAR = load_vehicle("f1tenth")
THETA = Coefficients(*CAR.nominal.tolist())
FREE = THETA._replace(C_r0=0.0, C_r2=0.0)


def derivatives(xp: Any, state: Any, inputs: Any, theta: Any) -> list[Any]:
    car = CarModel.of(CAR, "rk4", xp=xp)
    q = car.motion(State(*state), Applied(*inputs), Coefficients(*theta))
    return [q.a_x, q.a_y, q.omega_dot, *car.step(State(*state), Applied(*inputs), Coefficients(*theta))[0]]


def test_numpy_torch_and_casadi_agree_to_1e_12() -> None:
    random = np.random.default_rng(3)
    state = random.uniform([[0.5], [-0.3], [-2.0]], [[8.0], [0.3], [2.0]], (3, 40))
    inputs = random.uniform([[-5.0], [-0.4]], [[20.0], [0.4]], (2, 40))
    theta = CAR.lower[:, None] + random.uniform(size=(17, 40)) * (CAR.upper - CAR.lower)[:, None]
    by_numpy = np.stack(derivatives(np, state, inputs, theta))
    leaves = [torch.from_numpy(each).requires_grad_() for each in (state, inputs, theta)]
    by_torch = torch.stack(derivatives(torch, *leaves))
    symbols = casadi.SX.sym("s", 3), casadi.SX.sym("u", 2), casadi.SX.sym("theta", 17)
    parts = derivatives(casadi, *(casadi.vertsplit(each) for each in symbols))
    by_casadi = np.array(casadi.Function("f", symbols, [casadi.vertcat(*parts)]).map(40)(state, inputs, theta))
    for other in (by_torch.detach().numpy(), by_casadi):
        np.testing.assert_allclose(other, by_numpy, rtol=1e-12, atol=1e-12)
    assert all(torch.isfinite(each).all() for each in torch.autograd.grad(by_torch.sum(), leaves))


def test_near_the_set_point_the_error_falls_exponentially_with_mass_over_gain() -> None:
    error, T = 1e-3 * CAR.input_unit, 0.1
    car = CarModel(CAR.constants, T, (), "rk4", 50, set_point="speed")
    end = car.step(State(3.0 - error, 0.0, 0.0), Applied(3.0, 0.0), FREE)[0]
    assert 3.0 - end.v_x == pytest.approx(error * np.exp(-FREE.C_m2 * T / CAR.constants.m), rel=1e-9)


def test_the_force_is_odd_rises_and_is_limited_on_both_sides() -> None:
    error = np.linspace(0.0, 30.0, 301)
    force = speed_controller_force(THETA, error)
    np.testing.assert_array_equal(speed_controller_force(THETA, -error), -force)
    assert (np.diff(force) > 0).all()
    assert np.abs(force).max() < THETA.C_m1 * (1 + 1e-12)
    assert force[-1] == pytest.approx(THETA.C_m1, rel=1e-4)


@pytest.mark.parametrize("force", [-30.0, -1.0, 0.0, 5.0, 34.0])
def test_the_error_for_a_force_gives_that_force(force: float) -> None:
    assert speed_controller_force(THETA, speed_error_for(THETA, force)) == pytest.approx(force, abs=1e-12)


def test_a_force_beyond_the_limit_is_asked_for_by_a_finite_error() -> None:
    assert speed_controller_force(THETA, speed_error_for(THETA, 1e3)) == pytest.approx(0.98 * THETA.C_m1)


def test_a_standing_car_is_held_by_the_resistance_until_the_set_point_overcomes_it() -> None:
    car = CarModel.of(CAR)
    balance = THETA.C_r0 / THETA.C_m2
    for r, drives in ((0.9 * balance, False), (1.1 * balance, True)):
        assert (car.motion(State(0.0, 0.0, 0.0), Applied(r, 0.0), THETA).a_x > 0) == drives


def test_the_set_point_is_reached_forwards_standing_and_backwards() -> None:
    """In steps that resolve the passage through standstill; what resists costs a few cm/s."""
    car, state = CarModel(CAR.constants, 0.5, (), "rk4", 500, set_point="speed"), State(0.0, 0.0, 0.0)
    for wanted in (3.0, 0.0, -1.5, 1.0):
        for _ in range(4):
            state = car.step(state, Applied(wanted, 0.0), THETA)[0]
        assert state.v_x == pytest.approx(wanted, abs=(THETA.C_r0 + THETA.C_r2 * 9) / THETA.C_m2 + 1e-3)
        assert state[1:] == (0.0, 0.0)


def test_limits_of_the_car_follow_from_the_controller() -> None:
    limits, inputs = vehicle_limits(CAR), CAR.inputs
    most = THETA.C_m1 / CAR.constants.m
    assert 0.9 * inputs.throttle[1] < limits.top_speed < inputs.throttle[1]
    assert limits.drive[0] == pytest.approx(most, rel=0.02)
    assert (limits.brake > 0.9 * most).all()
    assert (limits.lateral > 0).all()


def test_full_brakes_never_ask_for_driving_backwards() -> None:
    inputs = CAR.inputs
    assert inputs.full_brakes == 0.0
    assert inputs.model_copy(update={"throttle": (1.0, 8.0)}).full_brakes == 1.0
    assert load_vehicle("orca").inputs.full_brakes == -0.1


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"inputs": {"set_point": "throttle"}}, "inputs.throttle: -5: a speed (set_point: speed)? expected -1 to 1"),
        ({"inputs": {"throttle": [-18, 400]}}, "inputs.throttle: 400: in km/h? expected -120 to 120 m/s"),
        ({"inputs": {"throttle": [-5, 0]}}, "expected a speed set-point above 0"),
        ({"inputs": {"set_point": "torque"}}, "inputs.set_point"),
        ({"coefficients": {"C_m2": {"nominal": 1.0, "bounds": [0, 9]}}}, "C_m2.bounds: [0, 9]: expected more than 0"),
        (
            {"coefficients": {"C_m2": {"nominal": 4e4, "bounds": [1, 5e4]}}},
            "C_m2.nominal: 40000: expected 0.187 to 748",
        ),
    ],
)
def test_a_wrong_file_names_field_value_and_what_was_expected(changes: dict[str, Any], said: str) -> None:
    content = CAR.model_dump()
    for part, fields in changes.items():
        content[part] |= fields
    with pytest.raises(ConfigurationError) as caught:
        validate(Vehicle, content, "car.yaml")
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)
