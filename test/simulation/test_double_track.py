"""The double-track car: the single-track one where nothing sets its wheels apart, and less grip where something does."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dynssm_ros.simulation.double_track import DoubleTrack
from dynssm_ros.simulation.laps import simulate
from dynssm_ros.simulation.plant import Pose, make_plant
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import Applied, CarModel, Coefficients, State, load_vehicle
from dynssm_ros.vehicle.single_track import StageEffect

AV21, ORCA = load_vehicle("av21"), load_vehicle("orca")
PLAIN = DoubleTrack.of(AV21.constants)
PROPORTIONAL = DoubleTrack(PLAIN.width, PLAIN.roll_front, sensitivity=0.0)


class Keeper(StageEffect):
    """Keeps a copy of what the double track wrote."""

    def forces(self, xp, q):
        self.q, self.F_y = q, q.F_y


def moved(state, applied, *bodies, vehicle=AV21):
    return CarModel(vehicle.constants, 0.04, bodies).motion(
        State(*state), Applied(*applied), Coefficients(*vehicle.nominal)
    )


def sideways(slip, v_x=40.0, body=None):
    """Both axles at one slip angle, without yawing."""
    return moved((v_x, -v_x * np.tan(slip), 0.0), (0.0, 0.0), *([] if body is None else [body]))


def test_straight_ahead_it_is_the_single_track_car():
    for r in (-0.8, 0.0, 0.9):
        single, double = moved((30.0, 0.0, 0.0), (r, 0.0)), moved((30.0, 0.0, 0.0), (r, 0.0), PLAIN)
        np.testing.assert_allclose(
            [double.a_x, double.a_y, double.omega_dot], [single.a_x, single.a_y, single.omega_dot], atol=1e-9
        )


def test_difference_to_the_single_track_car_vanishes_faster_than_the_lateral_acceleration():
    def difference(scale):
        state, applied = (30.0, -0.3 * scale, 0.2 * scale), (0.1, 0.03 * scale)
        single, double = moved(state, applied), moved(state, applied, PLAIN)
        return np.array([double.a_y - single.a_y, double.omega_dot - single.omega_dot])

    ratios = np.abs(difference(0.2) / difference(0.1))
    assert np.all(ratios > 3.5)
    assert np.all(np.abs(difference(0.1)) < 1e-3)


@pytest.mark.parametrize("vehicle", [AV21, ORCA], ids=["av21", "orca"])
def test_plant_follows_the_single_track_one_while_cornering_gently(vehicle):
    start = Pose(0.0, 0.0, 0.0), State(20.0 if vehicle is AV21 else 2.0, 0.0, 0.0)
    cars = [make_plant(vehicle, kind, *start) for kind in ("rk4", "double_track")]
    for _, car in itertools.product(range(50), cars):
        car.advance(Applied(0.2, 0.005))
    np.testing.assert_allclose(cars[1].state, cars[0].state, rtol=2e-3)


def test_with_force_proportional_to_load_nothing_is_lost_sideways():
    single, double = sideways(0.12), sideways(0.12, body=PROPORTIONAL)
    assert abs(single.a_y) > 10
    assert double.a_y == pytest.approx(single.a_y, rel=1e-12)
    assert double.omega_dot == pytest.approx(single.omega_dot, abs=1e-9)


def test_load_sensitivity_costs_grip_with_the_square_of_the_lateral_acceleration():
    def loss(slip):
        single, double = sideways(slip), sideways(slip, body=PLAIN)
        return 1 - double.a_y / single.a_y, double.F_y

    (little, F_little), (much, F_much) = loss(0.02), loss(0.12)
    assert 0.01 < much < 0.1
    assert much / little == pytest.approx((F_much / F_little) ** 2, rel=0.05)
    roll = AV21.constants.h_cg * F_much / PLAIN.width  # neutral roll stiffness: both axles lose alike
    assert much == pytest.approx(PLAIN.sensitivity * (2 * roll / (AV21.constants.m * 9.81)) ** 2, rel=0.02)


def test_stiff_front_in_roll_makes_it_understeer():
    stiff = DoubleTrack(PLAIN.width, PLAIN.roll_front + 0.2)
    assert sideways(0.12, body=stiff).omega_dot < sideways(0.12, body=PLAIN).omega_dot - 0.1


wheel_states = st.tuples(
    st.floats(10, 60), st.floats(-3, 3), st.floats(-1, 1), st.floats(-1, 1), st.floats(-0.3, 0.3), st.floats(-3e4, 3e4)
)


@given(wheel_states)
def test_loads_add_up_and_no_wheel_pulls_at_the_road(drawn):
    *state, r, delta, F_y = drawn
    q = moved(state, (r, delta))
    F_z = PLAIN.wheel_loads(q, F_y)
    assert F_z.front_left + F_z.front_right == pytest.approx(q.F_zf)
    assert F_z.rear_left + F_z.rear_right == pytest.approx(q.F_zr)
    assert min(F_z) >= -1e-9
    assert (F_z.front_right - F_z.front_left) * F_y >= 0


def test_load_transfer_balances_the_moment_of_the_lateral_force():
    q, F_y = moved((40.0, 0.0, 0.2), (0.0, 0.0)), 6000.0
    F_z = PLAIN.wheel_loads(q, F_y)
    couple = (F_z.front_right - F_z.front_left + F_z.rear_right - F_z.rear_left) * PLAIN.width / 2
    assert couple == pytest.approx(AV21.constants.h_cg * F_y)


@given(wheel_states)
def test_mirrored_motion_has_mirrored_accelerations(drawn):
    v_x, v_y, omega, r, delta, _ = drawn
    left = moved((v_x, v_y, omega), (r, delta), PLAIN)
    right = moved((v_x, -v_y, -omega), (r, -delta), PLAIN)
    np.testing.assert_allclose(
        [right.a_x, right.a_y, right.omega_dot], [left.a_x, -left.a_y, -left.omega_dot], atol=1e-8, rtol=1e-9
    )


def test_steered_front_wheels_turn_against_the_bend_with_the_heavier_outer_one():
    state, applied = (25.0, -0.4, 0.5), (0.0, 0.12)
    keeper = Keeper()
    moved(state, applied, PLAIN, keeper)
    q, car = keeper.q, AV21.constants
    axles = car.l_f * q.F_fy * np.cos(0.12) - car.l_r * q.F_ry
    assert q.F_fy > 0
    assert q.M_z < axles  # outer right wheel pulls back more


def test_effects_act_on_it_as_on_the_single_track_car():
    slippery = AV21.with_effect("front_grip", {"factor": 0.8}).active_effects
    plain, less = moved((40.0, -2.0, 0.2), (0.0, 0.05), PLAIN), moved((40.0, -2.0, 0.2), (0.0, 0.05), PLAIN, *slippery)
    assert less.F_fy == pytest.approx(0.8 * plain.F_fy)
    assert less.F_ry == plain.F_ry
    shifted = AV21.with_effect("steering_offset", {"offset": 0.01}).active_effects
    np.testing.assert_allclose(
        moved((40.0, -2.0, 0.2), (0.0, 0.05), PLAIN, *shifted).M_z, moved((40.0, -2.0, 0.2), (0.0, 0.06), PLAIN).M_z
    )


def test_without_load_transfer_in_the_file_there_is_none_sideways_either():
    width = DoubleTrack.of(ORCA.constants).width
    body = DoubleTrack(width, 0.5, sensitivity=0.5)
    q = moved((2.0, -0.2, 0.0), (0.0, 0.0), body, vehicle=ORCA)
    assert q.F_y == pytest.approx(moved((2.0, -0.2, 0.0), (0.0, 0.0), vehicle=ORCA).F_y, rel=1e-12)


def test_laps_on_it_differ_from_the_single_track_ones_in_what_a_model_cannot_know():
    run = simulate(AV21, load_track("road_course"), duration=12.0, plant="double_track", seed=2)
    theta = Coefficients(*AV21.nominal)
    late = np.abs(run.state[:, 0] * run.state[:, 2]) > 8
    q = CarModel(AV21.constants, 0.04).motion(State(*run.state[late].T), Applied(*run.command[late].T), theta)
    p = CarModel(AV21.constants, 0.04, (PLAIN,)).motion(State(*run.state[late].T), Applied(*run.command[late].T), theta)
    assert np.mean(np.abs(q.F_y)) > 1.005 * np.mean(np.abs(p.F_y))
