"""Effects: each acts after its own stage, carries its memory, and is absent at its neutral value."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any, ClassVar

import numpy as np
import pytest

from dynssm_ros.vehicle import Applied, Coefficients, State, load_vehicle, motion
from dynssm_ros.vehicle.effects import EFFECTS, Effect, Parameter, build_effect, initial_memory
from dynssm_ros.vehicle.single_track import GRAVITY, STAGE_NAMES, Array, Integrator, Motion, step_with_memory

VEHICLE = load_vehicle("av21_paper")
CONSTANTS = VEHICLE.constants
THETA = Coefficients(*VEHICLE.nominal)
STATE, APPLIED = State(30.0, 0.4, 0.2), Applied(0.4, 0.05)


def act(*effects: Effect, memory: dict[str, Array] | None = None) -> Motion:
    return motion(np, STATE, APPLIED, THETA, CONSTANTS, effects, memory)


@dataclass(frozen=True)
class YawRateBias(Effect):
    bias: float = 0.0

    def inputs(self, xp: Any, q: Motion) -> None:
        q.omega = q.omega + self.bias


@dataclass(frozen=True)
class Camber(Effect):
    angle: float = 0.0

    def slip(self, xp: Any, q: Motion) -> None:
        q.alpha_f = q.alpha_f + self.angle


@dataclass(frozen=True)
class Push(Effect):
    force: float = 0.0

    def drive(self, xp: Any, q: Motion) -> None:
        q.F_rx = q.F_rx + self.force


@dataclass(frozen=True)
class Downforce(Effect):
    coefficient: float = 0.0

    def loads(self, xp: Any, q: Motion) -> None:
        q.F_zf = q.F_zf + 0.5 * self.coefficient * q.v_x**2
        q.F_zr = q.F_zr + 0.5 * self.coefficient * q.v_x**2


@dataclass(frozen=True)
class FrontGone(Effect):
    def tyres(self, xp: Any, q: Motion) -> None:
        q.F_fy = 0.0 * q.F_fy


@dataclass(frozen=True)
class Bank(Effect):
    angle: float = 0.0

    def forces(self, xp: Any, q: Motion) -> None:
        q.F_y = q.F_y - q.m * GRAVITY * xp.sin(self.angle)


@dataclass(frozen=True)
class YawTorque(Effect):
    angular: float = 0.0

    def accelerations(self, xp: Any, q: Motion) -> None:
        q.omega_dot = q.omega_dot + self.angular


@dataclass(frozen=True)
class ThrottleLag(Effect):
    MEMORY: ClassVar[tuple[str, ...]] = ("throttle_lag.r",)
    time_constant: float = 0.2

    def initial_memory(self, r: Array, delta: Array) -> dict[str, Array]:
        return {self.MEMORY[0]: r}

    def inputs(self, xp: Any, q: Motion) -> None:
        (name,) = self.MEMORY
        q.memory_rate[name] = (q.r - q.memory[name]) / self.time_constant
        q.r = q.memory[name]


def test_an_effect_on_the_inputs_is_a_motion_under_other_inputs() -> None:
    biased = motion(np, STATE._replace(omega=STATE.omega + 0.1), APPLIED, THETA, CONSTANTS)
    found = act(YawRateBias(0.1))
    assert (found.a_x, found.a_y, found.omega_dot) == (biased.a_x, biased.a_y, biased.omega_dot)


def test_an_effect_on_the_slip_is_a_shift_of_the_slip() -> None:
    shifted = motion(np, STATE, APPLIED, THETA._replace(S_hf=THETA.S_hf + 0.01), CONSTANTS)
    assert act(Camber(0.01)).F_fy == pytest.approx(shifted.F_fy, rel=1e-12)


def test_an_effect_on_the_drive_also_moves_the_loads_that_follow() -> None:
    plain, pushed = act(), act(Push(1000.0))
    assert pushed.F_rx - plain.F_rx == 1000.0
    wheelbase = CONSTANTS.l_f + CONSTANTS.l_r
    assert pushed.F_zr - plain.F_zr == pytest.approx(CONSTANTS.h_cg * 1000.0 / wheelbase, rel=1e-9)


def test_an_effect_on_the_loads_scales_the_tyres_that_follow() -> None:
    plain, pressed = act(), act(Downforce(2.0))
    assert pressed.F_fy / plain.F_fy == pytest.approx((plain.F_zf + 30.0**2) / plain.F_zf, rel=1e-12)
    assert pressed.F_rx == plain.F_rx


def test_an_effect_on_the_tyres_leaves_only_the_other_axle() -> None:
    q = act(FrontGone())
    assert q.F_y == q.F_ry
    assert q.M_z == -CONSTANTS.l_r * q.F_ry
    assert q.F_x == q.F_rx


def test_an_effect_on_the_forces_reaches_only_its_own_acceleration() -> None:
    plain, banked = act(), act(Bank(0.1))
    assert banked.a_y - plain.a_y == pytest.approx(-GRAVITY * np.sin(0.1), rel=1e-12)
    assert (banked.a_x, banked.omega_dot) == (plain.a_x, plain.omega_dot)


def test_an_effect_on_the_accelerations_has_the_last_word() -> None:
    assert act(YawTorque(0.5)).omega_dot == act().omega_dot + 0.5


def test_each_stage_of_the_equations_can_be_entered_and_in_order() -> None:
    seen: list[str] = []

    class Spy:
        def apply(self, stage: str, xp: Any, q: Motion) -> None:
            seen.append(stage)

    motion(np, STATE, APPLIED, THETA, CONSTANTS, (Spy(), Spy()))
    assert seen == [stage for stage in STAGE_NAMES for _ in range(2)]
    assert STAGE_NAMES == ("inputs", "slip", "drive", "loads", "tyres", "forces", "accelerations")


def test_effects_act_in_the_order_given() -> None:
    @dataclass(frozen=True)
    class Double(Effect):
        def drive(self, xp: Any, q: Motion) -> None:
            q.F_rx = 2 * q.F_rx

    plain = act().F_rx
    assert act(Push(100.0), Double()).F_rx == 2 * (plain + 100.0)
    assert act(Double(), Push(100.0)).F_rx == 2 * plain + 100.0


@pytest.mark.parametrize(
    ("effect", "settled"),
    [(ThrottleLag(0.2), {"throttle_lag.r": 0.1}), (build_effect("steering_lag", {"time_constant": 0.2}), None)],
    ids=["throttle_lag", "steering_lag"],
)
def test_a_lag_approaches_its_input_exponentially(effect: Effect, settled: dict[str, float] | None) -> None:
    (name,) = effect.MEMORY
    start = initial_memory((effect,), 0.1, 0.02)[name]
    if settled is not None:
        assert start == settled[name]
    target, T = {"throttle_lag.r": APPLIED.r, "steering_lag.delta": APPLIED.delta}[name], 0.3
    _, memory = step_with_memory(
        np, STATE, {name: start}, APPLIED, THETA, CONSTANTS, T, (effect,), integrator="rk4", substeps=100
    )
    assert memory[name] == pytest.approx(target + (start - target) * np.exp(-T / 0.2), rel=1e-9)


def test_a_lag_under_forward_euler_decays_by_its_own_factor() -> None:
    effect = build_effect("steering_lag", {"time_constant": 0.2})
    memory: dict[str, Array] = {"steering_lag.delta": 0.0}
    state = STATE
    for _ in range(5):
        state, memory = step_with_memory(np, state, memory, APPLIED, THETA, CONSTANTS, 0.04, (effect,))
    assert memory["steering_lag.delta"] == pytest.approx(APPLIED.delta * (1 - (1 - 0.04 / 0.2) ** 5), rel=1e-12)


def test_the_lagged_steering_is_what_acts_on_the_tyres() -> None:
    lag = build_effect("steering_lag", {"time_constant": 0.1})
    lagged = act(lag, memory={"steering_lag.delta": 0.02})
    direct = motion(np, STATE, APPLIED._replace(delta=0.02), THETA, CONSTANTS)
    assert (lagged.a_x, lagged.a_y, lagged.omega_dot) == (direct.a_x, direct.a_y, direct.omega_dot)


@pytest.mark.parametrize("integrator", ["euler", "rk4"])
@pytest.mark.parametrize("name", sorted(EFFECTS))
def test_a_neutral_effect_changes_nothing(name: str, integrator: Integrator) -> None:
    effect = build_effect(name, {key: about.neutral for key, about in EFFECTS[name].PARAMETERS.items()})
    memory = initial_memory((effect,), *APPLIED)
    plain, _ = step_with_memory(np, STATE, {}, APPLIED, THETA, CONSTANTS, 0.04, (), integrator, 2)
    found, _ = step_with_memory(np, STATE, memory, APPLIED, THETA, CONSTANTS, 0.04, (effect,), integrator, 2)
    assert found == plain


@pytest.mark.parametrize("name", sorted(EFFECTS))
def test_every_shipped_effect_is_fully_described(name: str) -> None:
    effect = EFFECTS[name]
    assert name == effect.NAME
    assert effect.__doc__
    assert {f.name for f in fields(effect)} == set(effect.PARAMETERS)
    assert effect().parameters == {key: about.neutral for key, about in effect.PARAMETERS.items()}
    for about in effect.PARAMETERS.values():
        assert isinstance(about, Parameter)
        assert about.unit
        assert about.lower <= about.neutral <= about.upper
        assert about.lower < about.upper
    assert set(effect().initial_memory(0.0, 0.0)) == set(effect.MEMORY)
    assert any(hasattr(effect, stage) for stage in STAGE_NAMES)


@pytest.mark.parametrize("name", sorted(EFFECTS))
def test_every_shipped_effect_acts_away_from_its_neutral_value(name: str) -> None:
    effect = build_effect(name, {key: about.upper for key, about in EFFECTS[name].PARAMETERS.items()})
    acted = act(effect, memory=initial_memory((effect,), 0.0, 0.0))
    plain = act()
    assert (acted.a_x, acted.a_y, acted.omega_dot) != (plain.a_x, plain.a_y, plain.omega_dot)


@pytest.mark.parametrize(
    ("build", "expected"),
    [
        (lambda: build_effect("warp_drive", {}), "unknown effect 'warp_drive'; known: drag"),
        (lambda: build_effect("drag", {"area": 1.0}), "effect drag has no parameter 'area'; it has coefficient"),
        (lambda: build_effect("drag", {"coefficient": 2.1}), r"coefficient = 2.1 N/\(m/s\)\^2 is outside \[-1, 2\]"),
        (lambda: build_effect("drag", {"coefficient": float("nan")}), "coefficient = nan"),
    ],
    ids=["effect", "parameter", "bounds", "nan"],
)
def test_a_wrong_effect_says_what_is_wrong(build: Callable[[], Effect], expected: str) -> None:
    with pytest.raises(ValueError, match=expected):
        build()
