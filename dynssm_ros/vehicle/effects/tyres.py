"""Tyres: how much they grip, when and where, and how fast they respond."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.vehicle.effects.base import CENTRE, LAP, LENGTH, SLOWEST, Effect, Parameter, lagged, section
from dynssm_ros.vehicle.single_track import Array, Motion, at_least

_LEAST_GRIP = 0.1  # of the nominal, however far a drift has gone
_LEAST_SHARE = 0.05  # squared share of the lateral force that the longitudinal one leaves at least
_LEANS = 0.1  # of the grip of an axle with two wheels, that the load takes which leans to one side


@dataclass(frozen=True)
class Grip(Effect):
    """``factor F_y(alpha / factor^similarity)`` on both axles.

    With a similarity of 0 the whole curve shrinks. With 1 the peak does and the cornering stiffness stays, as it does on
    another road: the similarity method (Pacejka, Tire and Vehicle Dynamics, 2012, section 4.2).
    """

    NAME = "grip"
    SUMMARY = "All tyres grip more or less than the nominal ones: another floor, rain, temperature, another compound."
    ADVICE = "Treat that floor, weather or set of tyres apart, and drive it with the grip that it has."
    MANOEUVRE = "steady cornering up to the limit"
    PARAMETERS = {
        "factor": Parameter("1", 0.3, 1.7, 1.0),
        "similarity": Parameter("1", 0.0, 1.0, 0.0, shape=True, tried=(0.5, 1.0)),
    }
    VARIANTS = (("factor",), ("factor", "similarity"))
    TYPICAL = (0.13, 0.3)
    LEAST = _LEANS
    factor: Array = 1.0
    similarity: Array = 0.0

    def slip(self, xp: Any, q: Motion) -> None:
        scale = self.factor**-self.similarity
        q.alpha_f, q.alpha_r = q.alpha_f * scale, q.alpha_r * scale

    def tyres(self, xp: Any, q: Motion) -> None:
        q.F_fy, q.F_ry = q.F_fy * self.factor, q.F_ry * self.factor


@dataclass(frozen=True)
class FrontGrip(Effect):
    """``factor * F_fy``."""

    NAME = "front_grip"
    SUMMARY = "The front axle grips more or less than the nominal tyre."
    ADVICE = "Check pressure, temperature and wear of the front tyres and the front wing."
    MANOEUVRE = "steady cornering up to the limit"
    PARAMETERS = {"factor": Parameter("1", 0.3, 1.7, 1.0)}
    TYPICAL = (0.1, 0.25)
    LEAST = _LEANS
    factor: Array = 1.0

    def tyres(self, xp: Any, q: Motion) -> None:
        q.F_fy = q.F_fy * self.factor


@dataclass(frozen=True)
class RearGrip(Effect):
    """``factor * F_ry``."""

    NAME = "rear_grip"
    SUMMARY = "The rear axle grips more or less than the nominal tyre."
    ADVICE = "Check pressure, temperature and wear of the rear tyres and the rear wing."
    MANOEUVRE = "steady cornering up to the limit"
    PARAMETERS = {"factor": Parameter("1", 0.3, 1.7, 1.0)}
    TYPICAL = (0.06, 0.2)
    DIRECTIONS = (-1.0,)  # a car that can be driven
    factor: Array = 1.0

    def tyres(self, xp: Any, q: Motion) -> None:
        q.F_ry = q.F_ry * self.factor


@dataclass(frozen=True)
class TireRelaxation(Effect):
    """``length / v_x * dalpha/dt = slip - alpha`` at either axle; the tyres see ``alpha``.

    On a double-track car the wheels of an axle share its lag; what sets their slip apart from each other has none.
    """

    NAME = "tire_relaxation"
    SUMMARY = "The tyres build up their lateral force over a distance rolled, not at once."
    ADVICE = "Model the relaxation length; higher pressure and stiffer carcasses shorten it."
    MANOEUVRE = "quick steering from side to side at low speed"
    PARAMETERS = {"length": Parameter("m", 0.0, 3.0, 0.0)}
    TYPICAL = (0.35, 1.2)
    EFFECT_STATES = ("tire_relaxation.alpha_f", "tire_relaxation.alpha_r")
    length: Array = 0.0

    def slip(self, xp: Any, q: Motion) -> None:
        front, rear = self.EFFECT_STATES
        time_constant = self.length / (abs(q.v_x) + SLOWEST)
        q.alpha_f = lagged(q, front, q.alpha_f, time_constant)
        q.alpha_r = lagged(q, rear, q.alpha_r, time_constant)


@dataclass(frozen=True)
class CombinedSlip(Effect):
    """Friction ellipse: ``F_ry sqrt(1 - (strength F_d / D_r)^2)`` with D_r at the present load.

    Drive and brakes act on the rear axle in the single-track equations, so it is the rear that loses lateral force. Of
    the lateral force at least a fifth or so is left.
    """

    NAME = "combined_slip"
    SUMMARY = "The driven axle loses lateral force while it drives or brakes: the tyre shares its grip."
    ADVICE = "Model the friction ellipse; brake and accelerate straighter, or soften the throttle map at corner exit."
    MANOEUVRE = "braking into corners and accelerating out of them"
    PARAMETERS = {"strength": Parameter("1", 0.0, 1.5, 0.0)}
    TYPICAL = (0.35, 1.0)
    strength: Array = 0.0

    def tyres(self, xp: Any, q: Motion) -> None:
        used = self.strength * q.F_d / (q.theta.D_r * q.F_zr / q.F_z0)
        q.F_ry = q.F_ry * xp.sqrt(at_least(1.0 - used * used, _LEAST_SHARE))


@dataclass(frozen=True)
class GripDrift(Effect):
    """``(1 + rate t)`` times both lateral forces, a tenth at least."""

    NAME = "grip_drift"
    SUMMARY = "The grip of all tyres changes steadily with time: wear, temperature, a drying or rubbered-in track."
    ADVICE = "Watch tyre temperatures and wear over the stint, and schedule tyre changes accordingly."
    MANOEUVRE = "the same corners at the limit, early and late in the stint"
    PARAMETERS = {"rate": Parameter("1/s", -0.005, 0.005, 0.0, context=("t",))}
    TYPICAL = (0.0003, 0.002)
    DIRECTIONS = (-1.0,)  # a car that can be driven
    rate: Array = 0.0

    def tyres(self, xp: Any, q: Motion) -> None:
        grip = at_least(1.0 + self.rate * self.read(q, "t"), _LEAST_GRIP)
        q.F_fy, q.F_ry = q.F_fy * grip, q.F_ry * grip


@dataclass(frozen=True)
class GripPatch(Effect):
    """``factor`` times both lateral forces on a section of the lap; see :func:`section` for its edges."""

    NAME = "grip_patch"
    SUMMARY = "A stretch of the track grips more or less than the rest: oil, water, dust, new asphalt."
    ADVICE = "Inspect or clean that stretch, and drive it with the grip that it has."
    MANOEUVRE = "laps that corner at the limit on that stretch"
    PARAMETERS = {
        "factor": Parameter("1", 0.3, 1.7, 1.0, context=LAP, local=True),
        "centre": CENTRE,
        "length": LENGTH,
    }
    TYPICAL = (0.035, 0.4)
    DIRECTIONS = (-1.0,)  # a car that can be driven
    factor: Array = 1.0
    centre: Array = 0.5
    length: Array = 0.1

    def along_lap(self, lap: Vector, bend: Vector | None = None) -> tuple[str, Vector] | None:
        """The factor of the grip."""
        return "grip (1)", np.asarray(1.0 + (self.factor - 1.0) * section(np, lap, self.centre, self.length))

    def tyres(self, xp: Any, q: Motion) -> None:
        grip = 1.0 + (self.factor - 1.0) * section(xp, self.lap(q), self.centre, self.length)
        q.F_fy, q.F_ry = q.F_fy * grip, q.F_ry * grip
