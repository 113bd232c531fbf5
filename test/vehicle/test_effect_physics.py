"""The physics of each effect against a closed form."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import BSpline

from dynssm_ros.errors import ConfigurationError
from dynssm_ros.vehicle import Applied, CarModel, Coefficients, State, load_vehicle
from dynssm_ros.vehicle.effects import EFFECTS, build_effect
from dynssm_ros.vehicle.single_track import GRAVITY, Motion

AV21 = load_vehicle("av21")
CONSTANTS, THETA = AV21.constants, Coefficients(*AV21.nominal)
M, WHEELBASE = CONSTANTS.m, CONSTANTS.l_f + CONSTANTS.l_r
STATE, APPLIED = State(30.0, 0.4, 0.2), Applied(0.4, 0.05)


def act(state: State = STATE, applied: Applied = APPLIED, context: dict[str, float] | None = None, **effects) -> Motion:
    """The motion with effects given as ``name={parameter: value}``."""
    built = tuple(build_effect(name, parameters) for name, parameters in effects.items())
    return CarModel(CONSTANTS, 0.04, built).motion(state, applied, THETA, context=context)


PLAIN = act()


def accelerations(q: Motion) -> tuple[float, float, float]:
    return q.a_x, q.a_y, q.omega_dot


def test_steering_gain_and_offset_steer() -> None:
    assert accelerations(act(steering_gain={"factor": 1.2})) == accelerations(act(applied=Applied(0.4, 0.05 * 1.2)))
    offset = act(applied=Applied(0.4, 0.05 + 0.01))
    assert accelerations(act(steering_offset={"offset": 0.01})) == accelerations(offset)


def test_drag_takes_its_coefficient_times_speed_squared() -> None:
    q = act(drag={"coefficient": 0.5})
    assert q.F_rx - PLAIN.F_rx == pytest.approx(-0.5 * 30.0**2)


def test_rolling_resistance_slows_any_mass_alike() -> None:
    q = act(State(10.0, 0.0, 0.0), Applied(0.0, 0.0), rolling_resistance={"coefficient": 0.02})
    plain = act(State(10.0, 0.0, 0.0), Applied(0.0, 0.0))
    assert q.a_x - plain.a_x == pytest.approx(-0.02 * GRAVITY)


@pytest.mark.parametrize("r", [0.8, -0.5])
def test_drive_gain_scales_drive_and_brakes_and_not_the_resistances(r: float) -> None:
    gained, plain, coasting = (
        act(applied=Applied(r, 0.0), drive_gain={"factor": 1.3}).F_rx,
        act(applied=Applied(r, 0.0)).F_rx,
        act(applied=Applied(0.0, 0.0)).F_rx,
    )
    assert gained - coasting == pytest.approx(1.3 * (plain - coasting))


def test_mass_divides_what_the_forces_do_and_weighs_on_the_axles() -> None:
    q = act(State(30.0, 0.0, 0.0), Applied(0.5, 0.0), mass={"factor": 1.25})
    assert q.a_x == pytest.approx(act(State(30.0, 0.0, 0.0), Applied(0.5, 0.0)).a_x / 1.25)
    q = act(mass={"factor": 1.25})
    assert q.F_zf + q.F_zr == pytest.approx(1.25 * M * GRAVITY)
    assert q.F_fy / PLAIN.F_fy == pytest.approx(q.F_zf / PLAIN.F_zf)


def test_yaw_inertia_divides_the_yaw_acceleration_alone() -> None:
    q = act(yaw_inertia={"factor": 1.6})
    assert q.omega_dot == pytest.approx(PLAIN.omega_dot / 1.6)
    assert (q.a_x, q.a_y) == (PLAIN.a_x, PLAIN.a_y)


def test_steering_curve_bends_the_angle_and_may_differ_between_the_sides() -> None:
    for delta in (0.1, -0.1):
        bent = delta + 0.5 * delta**2 + 4.0 * delta**3
        q = act(applied=Applied(0.4, delta), steering_curve={"quadratic": 0.5, "cubic": 4.0})
        assert accelerations(q) == pytest.approx(accelerations(act(applied=Applied(0.4, bent))))


@pytest.mark.parametrize("steered", [0.08, 0.4])
def test_the_least_curve_turns_the_wheels_as_much_as_the_least_gain(steered: float) -> None:
    least = {name: EFFECTS[name].least(CONSTANTS, steered) for name in ("steering_gain", "steering_curve")}
    gain, curve = ({"factor": 1.0 + least["steering_gain"]}, {"cubic": least["steering_curve"]})
    turned = [
        act(applied=Applied(0.4, steered), **{name: values}) for name, values in zip(least, (gain, curve), strict=True)
    ]
    assert accelerations(turned[0]) == pytest.approx(accelerations(turned[1]))
    amount = EFFECTS["steering_curve"].amount
    assert amount({"quadratic": 0.3, "cubic": 0.0}) == pytest.approx(amount({"cubic": 3.0})), (
        "both turn them alike at 0.1 rad"
    )


@pytest.mark.parametrize(("r", "acts"), [(0.5, 0.4), (0.05, 0.0), (-0.05, 0.0), (-0.5, -0.4)])
def test_within_the_dead_band_the_throttle_does_nothing(r: float, acts: float) -> None:
    q = act(applied=Applied(r, 0.05), throttle_dead_band={"width": 0.1})
    assert accelerations(q) == pytest.approx(accelerations(act(applied=Applied(acts, 0.05))))


def test_beyond_the_power_limit_throttle_and_speed_give_no_more_power() -> None:
    v_0 = 5.0
    limited = {"inverse_speed": 1.0 / v_0}
    at = act(applied=Applied(1.0, 0.0), power_limit=limited)
    assert 0.99 < at.F_d * STATE.v_x / (PLAIN.theta.C_m1 * v_0) < 1.0
    assert at.F_rx - at.F_d == pytest.approx(PLAIN.F_rx - PLAIN.F_d)
    gentle = Applied(0.1, 0.0)
    assert act(applied=gentle, power_limit=limited).F_d == pytest.approx(act(applied=gentle).F_d, rel=0.01)
    brakes = Applied(-1.0, 0.0)
    assert accelerations(act(applied=brakes, power_limit=limited)) == accelerations(act(applied=brakes))


def test_front_drive_turns_with_the_front_wheels() -> None:
    share = 0.4
    q, pulled = act(front_drive={"share": share}), share * PLAIN.F_d
    assert q.F_x - PLAIN.F_x == pytest.approx(pulled * (np.cos(APPLIED.delta) - 1.0))
    assert q.F_y - PLAIN.F_y == pytest.approx(pulled * np.sin(APPLIED.delta))
    assert q.M_z - PLAIN.M_z == pytest.approx(CONSTANTS.l_f * pulled * np.sin(APPLIED.delta))
    straight = Applied(0.4, 0.0)
    assert accelerations(act(applied=straight, front_drive={"share": 1.0})) == accelerations(act(applied=straight))


def test_grip_scales_both_axles() -> None:
    q = act(grip={"factor": 0.7})
    assert (q.F_fy, q.F_ry) == pytest.approx((0.7 * PLAIN.F_fy, 0.7 * PLAIN.F_ry))


def test_on_another_road_the_peak_shrinks_and_the_stiffness_stays() -> None:
    slow = State(30.0, 0.0, 0.0)
    little, plain = Applied(0.0, 1e-4), act(slow, Applied(0.0, 1e-4))
    other = {"factor": 0.5, "similarity": 1.0}
    offset = act(slow, Applied(0.0, 0.0))
    of_plain = plain.F_fy - offset.F_fy
    of_other = act(slow, little, grip=other).F_fy - act(slow, Applied(0.0, 0.0), grip=other).F_fy
    assert of_other == pytest.approx(of_plain, rel=0.05)
    peak = max(act(slow, Applied(0.0, delta)).F_fy for delta in np.linspace(0.0, 0.4, 200))
    assert max(act(slow, Applied(0.0, d), grip=other).F_fy for d in np.linspace(0.0, 0.4, 200)) == pytest.approx(
        0.5 * peak, rel=0.01
    )


def test_grip_of_an_axle_scales_that_one() -> None:
    front, rear = act(front_grip={"factor": 0.8}), act(rear_grip={"factor": 0.8})
    assert (front.F_fy, front.F_ry) == (0.8 * PLAIN.F_fy, PLAIN.F_ry)
    assert (rear.F_fy, rear.F_ry) == (PLAIN.F_fy, 0.8 * PLAIN.F_ry)


def test_downforce_adds_to_the_weight_with_speed_squared_and_by_its_balance() -> None:
    q = act(downforce={"coefficient": 1.5, "balance": 0.4})
    pressed = 1.5 * 30.0**2
    assert q.F_zf + q.F_zr == pytest.approx(M * GRAVITY + pressed)
    assert q.F_zf - PLAIN.F_zf == pytest.approx(0.4 * pressed)
    assert q.F_ry / PLAIN.F_ry == pytest.approx(q.F_zr / PLAIN.F_zr)


def test_a_higher_centre_of_gravity_moves_more_load_between_the_axles() -> None:
    still = M * GRAVITY * CONSTANTS.l_f / WHEELBASE
    q = act(load_transfer={"height": 0.05})
    assert q.F_zr - still == pytest.approx((CONSTANTS.h_cg / WHEELBASE + 0.05) * PLAIN.F_rx)
    assert act(load_transfer={"height": -0.2}).F_zr == pytest.approx(still)  # on the ground


def test_load_transfer_of_a_car_without_any_begins_at_the_ground() -> None:
    car = load_vehicle("orca")
    theta, constants = Coefficients(*car.nominal), car.constants
    effects = (build_effect("load_transfer", {"height": 0.1}),)
    q = CarModel(constants, 0.04, effects).motion(State(2.0, 0.0, 0.0), Applied(0.6, 0.1), theta)
    assert q.F_zr - constants.F_z0 == pytest.approx(0.1 * q.F_rx)
    assert constants.F_z0 - q.F_zf == pytest.approx(0.1 * q.F_rx)


def test_load_sensitivity_leaves_the_axles_as_they_are_at_rest() -> None:
    effects = (build_effect("load_sensitivity", {"exponent": 0.7}),)
    flat = CONSTANTS.model_copy(update={"h_cg": 0.0, "F_z0": CONSTANTS.m * GRAVITY / 2})
    state, applied = State(30.0, 0.5, 0.2), Applied(0.5, 0.03)
    plain, sensitive = (CarModel(flat, 0.04, these).motion(state, applied, THETA) for these in ((), effects))
    assert (sensitive.F_fy, sensitive.F_ry) == pytest.approx((plain.F_fy, plain.F_ry), rel=1e-12)
    high = flat.model_copy(update={"h_cg": 0.3})
    plain, sensitive = (CarModel(high, 0.04, these).motion(state, applied, THETA) for these in ((), effects))
    rest = flat.m * GRAVITY * flat.l_r / (flat.l_f + flat.l_r)
    assert plain.F_zf < 0.99 * rest
    assert sensitive.F_fy / plain.F_fy == pytest.approx((plain.F_zf / rest) ** -0.3, rel=1e-12)


def test_load_sensitivity_of_a_car_without_load_transfer_is_one_clear_line() -> None:
    expected = "effect load_sensitivity cannot act: load_transfer false; expected axle loads that change"
    with pytest.raises(ConfigurationError, match=expected):
        load_vehicle("orca").with_effect("load_sensitivity", {"exponent": 0.7})
    assert load_vehicle("orca").with_effect("load_sensitivity", {}).active_effects[0].is_neutral


def test_relaxing_tyres_reach_their_slip_over_the_distance_rolled() -> None:
    relaxing = (build_effect("tire_relaxation", {"length": 0.6}),)
    front, rear = relaxing[0].EFFECT_STATES
    # too heavy to be moved by its tyres, so that speed and slip stay as the slip angles build up
    heavy = CONSTANTS.model_copy(update={"m": 1e9, "h_cg": 0.0, "load_transfer": False})
    theta, state = THETA._replace(I_z=1e12), State(20.0, 0.0, 0.0)
    _, effect_states = CarModel(heavy, 0.03, relaxing, "rk4", 100).step(state, APPLIED, theta, {front: 0.0, rear: 0.0})
    assert effect_states[front] == pytest.approx(APPLIED.delta * (1 - np.exp(-20.0 * 0.03 / 0.6)), rel=1e-3)
    assert effect_states[rear] == pytest.approx(0.0, abs=1e-6)


def test_relaxing_tyres_pull_by_the_slip_that_they_have_reached() -> None:
    relaxing = build_effect("tire_relaxation", {"length": 0.6})
    reached = dict(zip(relaxing.EFFECT_STATES, (0.01, -0.02), strict=True))
    q = CarModel(CONSTANTS, 0.04, (relaxing,)).motion(STATE, APPLIED, THETA, reached)
    assert (q.alpha_f, q.alpha_r) == pytest.approx((0.01, -0.02))


@pytest.mark.parametrize("r", [0.3, -0.4])
def test_combined_slip_keeps_the_rear_on_the_friction_ellipse(r: float) -> None:
    plain, q = act(applied=Applied(r, 0.05)), act(applied=Applied(r, 0.05), combined_slip={"strength": 1.0})
    along = q.F_d / (THETA.D_r * q.F_zr / CONSTANTS.F_z0)
    assert 0.2 < abs(along) < 0.9
    assert (q.F_ry / plain.F_ry) ** 2 + along**2 == pytest.approx(1.0)
    assert q.F_fy == plain.F_fy
    rolling = act(applied=Applied(0.0, 0.05), combined_slip={"strength": 1.0})
    assert rolling.F_ry == pytest.approx(act(applied=Applied(0.0, 0.05)).F_ry)


def test_combined_slip_beyond_the_ellipse_leaves_a_little() -> None:
    state = State(5.0, 0.1, 0.1)
    plain, q = act(state, Applied(1.0, 0.1)), act(state, Applied(1.0, 0.1), combined_slip={"strength": 1.5})
    assert 0.1 < q.F_ry / plain.F_ry < 0.3


def test_bank_pulls_towards_the_lower_side_by_the_weight() -> None:
    q = act(road_bank={"angle": 0.1})
    assert q.a_y - PLAIN.a_y == pytest.approx(-GRAVITY * np.sin(0.1))
    assert (q.a_x, q.omega_dot) == (PLAIN.a_x, PLAIN.omega_dot)


def test_measured_roll_is_a_bank() -> None:
    q = act(context={"roll": 0.05}, road_bank={"roll_gain": 0.8})
    assert accelerations(q) == pytest.approx(accelerations(act(road_bank={"angle": 0.8 * 0.05})))


def test_grade_holds_the_car_back_uphill() -> None:
    q = act(road_grade={"angle": 0.05})
    assert q.a_x - PLAIN.a_x == pytest.approx(-GRAVITY * np.sin(0.05))
    assert (q.a_y, q.omega_dot) == (PLAIN.a_y, PLAIN.omega_dot)


def bank_at(s: float, bend: float = 0.0, **parameters: float) -> float:
    q = act(context={"s": s, "lap_length": 2000.0, "bend": bend}, road_bank=parameters)
    return float(np.arcsin((PLAIN.a_y - q.a_y) / GRAVITY))


def test_a_banked_section_is_where_the_file_says() -> None:
    corner = {"section": 0.2, "centre": 0.95, "length": 0.2}  # from 1700 m over the line to 100 m
    assert bank_at(1900.0, **corner) == pytest.approx(0.2, rel=1e-3)
    assert bank_at(1900.0 - 2000.0, **corner) == pytest.approx(0.2, rel=1e-3)
    assert bank_at(1900.0 + 6000.0, **corner) == pytest.approx(0.2, rel=1e-3)
    assert bank_at(1700.0, **corner) == pytest.approx(0.1, rel=1e-3)
    assert bank_at(100.0, **corner) == pytest.approx(0.1, rel=1e-3)
    assert abs(bank_at(900.0, **corner)) < 1e-6
    assert bank_at(900.0, angle=0.03, **corner) == pytest.approx(0.03, abs=1e-6)


def test_a_curve_of_the_bank_is_the_periodic_cubic_spline_of_its_coefficients() -> None:
    coefficients = np.random.default_rng(4).uniform(-0.1, 0.1, 7)
    knots = {f"knot_{k}": float(value) for k, value in enumerate(coefficients, 1)}
    around = np.tile([-coefficients.sum(), *coefficients], 3)
    # a basis function of degree 3 is centred two knots after the first of its five
    spline = BSpline(np.arange(-10.0, 18.0) * 250.0, around, 3)
    places = np.linspace(0.0, 2000.0, 41)
    expected = spline(places)
    np.testing.assert_allclose([bank_at(float(s), **knots) for s in places], expected, atol=1e-12)
    assert bank_at(300.0 + 4000.0, angle=0.02, **knots) == pytest.approx(0.02 + float(spline(300.0)))
    assert np.mean(expected[:-1]) == pytest.approx(0.0, abs=1e-9), "what leans to one side leans to the other elsewhere"


def test_a_cambered_road_leans_into_its_bends() -> None:
    assert bank_at(0.0, bend=1.0, camber=0.1) == pytest.approx(-0.1), "left bend: the right side is up"
    assert bank_at(0.0, bend=-0.5, camber=0.1) == pytest.approx(0.05)
    assert bank_at(0.0, bend=0.5, camber=0.1, angle=0.02) == pytest.approx(-0.03)


@pytest.mark.parametrize("theta", [0.0, 0.7, 2.5])
def test_wind_pushes_in_its_direction_wherever_the_car_heads(theta: float) -> None:
    state, applied = State(30.0, 0.0, 0.0), Applied(0.0, 0.0)
    q = act(state, applied, {"theta": theta}, crosswind={"x": 0.0, "y": 4.0, "side": 5.0})
    plain = act(state, applied)
    w_x, w_y = 4.0 * np.sin(theta), 4.0 * np.cos(theta)
    air = np.hypot(30.0 - w_x, -w_y)
    assert q.F_y - plain.F_y == pytest.approx(5.0 * THETA.C_r2 * air * w_y)
    assert q.F_x - plain.F_x == pytest.approx(THETA.C_r2 * (30.0**2 - (30.0 - w_x) ** 2))
    assert q.M_z == plain.M_z


def test_wind_as_fast_as_the_car_leaves_no_drag() -> None:
    q = act(State(20.0, 0.0, 0.0), Applied(0.0, 0.0), {"theta": np.pi / 2}, crosswind={"x": 0.0, "y": 20.0})
    assert q.F_rx == pytest.approx(-THETA.C_r0)


def test_wind_ahead_of_the_centre_of_gravity_turns_the_car() -> None:
    straight = State(30.0, 0.0, 0.0), Applied(0.0, 0.0), {"theta": 0.0}
    q, centred = (act(*straight, crosswind={"y": 5.0, "arm": arm}) for arm in (0.3, 0.0))
    assert q.M_z - centred.M_z == pytest.approx(0.3 * (q.F_y - act(*straight).F_y))
    assert q.M_z > centred.M_z


def test_grip_drifts_with_time_and_never_below_a_tenth() -> None:
    q = act(context={"t": 100.0}, grip_drift={"rate": -0.002})
    assert (q.F_fy, q.F_ry) == pytest.approx((0.8 * PLAIN.F_fy, 0.8 * PLAIN.F_ry))
    assert act(context={"t": 1e4}, grip_drift={"rate": -0.002}).F_fy == pytest.approx(0.1 * PLAIN.F_fy)


def test_a_patch_takes_grip_on_its_stretch_of_the_lap_only() -> None:
    patch = {"factor": 0.6, "centre": 0.25, "length": 0.1}
    on, edge, off = (act(context={"s": s, "lap_length": 2000.0}, grip_patch=patch) for s in (500, 400, 1500))
    assert (on.F_fy, on.F_ry) == pytest.approx((0.6 * PLAIN.F_fy, 0.6 * PLAIN.F_ry), rel=1e-3)
    assert edge.F_fy == pytest.approx(0.8 * PLAIN.F_fy, rel=1e-3)
    assert (off.F_fy, off.F_ry) == pytest.approx((PLAIN.F_fy, PLAIN.F_ry), rel=1e-6)


@pytest.mark.parametrize("omega", [0.1, -0.1])
def test_a_locked_differential_turns_against_the_yaw_rate(omega: float) -> None:
    state, applied = State(30.0, 0.0, omega), Applied(0.0, 0.0)
    q, plain = act(state, applied, locked_differential={"stiffness": 20.0}), act(state, applied)
    width = 0.55 * WHEELBASE
    linear = -20.0 * q.F_zr * width**2 * omega / (4 * 30.0)
    assert q.M_z - plain.M_z == pytest.approx(linear, rel=1e-3)
    assert (q.F_x, q.F_y) == (plain.F_x, plain.F_y)


def test_a_locked_differential_pushes_no_harder_than_the_tyres_grip() -> None:
    state, applied = State(1.0, 0.0, 2.0), Applied(0.0, 0.0)
    q, plain = act(state, applied, locked_differential={"stiffness": 60.0}), act(state, applied)
    friction = THETA.D_r / CONSTANTS.F_z0 * q.F_zr / 2
    assert plain.M_z - q.M_z == pytest.approx(friction * 0.55 * WHEELBASE, rel=1e-6)


@pytest.mark.parametrize("share", [0.25, 0.5, 1.0])
def test_a_drive_map_is_a_table_over_throttle_and_speed(share: float) -> None:
    bent = {"half": 0.8, "middle": 1.2, "half_at_top": 0.7, "brake": 1.3, "top": 40.0}
    for v_x, over_speed in ((4.0, 1.072), (20.0, 1.2), (40.0, 1.0), (50.0, 1.0)):
        state, applied = State(v_x, 0.0, 0.0), Applied(share, 0.0)
        fast = min(v_x / 40.0, 1.0)
        expected = over_speed * (1 - 0.4 * (1 - share)) * (1 - 0.6 * (1 - share) * fast)
        plain = act(state, applied)
        assert act(state, applied, drive_map=bent).F_d == pytest.approx(expected * plain.F_d, rel=1e-6)
    state, brakes = State(30.0, 0.4, 0.2), Applied(-share, 0.05)
    plain, mapped = act(state, brakes), act(state, brakes, drive_map=bent)
    assert mapped.F_d == pytest.approx(1.3 * plain.F_d)
    assert mapped.F_rx - plain.F_rx == pytest.approx(0.3 * plain.F_d)


def test_a_gear_changes_the_drive_and_not_the_brakes() -> None:
    shift = {"factor": 0.7, "gap": 0.4, "up": 40.0, "down": 35.0, "time_constant": 0.2}
    assert act(gear_shift=shift).F_rx == PLAIN.F_rx  # below
    fast, brakes = State(50.0, 0.4, 0.2), Applied(-0.3, 0.05)
    assert act(fast, gear_shift=shift).F_d == pytest.approx(0.7 * act(fast).F_d)
    assert act(fast, brakes, gear_shift=shift).F_rx == act(fast, brakes).F_rx
    effect, car = build_effect("gear_shift", shift), CarModel(CONSTANTS, 0.04, (build_effect("gear_shift", shift),))
    for state, rate in ((fast, 0.5 / 0.2), (State(30.0, 0.4, 0.2), -0.5 / 0.2), (State(37.0, 0.4, 0.2), 0.0)):
        q = car.motion(state, APPLIED, THETA, {effect.EFFECT_STATES[0]: 0.5})
        assert q.effect_state_rates[effect.EFFECT_STATES[0]] == pytest.approx(rate)
        assert q.F_d == pytest.approx(0.85 * (1 - 0.4) * act(state).F_d)  # in the middle of a change
