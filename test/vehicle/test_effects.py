"""Effects: each acts after its own stage, carries its effect states, and is absent at its neutral value."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import pytest

from dynssm_ros.errors import ConfigurationError
from dynssm_ros.vehicle import Applied, CarModel, Coefficients, State, load_vehicle
from dynssm_ros.vehicle.effects import (
    CONTEXT_UNITS,
    EFFECTS,
    Effect,
    Parameter,
    build_effect,
    initial_effect_states,
    parse_effect,
    require_context,
)
from dynssm_ros.vehicle.integrators import Integrator
from dynssm_ros.vehicle.single_track import Array, Motion, StageEffect

VEHICLE = load_vehicle("av21_paper")
CONSTANTS = VEHICLE.constants
THETA = Coefficients(*VEHICLE.nominal)
STATE, APPLIED = State(30.0, 0.4, 0.2), Applied(0.4, 0.05)
CONTEXT = {
    "t": 60.0, "clock": 6460.3, "s": 1900.0, "lap_length": 4000.0, "bend": 0.6, "x": 5.0, "y": -3.0, "theta": 1.1,
    "roll": 0.03,
}  # fmt: skip


def act(*effects: Effect, effect_states: dict[str, Array] | None = None) -> Motion:
    return CarModel(CONSTANTS, 0.04, effects).motion(STATE, APPLIED, THETA, effect_states)


@dataclass(frozen=True)
class Push(Effect):
    force: float = 0.0

    def drive(self, xp: Any, q: Motion) -> None:
        q.F_rx = q.F_rx + self.force


def test_an_effect_on_the_drive_also_moves_the_loads_that_follow() -> None:
    plain, pushed = act(), act(Push(1000.0))
    assert pushed.F_rx - plain.F_rx == 1000.0
    wheelbase = CONSTANTS.l_f + CONSTANTS.l_r
    assert pushed.F_zr - plain.F_zr == pytest.approx(CONSTANTS.h_cg * 1000.0 / wheelbase, rel=1e-9)


def test_each_stage_of_the_equations_can_be_entered_and_in_order() -> None:
    seen: list[str] = []

    stages = ("inputs", "slip", "drive", "loads", "tyres", "forces", "accelerations")
    noted = {stage: lambda self, xp, q, stage=stage: seen.append(stage) for stage in stages}
    Spy = type("Spy", (StageEffect,), noted)
    CarModel(CONSTANTS, 0.04, (Spy(), Spy())).motion(STATE, APPLIED, THETA)
    assert seen == [stage for stage in stages for _ in range(2)]
    assert (*stages, "measured") == StageEffect.HOOKS


def test_effects_act_in_the_order_given() -> None:
    @dataclass(frozen=True)
    class Double(Effect):
        def drive(self, xp: Any, q: Motion) -> None:
            q.F_rx = 2 * q.F_rx

    plain = act().F_rx
    assert act(Push(100.0), Double()).F_rx == 2 * (plain + 100.0)
    assert act(Double(), Push(100.0)).F_rx == 2 * plain + 100.0


@pytest.mark.parametrize(
    ("effect", "target", "start"),
    [
        (build_effect("throttle_lag", {"time_constant": 0.2}), APPLIED.r, 0.1),
        (build_effect("steering_lag", {"time_constant": 0.2}), APPLIED.delta, 0.02),
        (build_effect("odometry_delay", {"delay": 0.2}), APPLIED.r, 0.1),
    ],
    ids=["throttle_lag", "steering_lag", "odometry_delay"],
)
def test_a_lag_approaches_its_input_exponentially(effect: Effect, target: float, start: float) -> None:
    name, T, tau = effect.EFFECT_STATES[0], 0.3, 0.1 if effect.NAME == "odometry_delay" else 0.2
    effect_states = initial_effect_states((effect,), 0.1, 0.02)
    assert effect_states[name] == start
    _, effect_states = CarModel(CONSTANTS, T, (effect,), "rk4", 100).step(STATE, APPLIED, THETA, effect_states)
    assert effect_states[name] == pytest.approx(target + (start - target) * np.exp(-T / tau), rel=1e-8)


def test_a_lag_under_forward_euler_decays_by_its_own_factor() -> None:
    effect = build_effect("steering_lag", {"time_constant": 0.2})
    effect_states: dict[str, Array] = {"steering_lag.delta": 0.0}
    state = STATE
    for _ in range(5):
        state, effect_states = CarModel(CONSTANTS, 0.04, (effect,)).step(state, APPLIED, THETA, effect_states)
    assert effect_states["steering_lag.delta"] == pytest.approx(APPLIED.delta * (1 - (1 - 0.04 / 0.2) ** 5), rel=1e-12)


def test_a_lag_that_the_steps_do_not_resolve_settles_and_acts_as_its_mean_over_the_step() -> None:
    tau, T_s = 0.004, 0.04
    effect = build_effect("steering_lag", {"time_constant": tau})
    state, effect_states = CarModel(CONSTANTS, T_s, (effect,)).step(STATE, APPLIED, THETA, {"steering_lag.delta": 0.0})
    assert effect_states["steering_lag.delta"] == APPLIED.delta
    mean = APPLIED.delta * (1 - tau / T_s * (1 - np.exp(-T_s / tau)))
    expected, _ = CarModel(CONSTANTS, T_s).step(STATE, APPLIED._replace(delta=mean), THETA)
    np.testing.assert_allclose(state, expected, rtol=0, atol=1e-5)


def test_the_lagged_steering_is_what_acts_on_the_tyres() -> None:
    lag = build_effect("steering_lag", {"time_constant": 0.1})
    lagged_motion = act(lag, effect_states={"steering_lag.delta": 0.02})
    direct = CarModel(CONSTANTS, 0.04).motion(STATE, APPLIED._replace(delta=0.02), THETA)
    found = (lagged_motion.a_x, lagged_motion.a_y, lagged_motion.omega_dot)
    np.testing.assert_allclose(found, (direct.a_x, direct.a_y, direct.omega_dot), rtol=1e-12)


def test_states_of_effects_start_settled_one_behind_the_other() -> None:
    chain = (build_effect("steering_offset", {"offset": 0.01}), build_effect("steering_lag", {"time_constant": 0.1}))
    assert initial_effect_states(chain, 0.3, 0.02) == {"steering_lag.delta": 0.02 + 0.01}
    known = {"steering_lag.delta": 0.5}
    assert CarModel(CONSTANTS, 0.04, chain).settled(STATE, APPLIED, THETA, known) == known
    settled, _ = CarModel(CONSTANTS, 0.04, chain).step(STATE, APPLIED, THETA)
    plain, _ = CarModel(CONSTANTS, 0.04, chain[:1]).step(STATE, APPLIED, THETA)
    np.testing.assert_allclose(settled, plain, rtol=1e-15)


def advanced(integrator: Integrator, *effects: Effect) -> State:
    """Two half steps after the inputs have changed to ``APPLIED``."""
    context = CONTEXT if effects else {}
    effect_states = CarModel(CONSTANTS, 0.04, effects).settled(STATE, Applied(0.1, 0.02), THETA, context=context)
    return CarModel(CONSTANTS, 0.04, effects, integrator, 2).step(
        STATE, APPLIED, THETA, effect_states, context=context
    )[0]


@pytest.mark.parametrize("integrator", ["euler", "rk4"])
@pytest.mark.parametrize("name", sorted(EFFECTS))
def test_a_neutral_effect_changes_nothing(name: str, integrator: Integrator) -> None:
    neutral = {key: about.neutral for key, about in EFFECTS[name].PARAMETERS.items()}
    effect = build_effect(name, neutral)
    assert effect.is_neutral
    assert effect.carries == effect.needs == ()
    assert initial_effect_states((effect,), *APPLIED) == {}
    plain = advanced(integrator)
    found, effect_states = CarModel(CONSTANTS, 0.04, (effect,), integrator, 2).step(STATE, APPLIED, THETA)
    assert found == plain
    assert effect_states == {}


@pytest.mark.parametrize("integrator", ["euler", "rk4"])
@pytest.mark.parametrize("name", sorted(EFFECTS))
def test_the_formulas_vanish_at_the_neutral_value_too(name: str, integrator: Integrator) -> None:
    """An array is evaluated whatever it holds, so this is the physics and not the shortcut."""
    effect = EFFECTS[name](**{key: np.array(about.neutral) for key, about in EFFECTS[name].PARAMETERS.items()})
    assert not effect.is_neutral
    np.testing.assert_allclose(advanced(integrator, effect), advanced(integrator), rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize("name", sorted(EFFECTS))
def test_an_effect_grows_from_nothing(name: str, acting: Callable[..., dict[str, float]]) -> None:
    plain = np.array(advanced("euler"))
    large, small = (
        np.abs(advanced("euler", build_effect(name, acting(name, share))) - plain).max() for share in (1e-3, 1e-4)
    )
    assert small < 0.2 * large < 0.02


@pytest.mark.parametrize("name", sorted(EFFECTS))
def test_every_shipped_effect_is_fully_described(name: str) -> None:
    effect = EFFECTS[name]
    assert name == effect.NAME
    assert effect.__doc__
    for sentence in (effect.SUMMARY, effect.ADVICE):
        assert sentence[0].isupper()
        assert sentence.endswith(".")
    assert effect.MANOEUVRE[0].islower()
    assert {f.name for f in fields(effect)} == set(effect.PARAMETERS)
    assert effect().parameters == {key: about.neutral for key, about in effect.PARAMETERS.items()}
    for about in effect.PARAMETERS.values():
        assert isinstance(about, Parameter)
        assert about.unit
        assert about.lower <= about.neutral <= about.upper
        assert about.lower < about.upper
        assert set(about.context) <= set(CONTEXT_UNITS)
    for variant in effect.variants():
        assert set(variant) <= set(effect.PARAMETERS)
        assert not all(effect.PARAMETERS[key].shape for key in variant)


@pytest.mark.parametrize("name", sorted(EFFECTS))
def test_each_set_of_parameters_that_is_tried_has_a_size(name: str) -> None:
    for parameters in EFFECTS[name].variants():
        about = {p: EFFECTS[name].PARAMETERS[p] for p in parameters}
        assert EFFECTS[name].amount({p: each.neutral for p, each in about.items()}) == 0.0
        there = {p: each.neutral if each.shape else (each.lower + 2 * each.upper) / 3 for p, each in about.items()}
        assert EFFECTS[name].amount(there) > 0.0, parameters


def test_the_library_is_complete() -> None:
    assert set(EFFECTS) == {
        "steering_offset", "steering_gain", "steering_lag", "throttle_lag", "drag", "rolling_resistance", "drive_gain",
        "mass", "yaw_inertia", "front_grip", "rear_grip", "downforce", "load_transfer", "tire_relaxation",
        "combined_slip", "road_bank", "road_grade", "crosswind", "grip_drift", "grip_patch", "locked_differential",
        "load_sensitivity", "grip", "steering_curve", "throttle_dead_band", "power_limit", "front_drive", "gear_shift",
        "drive_map",
        "odometry_lever_arm", "odometry_misalignment", "odometry_delay", "odometry_correction", "yaw_rate_bias",
        "yaw_rate_lag",
    }  # fmt: skip


@pytest.mark.parametrize("name", sorted(EFFECTS))
def test_every_shipped_effect_acts_away_from_its_neutral_value(
    name: str, acting: Callable[..., dict[str, float]]
) -> None:
    effect = build_effect(name, acting(name))
    effect_states = CarModel(CONSTANTS, 0.04, (effect,)).settled(STATE, APPLIED, THETA, context=CONTEXT)
    assert set(effect_states) == set(effect.carries) == set(effect.EFFECT_STATES)
    assert np.abs(np.subtract(advanced("rk4", effect), advanced("rk4"))).max() > 1e-4


@pytest.mark.parametrize("name", sorted(name for name in EFFECTS if EFFECTS[name].signals()))
def test_a_signal_that_an_effect_needs_and_nobody_has_is_one_clear_line(
    name: str, acting: Callable[..., dict[str, float]]
) -> None:
    effect = build_effect(name, acting(name))
    assert effect.needs == EFFECTS[name].signals()
    for signal in effect.needs:
        known = {key: value for key, value in CONTEXT.items() if key != signal}
        expected = rf"^effect {name} needs the signal {signal} \({CONTEXT_UNITS[signal]}\), which is not known here \("
        with pytest.raises(ConfigurationError, match=expected) as caught:
            CarModel(CONSTANTS, 0.04, (effect,)).motion(STATE, APPLIED, THETA, context=known)
        assert "\n" not in str(caught.value)
        with pytest.raises(ConfigurationError, match=f"laps.parquet: effect {name} needs the signal {signal} "):
            require_context((effect,), known, "laps.parquet")
    require_context((effect,), CONTEXT, "laps.parquet")


def test_only_what_is_used_needs_its_signals() -> None:
    level = build_effect("road_bank", {"angle": 0.1})
    assert level.needs == ()
    require_context((level, build_effect("grip_patch", {"centre": 0.2})), (), "nowhere")
    assert build_effect("road_bank", {"roll_gain": 1.0}).needs == ("roll",)
    assert build_effect("road_bank", {"knot_2": 0.1}).needs == ("s", "lap_length")
    assert build_effect("road_bank", {"camber": 0.1}).needs == ("bend",)


def test_an_effect_takes_many_values_at_once() -> None:
    angles = np.linspace(-0.1, 0.1, 5)
    together = CarModel(CONSTANTS, 0.04, (EFFECTS["road_bank"](angle=angles),)).motion(STATE, APPLIED, THETA).a_y
    alone = [act(build_effect("road_bank", {"angle": angle})).a_y for angle in angles]
    np.testing.assert_allclose(together, alone, rtol=1e-14)


@pytest.mark.parametrize(
    ("build", "expected"),
    [
        (lambda: build_effect("warp_drive", {}), "unknown effect 'warp_drive'; known: combined_slip, crosswind"),
        (lambda: build_effect("drag", {"area": 1.0}), "effect drag has no parameter 'area'; it has coefficient"),
        (lambda: build_effect("drag", {"coefficient": 2.1}), r"coefficient = 2.1 N/\(m/s\)\^2 is outside \[-1, 2\]"),
        (lambda: build_effect("drag", {"coefficient": float("nan")}), "coefficient = nan"),
    ],
    ids=["effect", "parameter", "bounds", "nan"],
)
def test_a_wrong_effect_says_what_is_wrong(build: Callable[[], Effect], expected: str) -> None:
    with pytest.raises(ValueError, match=expected):
        build()


def test_effects_are_read_from_one_line() -> None:
    assert parse_effect("road_bank") == ("road_bank", {})
    assert parse_effect("crosswind:x=3,y=-2.5") == ("crosswind", {"x": 3.0, "y": -2.5})
    with pytest.raises(ConfigurationError, match=r"effect drag:coefficient=much: .*expected NAME=NUMBER"):
        parse_effect("drag:coefficient=much")
