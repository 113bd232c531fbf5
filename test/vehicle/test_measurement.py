"""Effects on the measurement: what is measured of a motion, back to the motion, and steps of measured states."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from scipy.optimize import brentq

from dynssm_ros.vehicle import Applied, CarModel, Coefficients, State, load_vehicle
from dynssm_ros.vehicle.effects import EFFECTS, Effect, build_effect
from dynssm_ros.vehicle.effects.measurement import MeasurementEffect
from dynssm_ros.vehicle.integrators import Integrator
from dynssm_ros.vehicle.single_track import Motion

AV21 = load_vehicle("av21")
CONSTANTS, THETA = AV21.constants, Coefficients(*AV21.nominal)
STATE, APPLIED = State(30.0, 0.4, 0.2), Applied(0.4, 0.05)
CONTEXT = {"clock": 6460.3}
SENSORS = sorted(name for name, effect in EFFECTS.items() if issubclass(effect, MeasurementEffect))


@dataclass(frozen=True)
class Torque(Effect):
    """Nothing acts but a constant yaw acceleration."""

    angular: float = 0.0

    def accelerations(self, xp: Any, q: Motion) -> None:
        q.a_x, q.a_y, q.omega_dot = 0.0, 0.0, self.angular


def seen(name: str, **parameters: float) -> State:
    return CarModel(CONSTANTS, 0.04, (build_effect(name, parameters),)).measured_state(STATE, {})


def test_off_the_centre_of_gravity_yawing_shows_as_velocity() -> None:
    assert seen("odometry_lever_arm", x=1.2, y=-0.5) == (30.0 + 0.2 * 0.5, 0.4 + 0.2 * 1.2, 0.2)


def test_in_a_turned_frame_the_speed_is_the_same_and_its_direction_is_not() -> None:
    v_x, v_y, omega = seen("odometry_misalignment", angle=0.02)
    assert np.hypot(v_x, v_y) == pytest.approx(np.hypot(30.0, 0.4))
    assert np.arctan2(v_y, v_x) == pytest.approx(np.arctan2(0.4, 30.0) - 0.02)
    assert omega == 0.2


def test_a_bias_is_added() -> None:
    assert seen("yaw_rate_bias", bias=0.05) == (30.0, 0.4, 0.25)


def test_sensors_act_in_the_order_of_the_file() -> None:
    bias, arm = build_effect("yaw_rate_bias", {"bias": 0.1}), build_effect("odometry_lever_arm", {"x": 2.0})
    assert CarModel(CONSTANTS, 0.04, (arm, bias)).measured_state(STATE, {}).v_y == pytest.approx(0.4 + 0.2 * 2.0)
    assert CarModel(CONSTANTS, 0.04, (bias, arm)).measured_state(STATE, {}).v_y == pytest.approx(0.4 + 0.3 * 2.0)


def test_only_sensors_that_are_off_measure() -> None:
    drag, still = build_effect("drag", {"coefficient": 0.2}), build_effect("yaw_rate_bias", {})
    bias = build_effect("yaw_rate_bias", {"bias": 0.1})
    assert CarModel(CONSTANTS, 0.04, (drag, still, bias)).sensors == (bias,)


@pytest.mark.parametrize("name", SENSORS)
def test_the_true_state_comes_back_from_the_measured_one(name: str, acting: Callable[..., dict[str, float]]) -> None:
    chain = (build_effect("odometry_misalignment", {"angle": 0.03}), build_effect(name, acting(name)))
    effect_states = dict.fromkeys(chain[1].EFFECT_STATES, 0.07)
    car = CarModel(CONSTANTS, 0.04, chain)
    measured = car.measured_state(STATE, effect_states)
    np.testing.assert_allclose(car.true_state(measured, effect_states), STATE, rtol=1e-14)
    assert measured != STATE


@pytest.mark.parametrize("integrator", ["euler", "rk4"])
@pytest.mark.parametrize("name", SENSORS)
def test_a_model_steps_what_is_measured_of_the_true_motion(
    name: str, integrator: Integrator, acting: Callable[..., dict[str, float]]
) -> None:
    effects = (build_effect("drag", {"coefficient": 0.3}), build_effect(name, acting(name)))
    plant, model = (CarModel(CONSTANTS, 0.04, effects, integrator, 2, measured=of) for of in (False, True))
    effect_states = plant.settled(STATE, Applied(0.1, 0.02), THETA, context=CONTEXT)
    true, carried = plant.step(STATE, APPLIED, THETA, effect_states)
    found, beside = model.step(model.measured_state(STATE, effect_states), APPLIED, THETA, effect_states)
    np.testing.assert_allclose(found, model.measured_state(true, carried), rtol=1e-13)
    assert beside == pytest.approx(carried, rel=1e-12)


@pytest.mark.parametrize("name", SENSORS)
def test_what_happens_does_not_depend_on_the_sensors(name: str, acting: Callable[..., dict[str, float]]) -> None:
    sensor = (build_effect(name, acting(name)),)
    true, _ = CarModel(CONSTANTS, 0.04, sensor, measured=False).step(STATE, APPLIED, THETA, context=CONTEXT)
    assert true == CarModel(CONSTANTS, 0.04).step(STATE, APPLIED, THETA)[0]


def test_a_filtered_yaw_rate_approaches_a_constant_one_exponentially() -> None:
    lag = build_effect("yaw_rate_lag", {"time_constant": 0.1})
    (name,) = lag.EFFECT_STATES
    effects = (Torque(0.0), lag)
    true, effect_states = CarModel(CONSTANTS, 0.08, effects, "rk4", 40, measured=False).step(
        STATE, APPLIED, THETA, {name: 0.15}
    )
    measured = CarModel(CONSTANTS, 0.04, effects).measured_state(true, effect_states).omega
    assert measured == pytest.approx(0.2 - 0.15 * np.exp(-0.08 / 0.1), rel=1e-9)


def test_a_filtered_yaw_rate_follows_a_ramp_one_time_constant_behind() -> None:
    lag = build_effect("yaw_rate_lag", {"time_constant": 0.1})
    effects = (Torque(1.5), lag)
    true, effect_states = CarModel(CONSTANTS, 1.5, effects, "rk4", 100, measured=False).step(
        STATE, APPLIED, THETA, dict.fromkeys(lag.EFFECT_STATES, 0.0)
    )
    assert true.omega == pytest.approx(0.2 + 1.5 * 1.5)
    assert CarModel(CONSTANTS, 0.04, effects).measured_state(true, effect_states).omega == pytest.approx(
        true.omega - 0.1 * 1.5, rel=1e-5
    )


def test_a_filter_that_the_steps_do_not_resolve_settles() -> None:
    lag = build_effect("yaw_rate_lag", {"time_constant": 0.004})
    effects, effect_states, state = (Torque(1.5), lag), dict.fromkeys(lag.EFFECT_STATES, 0.3), STATE
    for _ in range(2):
        state, effect_states = CarModel(CONSTANTS, 0.04, effects, measured=False).step(
            state, APPLIED, THETA, effect_states
        )
    assert effect_states[lag.EFFECT_STATES[0]] == pytest.approx(0.004 * 1.5)


@pytest.mark.parametrize("time_constant", [0.03, 0.08, 0.2])
def test_behind_one_filtered_row_is_the_yaw_rate_whose_acceleration_explains_the_lag(time_constant: float) -> None:
    """``omega = z + time_constant * domega/dt(omega)``; the yaw damping at this speed is near 10/s."""

    def unexplained(behind: float) -> float:
        omega_dot = CarModel(CONSTANTS, 0.04).motion(STATE._replace(omega=0.2 + behind), APPLIED, THETA).omega_dot
        return float(behind - time_constant * omega_dot)

    lag = build_effect("yaw_rate_lag", {"time_constant": time_constant})
    effect_states = CarModel(CONSTANTS, 0.04, (lag,)).settled(STATE, APPLIED, THETA)
    expected = brentq(unexplained, -1.0, 1.0)
    assert abs(expected) > 0.05
    assert effect_states[lag.EFFECT_STATES[0]] == pytest.approx(expected, rel=0.02)


def test_tyres_relax_behind_a_filtered_yaw_rate_by_the_true_slip() -> None:
    lag, tyres = (
        build_effect("yaw_rate_lag", {"time_constant": 0.08}),
        build_effect("tire_relaxation", {"length": 0.5}),
    )
    effect_states = CarModel(CONSTANTS, 0.04, (tyres, lag)).settled(STATE, APPLIED, THETA)
    true = CarModel(CONSTANTS, 0.04, (lag,)).true_state(STATE, effect_states)
    slip = CarModel(CONSTANTS, 0.04).motion(true, APPLIED, THETA)
    assert [effect_states[name] for name in tyres.EFFECT_STATES] == pytest.approx(
        [slip.alpha_f, slip.alpha_r], rel=1e-12
    )


@pytest.mark.parametrize("delay", [0.01, 0.03, 0.04])
def test_late_odometry_is_early_actuators(delay: float) -> None:
    """From a late measurement on, a step of T_s has the inputs of before for ``delay`` and the present ones after."""
    before, T_s = Applied(0.1, 0.02), 0.04
    late = (build_effect("odometry_delay", {"delay": delay}),)
    effect_states = CarModel(CONSTANTS, 0.04, late).settled(STATE, before, THETA)
    found, _ = CarModel(CONSTANTS, T_s, late).step(STATE, APPLIED, THETA, effect_states)
    share = delay / T_s
    mean = Applied(*(share * old + (1 - share) * new for old, new in zip(before, APPLIED, strict=True)))
    np.testing.assert_allclose(found, CarModel(CONSTANTS, T_s).step(STATE, mean, THETA)[0], rtol=1e-13)


def test_delayed_inputs_keep_their_swing() -> None:
    """The gain of the Pade approximation is 1 and its phase that of the delay, here at 1 Hz."""
    late = build_effect("odometry_delay", {"delay": 0.06})
    h, w = 1e-3, 2 * np.pi
    effect_states: dict[str, Any] = dict.fromkeys(late.EFFECT_STATES, 0.0)
    times = np.arange(0.0, 3.0, h)
    acted = np.empty_like(times)
    for k, t in enumerate(times):
        q = CarModel(CONSTANTS, 0.04, (late,)).motion(
            STATE, Applied(0.0, 0.1 * np.sin(w * t)), THETA, effect_states, h=h
        )
        acted[k] = q.delta
        effect_states = {name: value + h * q.effect_state_rates[name] for name, value in effect_states.items()}
    wave = np.exp(-1j * w * times[2000:])  # the last period
    swing = 2 * np.mean(acted[2000:] * wave)
    assert abs(swing) == pytest.approx(0.1, rel=0.01)
    assert -np.angle(swing) - np.pi / 2 == pytest.approx(w * 0.06, rel=0.02)


@pytest.mark.parametrize("integrator", ["euler", "rk4"])
def test_an_estimate_that_is_set_right_steps_once_a_period_and_drifts_back(integrator: Integrator) -> None:
    values = {"v_x": 0.3, "v_y": -0.2, "omega": 0.05, "period": 0.5, "phase": 0.3}
    car = CarModel(CONSTANTS, 0.04, (build_effect("odometry_correction", values),), integrator, 2)
    sizes = np.array([values["v_x"], values["v_y"], values["omega"]])
    plain = np.array(CarModel(CONSTANTS, 0.04, (), integrator, 2).increment(STATE, APPLIED, THETA)[0])
    off = []
    for clock in 6460.0 + 0.04 * np.arange(50):
        context = {"clock": float(clock)}
        seen = car.measured_state(STATE, car.settled(STATE, APPLIED, THETA, context=context))
        off.append(np.array(car.increment(seen, APPLIED, THETA, context=context)[0]) - plain)
    steps = [k for k, each in enumerate(off) if abs(each[0]) > 0.1]
    assert np.diff(steps).tolist() in ([12, 13, 12], [13, 12, 13], [12, 13], [13, 12], [12, 12, 13], [13, 13, 12])
    for k, each in enumerate(off):
        np.testing.assert_allclose(each, (float(k in steps) - 0.04 / 0.5) * sizes, rtol=0, atol=1e-9)
