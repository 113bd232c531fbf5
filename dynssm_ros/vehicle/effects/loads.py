"""Loads: what presses the axles on the road."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from dynssm_ros.vehicle.effects.base import Effect, Parameter
from dynssm_ros.vehicle.single_track import Array, Motion, VehicleConstants, at_least

_LEAST_LOAD = 0.05  # of the nominal axle load


@dataclass(frozen=True)
class Downforce(Effect):
    """``coefficient v_x^2`` more load, the share ``balance`` of it on the front axle."""

    NAME = "downforce"
    SUMMARY = "The air presses the car down (or lifts it) with the square of the speed, so grip grows with speed."
    ADVICE = "Add the wings' downforce to the vehicle file; use the balance to trim front against rear."
    MANOEUVRE = "cornering at the limit at low and at high speed"
    PARAMETERS = {
        "coefficient": Parameter("N/(m/s)^2", -0.5, 5.0, 0.0),
        "balance": Parameter("1", 0.0, 1.0, 0.45, shape=True, tried=(0.2, 0.45, 0.7)),
    }
    TYPICAL = (0.25, 2.0)
    DIRECTIONS = (1.0,)  # a car that can be driven
    coefficient: Array = 0.0
    balance: Array = 0.45

    def loads(self, xp: Any, q: Motion) -> None:
        pressed = self.coefficient * q.v_x * q.v_x
        q.F_zf = q.F_zf + self.balance * pressed
        q.F_zr = q.F_zr + (1.0 - self.balance) * pressed


@dataclass(frozen=True)
class LoadSensitivity(Effect):
    """``F_y (F_z / F_z,rest)^(exponent - 1)``: with 1 the lateral force is in proportion to the axle load.

    ``F_z,rest`` is the axle's share of ``2 F_z0`` at rest. There the coefficients hold as they are, whatever the exponent.
    """

    NAME = "load_sensitivity"
    SUMMARY = "The tyres do not gain lateral force in proportion to their load."
    ADVICE = "Take the tyres' load sensitivity into the vehicle file, from the maker's data or from these laps."
    MANOEUVRE = "cornering at the limit while braking and driving, and at low and at high speed"
    PARAMETERS = {"exponent": Parameter("1", 0.0, 1.0, 1.0)}
    TYPICAL = (0.12, 0.6)
    DIRECTIONS = (-1.0,)  # as tyres are
    exponent: Array = 1.0

    @classmethod
    def unusable(cls, constants: VehicleConstants) -> str | None:
        """Loads must change."""
        return None if constants.load_transfer else "load_transfer false; expected axle loads that change"

    def tyres(self, xp: Any, q: Motion) -> None:
        both, wheelbase = 2.0 * q.F_z0, q.l_f + q.l_r
        front, rear = both * q.l_r / wheelbase, both * q.l_f / wheelbase
        q.F_fy = q.F_fy * at_least(q.F_zf / front, _LEAST_LOAD) ** (self.exponent - 1.0)
        q.F_ry = q.F_ry * at_least(q.F_zr / rear, _LEAST_LOAD) ** (self.exponent - 1.0)


@dataclass(frozen=True)
class LoadTransfer(Effect):
    """``h_cg + height (l_f + l_r)``: longitudinal load transfer, and on a double-track car the lateral one too.

    The height may be that of a car whose file has none: its axles then carry F_z0 and what is moved between them.
    """

    NAME = "load_transfer"
    SUMMARY = "Braking and driving move more or less load between the axles than the vehicle file says."
    ADVICE = "Measure the height of the centre of gravity and correct h_cg; check anti-dive and anti-squat."
    MANOEUVRE = "braking into corners and accelerating out of them"
    PARAMETERS = {"height": Parameter("wheelbase", -0.2, 0.4, 0.0)}
    TYPICAL = (0.012, 0.19)
    DIRECTIONS = (1.0,)  # a car that can be driven
    LEAST = 0.01  # how well anybody knows the height of the centre of gravity
    height: Array = 0.0

    def inputs(self, xp: Any, q: Motion) -> None:
        q.h_cg = at_least(q.h_cg + self.height * (q.l_f + q.l_r), 0.0)

    def loads(self, xp: Any, q: Motion) -> None:
        if not q.load_transfer:
            transfer = q.h_cg / (q.l_f + q.l_r) * q.F_rx
            q.F_zf, q.F_zr = q.F_zf - transfer, q.F_zr + transfer
