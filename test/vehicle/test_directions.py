"""Every direction of travel: backwards, standing and forwards, and the way from one to the other."""

from __future__ import annotations

from typing import Any

import casadi
import numpy as np
import pytest
import torch

from dynssm_ros.vehicle import Applied, CarModel, Coefficients, State, Vehicle, load_vehicle
from dynssm_ros.vehicle.effects import EFFECTS
from dynssm_ros.vehicle.kinematics import SCALAR
from dynssm_ros.vehicle.single_track import Motion, rolling, standing_speed

SHIFTS = ("S_hf", "S_vf", "S_hr", "S_vr")


@pytest.fixture(params=["orca", "av21"])
def vehicle(request: pytest.FixtureRequest) -> Vehicle:
    return reversing(load_vehicle(request.param), False)


def reversing(vehicle: Vehicle, reverse: bool = True) -> Vehicle:
    return vehicle.model_copy(update={"constants": vehicle.constants.model_copy(update={"reverse": reverse})})


def theta_of(vehicle: Vehicle, **changes: float) -> Coefficients:
    return Coefficients(*vehicle.nominal.tolist())._replace(**changes)


def standing(vehicle: Vehicle) -> float:
    return float(standing_speed(vehicle.constants.wheelbase))


def motion(vehicle: Vehicle, state: Any, applied: Any, theta: Coefficients | None = None, xp: Any = np) -> Motion:
    car = CarModel(vehicle.constants, vehicle.sampling_time, xp=xp)
    return car.motion(State(*state), Applied(*applied), theta or theta_of(vehicle), h=car.T_s)


def test_faster_than_standing_the_equations_are_those_of_the_paper(vehicle: Vehicle) -> None:
    """Eq. (1) to (6), written out; bit by bit, so that forward driving is what it was."""
    random, c, th = np.random.default_rng(3), vehicle.constants, theta_of(vehicle)
    v_x = random.uniform(standing(vehicle), 100 * standing(vehicle), 500)
    v_y, omega = random.normal(size=(2, 500)) * [[0.1], [0.5]]
    r, delta = random.uniform(-1, 1, 500), random.uniform(-0.4, 0.4, 500)
    q = motion(vehicle, (v_x, v_y, omega), (r, delta))
    np.testing.assert_array_equal(q.alpha_f, delta - np.arctan2(c.l_f * omega + v_y, v_x) + th.S_hf)
    np.testing.assert_array_equal(q.alpha_r, np.arctan2(c.l_r * omega - v_y, v_x) + th.S_hr)
    np.testing.assert_array_equal(q.F_rx, (th.C_m1 - th.C_m2 * v_x) * r - th.C_r0 - th.C_r2 * v_x * v_x)
    np.testing.assert_array_equal(q.a_x, (q.F_rx - q.F_fy * np.sin(delta)) / c.m + v_y * omega)
    np.testing.assert_array_equal(q.a_y, (q.F_ry + q.F_fy * np.cos(delta)) / c.m - v_x * omega)


def test_a_car_that_reverses_is_one_that_steers_at_the_rear_and_drives_forwards(vehicle: Vehicle) -> None:
    """Turned by half a turn the velocities change their signs and the axles their places: the mirrored motion."""
    random, c, th = np.random.default_rng(4), vehicle.constants, theta_of(vehicle)
    v_x = -random.uniform(1.1 * standing(vehicle), 5.0, 300)
    v_y, omega = random.normal(size=(2, 300)) * [[0.1], [0.5]]
    delta = random.uniform(-0.4, 0.4, 300)
    q = motion(vehicle, (v_x, v_y, omega), (0.0, delta))
    ahead, behind = c.l_r, c.l_f
    unsteered = -np.arctan2(-v_y + ahead * omega, -v_x) - th.S_hr  # its front axle, which is this car's rear one
    steered = -(delta + th.S_hf) - np.arctan2(behind * omega + v_y, -v_x)  # pushes to this car's left
    np.testing.assert_allclose(q.alpha_f, steered, rtol=1e-13)
    np.testing.assert_allclose(q.alpha_r, -(unsteered + 2 * th.S_hr) + 0.0 * v_x, rtol=1e-12, atol=1e-15)


def test_backwards_the_wheels_lead_along_the_way_that_they_would_come_forwards(vehicle: Vehicle) -> None:
    """Slowly, the car rolls without slip on one circle in both directions, as geometry has it."""
    c, th = vehicle.constants, theta_of(vehicle, C_r0=0.0, C_r2=0.0, **dict.fromkeys(SHIFTS, 0.0))
    car = CarModel(c, 0.1, integrator="rk4", substeps=100)
    delta, curvatures = 0.2, []
    for v_x in (1.5 * standing(vehicle), -1.5 * standing(vehicle)):
        state = State(v_x, 0.0, 0.0)
        for _ in range(20):
            moved = car.step(state, Applied(0.0, delta), th)[0]
            state = State(v_x, moved.v_y, moved.omega)
        curvatures.append(state.omega / v_x)
    assert curvatures == pytest.approx([np.tan(delta) / (c.l_f + c.l_r)] * 2, rel=0.02)


def test_left_mirrors_right_backwards_too(vehicle: Vehicle) -> None:
    th = theta_of(vehicle, **dict.fromkeys(SHIFTS, 0.0))
    v_x = np.linspace(-5, 5, 201)
    left = motion(vehicle, (v_x, 0.1, 0.4), (0.2, 0.2), th)
    right = motion(vehicle, (v_x, -0.1, -0.4), (0.2, -0.2), th)
    np.testing.assert_array_equal(right.a_x, left.a_x)
    np.testing.assert_array_equal(right.a_y, -left.a_y)
    np.testing.assert_array_equal(right.omega_dot, -left.omega_dot)


@pytest.mark.parametrize("reverse", [False, True])
@pytest.mark.parametrize("load_transfer", [False, True])
def test_numpy_torch_and_casadi_agree_from_reverse_to_top_speed(
    vehicle: Vehicle, reverse: bool, load_transfer: bool
) -> None:
    vehicle = reversing(vehicle) if reverse else vehicle
    constants = vehicle.constants.model_copy(update={"load_transfer": load_transfer})
    car, random, limit = CarModel(constants, vehicle.sampling_time), np.random.default_rng(5), standing(vehicle)
    v_x = np.concatenate([np.linspace(-5, 60, 40), np.linspace(-1.2, 1.2, 41) * limit])  # through 0 and both limits
    n = len(v_x)
    state = np.stack([v_x, *random.normal(size=(2, n)) * [[0.1], [0.5]]])
    inputs = np.stack([random.uniform(-1, 1, n), random.uniform(-0.4, 0.4, n)])
    theta = theta_of(vehicle)
    by_numpy = np.stack(car.step(State(*state), Applied(*inputs), theta)[0])
    by_torch = torch.stack(
        list(car.under(torch).step(State(*torch.from_numpy(state)), Applied(*torch.from_numpy(inputs)), theta)[0])
    ).numpy()
    s, u = casadi.SX.sym("s", 3), casadi.SX.sym("u", 2)
    step = car.under(casadi).step(State(*casadi.vertsplit(s)), Applied(*casadi.vertsplit(u)), theta)[0]
    by_casadi = np.array(casadi.Function("f", [s, u], [casadi.vertcat(*step)]).map(n)(state, inputs))
    for other in (by_torch, by_casadi):
        np.testing.assert_allclose(other, by_numpy, rtol=1e-12, atol=1e-12)


def test_derivatives_are_finite_and_have_no_jump_on_the_way_through_standstill(vehicle: Vehicle) -> None:
    """Those that the controller takes, of the step by state and input; a jump would not shrink with the steps."""
    vehicle, limit = reversing(vehicle), standing(vehicle)
    s, u = casadi.SX.sym("s", 3), casadi.SX.sym("u", 2)
    car = CarModel.of(vehicle, xp=casadi)
    step = casadi.vertcat(*car.step(State(*casadi.vertsplit(s)), Applied(*casadi.vertsplit(u)), theta_of(vehicle))[0])
    jacobian = casadi.Function("J", [s, u], [casadi.jacobian(step, casadi.vertcat(s, u))])

    def largest_change(count: int) -> float:
        v_x = np.linspace(-1.5, 1.5, count) * limit
        found = np.array(jacobian.map(count)(np.stack([v_x, 0 * v_x + 0.01, 0 * v_x + 0.1]), np.array([0.2, 0.15])))
        assert np.isfinite(found).all()
        columns = found.reshape(3, count, 5)
        return float((np.abs(np.diff(columns, axis=1)).max((1,)) / np.ptp(columns, axis=1).clip(1e-9)).max())

    assert largest_change(30001) < 0.25 * largest_change(3001) < 0.1
    at_rest = np.array(jacobian([0, 0, 0], [0, 0.3]))
    assert np.isfinite(at_rest).all()


def test_a_car_that_stands_stays_however_its_wheels_are_turned(vehicle: Vehicle) -> None:
    turned = np.linspace(-0.5, 0.5, 11)
    car = CarModel.of(vehicle)
    state = State(*np.zeros((3, 11)))
    for _ in range(50):
        state = car.step(state, Applied(0.0, turned), theta_of(vehicle))[0]
    np.testing.assert_array_equal(np.stack(state), 0.0)


@pytest.mark.parametrize("v_x", [-3.0, 3.0])
def test_it_rolls_out_to_rest_and_stays_from_either_direction(vehicle: Vehicle, v_x: float) -> None:
    car, state, way = CarModel.of(vehicle, "rk4", 2, xp=SCALAR), State(v_x, 0.0, 0.0), []
    for _ in range(1000):
        state = car.step(state, Applied(vehicle.inputs.throttle[0], 0.1), theta_of(vehicle))[0]
        way.append(state.v_x * np.sign(v_x))
    assert min(way) > -1e-6, "brakes and resistance push it back"
    np.testing.assert_allclose(state, 0.0, atol=1e-6)


def test_brakes_never_drive_it_backwards_and_a_throttle_with_reverse_does(vehicle: Vehicle) -> None:
    strong = theta_of(vehicle, C_r0=0.1 * vehicle.coefficients["C_m1"].nominal)
    still = CarModel.of(vehicle).step(State(0.0, 0.0, 0.0), Applied(-0.8, 0.0), strong)[0]
    backwards = CarModel.of(reversing(vehicle)).step(State(0.0, 0.0, 0.0), Applied(-0.8, 0.0), strong)[0]
    assert still.v_x == 0.0
    assert backwards.v_x == pytest.approx(-0.7 * strong.C_m1 / vehicle.constants.m * vehicle.sampling_time)


@pytest.mark.parametrize("reverse", [False, True])
def test_the_resistance_holds_a_car_that_stands_until_the_drive_overcomes_it(vehicle: Vehicle, reverse: bool) -> None:
    vehicle = reversing(vehicle) if reverse else vehicle
    theta = theta_of(vehicle)
    most = theta.C_r0 / theta.C_m1
    r = np.array([-1.1, -0.9, -0.1, 0.0, 0.1, 0.9, 1.1]) * most
    a_x = motion(vehicle, (0.0 * r, 0.0, 0.0), (r, 0.2)).a_x
    np.testing.assert_array_equal(np.sign(a_x.round(12)), [-1.0 if reverse else 0.0, 0, 0, 0, 0, 0, 1])


def test_forces_along_the_car_are_mirrored(vehicle: Vehicle) -> None:
    """What a throttle does forwards the opposite one does backwards; resistances, also of effects, always brake."""
    vehicle, v_x = reversing(vehicle), np.linspace(1.1 * standing(vehicle), 5.0, 50)
    effects = (
        EFFECTS["drag"](0.3), EFFECTS["rolling_resistance"](0.02), EFFECTS["power_limit"](0.1), EFFECTS["drive_gain"](1.2),
    )  # fmt: skip
    for acting in ((), effects):
        car = CarModel(vehicle.constants, 0.02, acting)
        ahead, back = (
            car.motion(State(s * v_x, 0.0 * v_x, 0.0 * v_x), Applied(s * 0.7, 0.0), theta_of(vehicle)).F_rx
            for s in (1, -1)
        )
        np.testing.assert_array_equal(back, -ahead)


def test_rolling_wheels_reach_the_circle_of_their_axles_within_a_step(vehicle: Vehicle) -> None:
    c, h = vehicle.constants, 0.04
    q = motion(vehicle, (-0.5, 0.3, -0.2), (0.0, 0.25))
    a_y, omega_dot = rolling(np, q, h)
    omega = -0.2 + h * omega_dot
    assert omega == pytest.approx(-0.5 * np.tan(0.25) / (c.l_f + c.l_r))
    assert 0.3 + h * a_y == pytest.approx(c.l_r * omega), "the rear axle moves along the car"
