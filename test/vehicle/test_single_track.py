"""The single-track equations: one source over three array namespaces, and the closed forms they must meet."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import casadi
import numpy as np
import pytest
import torch

from dynssm_ros.vehicle import COEFFICIENTS, Applied, CarModel, Coefficients, State, Vehicle, load_vehicle
from dynssm_ros.vehicle.effects import initial_effect_states
from dynssm_ros.vehicle.integrators import Integrator
from dynssm_ros.vehicle.single_track import GRAVITY

SPEEDS = {"orca": (0.5, 3.0), "av21_paper": (5.0, 60.0)}
SHIFTS = ("S_hf", "S_vf", "S_hr", "S_vr")
ALL_EFFECTS = {
    "steering_offset": {"offset": 0.01},
    "steering_lag": {"time_constant": 0.1},
    "drag": {"coefficient": 0.2},
    "front_grip": {"factor": 0.9},
    "rear_grip": {"factor": 1.1},
}


@pytest.fixture(params=sorted(SPEEDS))
def vehicle(request: pytest.FixtureRequest) -> Vehicle:
    return load_vehicle(request.param)


def with_load_transfer(vehicle: Vehicle, on: bool) -> Vehicle:
    constants = vehicle.constants.model_copy(update={"load_transfer": on, "h_cg": 0.3 * vehicle.constants.l_f})
    return vehicle.model_copy(update={"constants": constants})


def with_effects(vehicle: Vehicle) -> Vehicle:
    for name, parameters in ALL_EFFECTS.items():
        vehicle = vehicle.with_effect(name, parameters)
    return vehicle


def theta_of(vehicle: Vehicle, **changes: float) -> Coefficients:
    return Coefficients(*vehicle.nominal)._replace(**changes)


def without_shifts(vehicle: Vehicle) -> Coefficients:
    return theta_of(vehicle, **dict.fromkeys(SHIFTS, 0.0))


def samples(vehicle: Vehicle, n: int = 40) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Random states (3, n), inputs (2, n) and coefficients inside their bounds (17, n)."""
    random = np.random.default_rng(7)
    slow, fast = SPEEDS[vehicle.name]
    v_x = random.uniform(slow, fast, n)
    omega = random.uniform(-2, 2, n) * (1.0 if vehicle.name == "orca" else 0.3)
    state = np.stack([v_x, random.uniform(-0.1, 0.1, n) * v_x, omega])
    inputs = np.stack([random.uniform(-1, 1, n), random.uniform(-0.35, 0.35, n)])
    share = random.uniform(size=(len(COEFFICIENTS), n))
    return state, inputs, vehicle.lower[:, None] + share * (vehicle.upper - vehicle.lower)[:, None]


def advance(
    xp: Any, vehicle: Vehicle, state: Any, inputs: Any, theta: Any, integrator: Integrator, substeps: int
) -> list[Any]:
    """Accelerations of the motion, then the next state and effect states, each entry of shape ``(n,)``."""
    applied, effects = Applied(*inputs), vehicle.active_effects
    effect_states = initial_effect_states(effects, inputs[0], 0.5 * inputs[1])
    q = CarModel(vehicle.constants, 0.04, effects, xp=xp).motion(
        State(*state), applied, Coefficients(*theta), effect_states
    )
    following, carried = CarModel(vehicle.constants, vehicle.sampling_time, effects, integrator, substeps, xp=xp).step(
        State(*state), applied, Coefficients(*theta), effect_states
    )
    return [q.a_x, q.a_y, q.omega_dot, *following, *carried.values()]


@pytest.mark.parametrize("integrator", ["euler", "rk4"])
@pytest.mark.parametrize("load_transfer", [False, True])
@pytest.mark.parametrize("effects", [False, True])
def test_numpy_torch_and_casadi_agree_to_1e_12(
    vehicle: Vehicle, integrator: Integrator, load_transfer: bool, effects: bool
) -> None:
    vehicle = with_load_transfer(vehicle, load_transfer)
    vehicle = with_effects(vehicle) if effects else vehicle
    state, inputs, theta = samples(vehicle)
    by_numpy = np.stack(advance(np, vehicle, state, inputs, theta, integrator, 2))
    by_torch = torch.stack(
        advance(torch, vehicle, *(torch.from_numpy(a) for a in (state, inputs, theta)), integrator, 2)
    ).numpy()
    s, u, th = casadi.SX.sym("s", 3), casadi.SX.sym("u", 2), casadi.SX.sym("theta", 17)
    symbols = [casadi.vertsplit(v) for v in (s, u, th)]
    f = casadi.Function("f", [s, u, th], [casadi.vertcat(*advance(casadi, vehicle, *symbols, integrator, 2))])
    by_casadi = np.array(f.map(state.shape[1])(state, inputs, theta))
    assert len(by_numpy) == (7 if effects else 6)
    for other in (by_torch, by_casadi):
        np.testing.assert_allclose(other, by_numpy, rtol=1e-12, atol=1e-12)


def test_torch_gradients_are_finite_and_equal_casadi_jacobians(vehicle: Vehicle) -> None:
    state, inputs, theta = samples(vehicle)
    state[1:, :5] = 0.0  # driving straight, where arctan2 has one argument zero
    leaves = [torch.from_numpy(a).requires_grad_() for a in (state, inputs, theta)]
    following = advance(torch, vehicle, *leaves, "euler", 1)
    s, u, th = casadi.SX.sym("s", 3), casadi.SX.sym("u", 2), casadi.SX.sym("theta", 17)
    symbols = [casadi.vertsplit(v) for v in (s, u, th)]
    outputs = casadi.vertcat(*advance(casadi, vehicle, *symbols, "euler", 1))
    jacobian = casadi.Function("J", [s, u, th], [casadi.jacobian(outputs, casadi.vertcat(s, u, th))])
    expected = np.stack([np.array(jacobian(*columns)) for columns in zip(state.T, inputs.T, theta.T, strict=True)], 2)
    for row, value in enumerate(following):
        gradients = torch.autograd.grad(value.sum(), leaves, retain_graph=True, materialize_grads=True)
        found = torch.cat(gradients).numpy()
        assert np.isfinite(found).all()
        np.testing.assert_allclose(found, expected[row], rtol=1e-9, atol=1e-9)


def test_a_batch_equals_its_rows_one_by_one(vehicle: Vehicle) -> None:
    state, inputs, theta = samples(vehicle, 6)
    together = np.stack(advance(np, vehicle, state, inputs, theta, "rk4", 1))
    rows = [advance(np, vehicle, state[:, k], inputs[:, k], theta[:, k], "rk4", 1) for k in range(6)]
    np.testing.assert_array_equal(together, np.array(rows).T)


def test_without_slip_and_shifts_there_is_no_lateral_force(vehicle: Vehicle) -> None:
    speed = SPEEDS[vehicle.name][1]
    q = CarModel(vehicle.constants, 0.04).motion(State(speed, 0.0, 0.0), Applied(0.7, 0.0), without_shifts(vehicle))
    assert (q.alpha_f, q.alpha_r, q.F_fy, q.F_ry, q.a_y, q.omega_dot) == (0.0,) * 6
    assert q.a_x == q.F_rx / vehicle.constants.m


def test_straight_coasting_follows_the_closed_form(vehicle: Vehicle) -> None:
    """m dv/dt = -C_r0 - C_r2 v^2 has the solution a tan(atan(v_0 / a) - b t)."""
    theta, m = without_shifts(vehicle), vehicle.constants.m
    v_0, T = SPEEDS[vehicle.name][1], 0.4
    a, b = np.sqrt(theta.C_r0 / theta.C_r2), np.sqrt(theta.C_r0 * theta.C_r2) / m
    state = State(v_0, 0.0, 0.0)
    end = CarModel(vehicle.constants, T, integrator="rk4", substeps=200).step(state, Applied(0.0, 0.0), theta)[0]
    assert end.v_x == pytest.approx(a * np.tan(np.arctan(v_0 / a) - b * T), rel=1e-9)
    assert end.v_y == end.omega == 0.0


def test_constants_of_load_transfer_balance_weight_and_pitching_moment(vehicle: Vehicle) -> None:
    vehicle = with_load_transfer(vehicle, True)
    c, (state, inputs, theta) = vehicle.constants, samples(vehicle)
    q = CarModel(c, 0.04).motion(State(*state), Applied(*inputs), Coefficients(*theta))
    assert np.ptp(q.F_rx) > 0
    np.testing.assert_allclose(q.F_zf + q.F_zr, c.m * GRAVITY, rtol=1e-13)
    np.testing.assert_allclose(c.l_f * q.F_zf - c.l_r * q.F_zr, -c.h_cg * q.F_rx, rtol=1e-9, atol=1e-12 * c.m)


def test_at_rest_the_axles_carry_the_weight_by_the_lever_rule(vehicle: Vehicle) -> None:
    c = with_load_transfer(vehicle, True).constants
    theta = theta_of(vehicle, C_r0=0.0)
    q = CarModel(c, 0.04).motion(State(0.0, 0.0, 0.0), Applied(0.0, 0.0), theta)
    assert q.F_zf == pytest.approx(c.m * GRAVITY * c.l_r / (c.l_f + c.l_r), rel=1e-14)
    assert q.F_zr == pytest.approx(c.m * GRAVITY * c.l_f / (c.l_f + c.l_r), rel=1e-14)


def test_without_load_transfer_forces_are_those_at_the_nominal_load(vehicle: Vehicle) -> None:
    state, inputs, theta = samples(vehicle)
    off = CarModel(with_load_transfer(vehicle, False).constants, 0.04).motion(
        State(*state), Applied(*inputs), Coefficients(*theta)
    )
    on = CarModel(with_load_transfer(vehicle, True).constants, 0.04).motion(
        State(*state), Applied(*inputs), Coefficients(*theta)
    )
    F_z0 = vehicle.constants.F_z0
    np.testing.assert_allclose(on.F_fy, off.F_fy * on.F_zf / F_z0, rtol=1e-12)
    np.testing.assert_allclose(on.F_ry, off.F_ry * on.F_zr / F_z0, rtol=1e-12)


@pytest.mark.parametrize("load_transfer", [False, True])
def test_without_shifts_left_mirrors_right(vehicle: Vehicle, load_transfer: bool) -> None:
    c = with_load_transfer(vehicle, load_transfer).constants
    (v_x, v_y, omega), (r, delta), theta = samples(vehicle)
    level = Coefficients(*theta)._replace(**dict.fromkeys(SHIFTS, 0.0))
    left = CarModel(c, 0.04).motion(State(v_x, v_y, omega), Applied(r, delta), level)
    right = CarModel(c, 0.04).motion(State(v_x, -v_y, -omega), Applied(r, -delta), level)
    np.testing.assert_array_equal(right.a_x, left.a_x)
    np.testing.assert_array_equal(right.a_y, -left.a_y)
    np.testing.assert_array_equal(right.omega_dot, -left.omega_dot)


def test_slip_angles_are_those_of_the_axles_velocities(vehicle: Vehicle) -> None:
    """A car that rotates about a point beside its centre of gravity: each axle's course is known geometry."""
    c, radius, omega = vehicle.constants, 20 * vehicle.constants.l_f, 0.4
    q = CarModel(c, 0.04).motion(State(radius * omega, 0.0, omega), Applied(0.0, 0.0), without_shifts(vehicle))
    assert q.alpha_f == pytest.approx(-np.arctan(c.l_f / radius), rel=1e-14)
    assert q.alpha_r == pytest.approx(np.arctan(c.l_r / radius), rel=1e-14)


def test_the_tyre_peaks_at_D_and_starts_with_slope_B_C_D(vehicle: Vehicle) -> None:
    c, theta = with_load_transfer(vehicle, False).constants, without_shifts(vehicle)._replace(E_f=0.0, C_f=1.5)
    delta = np.linspace(0.0, 1.5, 200001)
    q = CarModel(c, 0.04).motion(State(1.0, 0.0, 0.0), Applied(0.0, delta), theta)
    assert q.F_fy.max() == pytest.approx(theta.D_f, rel=1e-9)
    assert q.F_fy[1] / delta[1] == pytest.approx(theta.B_f * theta.C_f * theta.D_f, rel=1e-6)


def test_a_free_body_keeps_its_velocity_in_the_inertial_frame(vehicle: Vehicle) -> None:
    """Without forces the body frame turns under a constant velocity, which the terms with omega must give back."""
    theta = without_shifts(vehicle)._replace(C_m1=0.0, C_m2=0.0, C_r0=0.0, C_r2=0.0, D_f=0.0, D_r=0.0)
    v, omega, T = np.array([2.0, 0.5]), 0.8, 1.3
    end = CarModel(vehicle.constants, T, integrator="rk4", substeps=400).step(
        State(*v, omega), Applied(0.0, 0.0), theta
    )[0]
    c, s = np.cos(omega * T), np.sin(omega * T)
    np.testing.assert_allclose([end.v_x, end.v_y], [c * v[0] + s * v[1], -s * v[0] + c * v[1]], atol=1e-10)


@pytest.mark.parametrize(("integrator", "order"), [("euler", 1), ("rk4", 4)])
def test_integrators_converge_at_their_order(integrator: Integrator, order: int) -> None:
    vehicle = load_vehicle("av21_paper")
    state, applied, theta = State(30.0, 0.2, 0.1), Applied(0.5, 0.06), theta_of(vehicle)

    def end(substeps: int, method: Integrator) -> np.ndarray:
        return np.array(
            CarModel(vehicle.constants, 0.4, integrator=method, substeps=substeps).step(state, applied, theta)[0],
            dtype=float,
        )

    exact = end(4000, "rk4")
    errors = [np.abs(end(n, integrator) - exact).max() for n in (32, 64, 128)]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    np.testing.assert_allclose(orders, order, atol=0.15)


@pytest.mark.parametrize("integrator", ["euler", "rk4"])
def test_substeps_are_steps_of_the_divided_time(vehicle: Vehicle, integrator: Integrator) -> None:
    state, inputs, theta = samples(vehicle, 5)
    given = Applied(*inputs), Coefficients(*theta)
    T_s, one_by_one = vehicle.sampling_time, State(*state)
    for _ in range(4):
        one_by_one, _ = CarModel(vehicle.constants, T_s / 4, (), integrator).step(one_by_one, *given)
    in_one_go, _ = CarModel(vehicle.constants, T_s, (), integrator, 4).step(State(*state), *given)
    np.testing.assert_allclose(in_one_go, one_by_one, rtol=1e-14)  # increments are summed first: rounding differs


def test_the_default_step_is_one_forward_euler_step(vehicle: Vehicle) -> None:
    state, inputs, theta = samples(vehicle, 5)
    q = CarModel(vehicle.constants, 0.04).motion(State(*state), Applied(*inputs), Coefficients(*theta))
    following = CarModel(vehicle.constants, 0.02).step(State(*state), Applied(*inputs), Coefficients(*theta))[0]
    np.testing.assert_array_equal(following, state + 0.02 * np.stack([q.a_x, q.a_y, q.omega_dot]))


def test_memory_and_context_are_not_changed_by_motion(vehicle: Vehicle) -> None:
    effect_states, context = {"own": 1.0}, {"time": 2.0}
    q = CarModel(vehicle.constants, 0.04).motion(
        State(1.0, 0.0, 0.0), Applied(0.0, 0.0), theta_of(vehicle), effect_states, context=context
    )
    q.effect_states["own"] = 5.0
    assert effect_states == {"own": 1.0}
    assert q.context["time"] == 2.0


def test_published_orca_run_is_reproduced_step_by_step(data: Path) -> None:
    """The published data are a forward-Euler trajectory of these equations; README of the data folder."""
    run = np.load(data / "orca" / "ethz_pure_pursuit.npz")
    vehicle = load_vehicle("orca")
    states, inputs = run["dstates"][3:6], run["inputs"]
    following = CarModel(vehicle.constants, vehicle.sampling_time).step(
        State(*states[:, :-1]), Applied(*inputs), theta_of(vehicle)
    )[0]
    assert states.shape[1] == 1001
    np.testing.assert_allclose(np.stack(following), states[:, 1:], rtol=0, atol=1e-12)
