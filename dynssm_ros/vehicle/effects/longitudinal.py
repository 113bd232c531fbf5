"""Longitudinal: what drives the car and what holds it back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from dynssm_ros.vehicle.effects.base import Effect, Parameter
from dynssm_ros.vehicle.effects.step_errors import StepErrors, bent_drive
from dynssm_ros.vehicle.single_track import GRAVITY, Array, Motion, at_least

_SHARP = 4  # power of a soft minimum: at the corner a sixth is missing, from one and a half times that on a twentieth


@dataclass(frozen=True)
class Drag(Effect):
    """``F_rx - coefficient v_x^2``: on top of C_r2."""

    NAME = "drag"
    SUMMARY = "The air holds the car back more or less than the vehicle file says: a wing, a tow, bodywork."
    ADVICE = "Check wings, cooling inlets and bodywork; coast down from top speed to measure the drag."
    MANOEUVRE = "coasting down from top speed"
    PARAMETERS = {"coefficient": Parameter("N/(m/s)^2", -1.0, 2.0, 0.0)}
    TYPICAL = (0.12, 0.6)
    DIRECTIONS = (1.0,)  # a car that can be driven
    coefficient: Array = 0.0

    def drive(self, xp: Any, q: Motion) -> None:
        q.F_rx = q.F_rx - self.coefficient * q.v_x * abs(q.v_x)


@dataclass(frozen=True)
class RollingResistance(Effect):
    """``F_rx - coefficient m g``: on top of C_r0."""

    NAME = "rolling_resistance"
    SUMMARY = "The wheels roll harder or easier than the vehicle file says, whatever the speed."
    ADVICE = "Check tyre pressures, bearings and dragging brakes; let the car roll out to measure the resistance."
    MANOEUVRE = "rolling out at low speed"
    PARAMETERS = {"coefficient": Parameter("1", -0.1, 0.2, 0.0)}
    TYPICAL = (0.005, 0.04)
    DIRECTIONS = (1.0,)  # a car that can be driven
    coefficient: Array = 0.0

    def drive(self, xp: Any, q: Motion) -> None:
        q.F_rx = q.F_rx - q.direction * self.coefficient * q.m * GRAVITY


@dataclass(frozen=True)
class DriveGain(Effect):
    """``factor * (C_m1 - C_m2 v_x) r``: drive and brakes alike, resistances not."""

    NAME = "drive_gain"
    SUMMARY = "Throttle and brake give more or less force than the vehicle file says."
    ADVICE = "Check the engine map and the brake balance, and the scale of the throttle signal."
    MANOEUVRE = "full throttle and hard braking on a straight"
    PARAMETERS = {"factor": Parameter("1", 0.4, 1.6, 1.0)}
    TYPICAL = (0.12, 0.25)
    factor: Array = 1.0

    def drive(self, xp: Any, q: Motion) -> None:
        q.F_rx = q.F_rx + (self.factor - 1.0) * q.F_d
        q.F_d = q.F_d * self.factor


@dataclass(frozen=True)
class PowerLimit(Effect):
    """``F_d / (1 + (F_d v_x / P)^4)^(1/4)``: the drive has at most the power ``P = C_m1 / inverse_speed``.

    ``1 / inverse_speed`` is the speed from which on full throttle asks for all of it. Brakes have no limit.
    """

    NAME = "power_limit"
    SUMMARY = "The engine has only so much power, so that at speed more throttle gives no more force."
    ADVICE = "Take the greatest power, C_m1 / inverse_speed, from the engine's data; at speed throttle gives no more."
    MANOEUVRE = "full throttle from low speed up to top speed"
    PARAMETERS = {"inverse_speed": Parameter("s/m", 0.0, 1.0, 0.0)}
    TYPICAL = (0.045, 0.15)
    inverse_speed: Array = 0.0

    def drive(self, xp: Any, q: Motion) -> None:
        asked = at_least(q.F_d * q.direction, 0.0) * self.inverse_speed * abs(q.v_x) / q.theta.C_m1  # of all the power
        missing = q.F_d * (1.0 - (1.0 + asked**_SHARP) ** (-1.0 / _SHARP))
        q.F_rx = q.F_rx - missing
        q.F_d = q.F_d - missing


@dataclass(frozen=True)
class DriveMap(Effect):
    """``factor * (C_m1 - C_m2 v_x) r``, with a smooth ``factor`` over throttle and speed.

    With ``e = 1 - r`` and the speed ``s = v_x / top``, both within 0 and 1, the drive is multiplied by
    ``(1 + 2 (half - 1) e) (1 + 2 (half_at_top - 1) e s) (1 + 4 (middle - 1) s (1 - s))``: a parabola over the throttle,
    one over the throttle that comes with the speed, and one over the speed. Brakes are multiplied by ``brake``. At full
    throttle, standing or at ``top``, the factor is 1, as C_m1 and C_m2 say the rest. With a speed set-point ``r`` is the
    share of C_m1.
    """

    NAME = "drive_map"
    SUMMARY = "The force bends over throttle or speed, or brakes scale otherwise than drive."
    ADVICE = "Calibrate the accelerator and brake map: measure acceleration by pedal and speed."
    MANOEUVRE = "steady throttles of every size, and brakes, from low speed up to top speed"
    PARAMETERS = {
        "half": Parameter("1", 0.6, 1.6, 1.0),
        "middle": Parameter("1", 0.6, 1.6, 1.0),
        "half_at_top": Parameter("1", 0.6, 1.6, 1.0),
        "brake": Parameter("1", 0.4, 1.6, 1.0),
        "top": Parameter("m/s", 0.5, 120.0, 40.0, shape=True),
    }
    VARIANTS = (("half",), ("middle",), ("brake",), ("half", "middle"), ("half", "half_at_top", "middle"))
    READ_OFF = GIVEN = ("top",)
    TYPICAL = (0.025, 0.3)
    half: Array = 1.0
    middle: Array = 1.0
    half_at_top: Array = 1.0
    brake: Array = 1.0
    top: Array = 40.0

    @classmethod
    def read_off(cls, steps: StepErrors) -> dict[str, float] | None:
        """The largest speed under throttle, where errors in v_x bend over throttle or speed or differ under the brakes."""
        top = bent_drive(steps)
        return None if top is None else {"top": top}

    def drive(self, xp: Any, q: Motion) -> None:
        forward = at_least(q.direction * q.F_d, 0.0)
        asked = at_least(q.direction * q.r, 0.0) if q.set_point == "throttle" else forward / q.theta.C_m1
        eased = at_least(1.0 - asked, 0.0)
        fast = 1.0 - at_least(1.0 - abs(q.v_x) / self.top, 0.0)
        factor = (
            (1.0 + 2.0 * (self.half - 1.0) * eased)
            * (1.0 + 2.0 * (self.half_at_top - 1.0) * eased * fast)
            * (1.0 + 4.0 * (self.middle - 1.0) * fast * (1.0 - fast))
        )
        against = at_least(-q.direction * q.F_d, 0.0)
        more = q.direction * ((factor - 1.0) * forward - (self.brake - 1.0) * against)
        q.F_rx = q.F_rx + more
        q.F_d = q.F_d + more
