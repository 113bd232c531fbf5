"""Environment: the road's slope and the wind."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.vehicle.effects.base import CENTRE, LAP, LENGTH, PLACE, Effect, Parameter, away, like, section
from dynssm_ros.vehicle.single_track import GRAVITY, Array, Motion, at_least

_PIECES = 8  # of the curve along the lap
_KNOTS = tuple(f"knot_{k}" for k in range(1, _PIECES))
_SECTION = ("section", "centre", "length")
_CALM = 1e-6  # (m/s)^2; keeps the slope of a square root finite in still air


@dataclass(frozen=True)
class RoadAngle(Effect):
    """An angle of the road: everywhere the same, on a section of the lap, as a curve along the lap, or their sum.

    The curve is a periodic cubic spline (uniform B-splines; de Boor 1978) with mean zero. ``knot_k`` is its coefficient at
    ``k / 8`` of the lap; the one at the start of the lap makes their sum zero.
    """

    PARAMETERS = {
        "angle": Parameter("rad", -0.5, 0.5, 0.0),
        "section": Parameter("rad", -0.5, 0.5, 0.0, context=LAP, local=True),
        "centre": CENTRE,
        "length": LENGTH,
        **dict.fromkeys(_KNOTS, Parameter("rad", -0.3, 0.3, 0.0, context=LAP)),
    }
    VARIANTS: ClassVar[tuple[tuple[str, ...], ...]] = (("angle",), ("angle", *_SECTION), ("angle", *_KNOTS))
    angle: Array = 0.0
    section: Array = 0.0
    centre: Array = 0.5
    length: Array = 0.1
    knot_1: Array = 0.0
    knot_2: Array = 0.0
    knot_3: Array = 0.0
    knot_4: Array = 0.0
    knot_5: Array = 0.0
    knot_6: Array = 0.0
    knot_7: Array = 0.0

    def along_lap(self, lap: Vector, bend: Vector | None = None) -> tuple[str, Vector] | None:
        """The angle in degrees."""
        if not set(PLACE) & set(self.needs) or ("bend" in self.needs and bend is None):
            return None
        q: Any = SimpleNamespace(v_x=np.zeros_like(lap), context={"s": lap, "lap_length": 1.0, "bend": bend})
        return f"{self.NAME.replace('_', ' ')} (deg)", np.degrees(self.here(np, q))

    def here(self, xp: Any, q: Motion) -> Array:
        """The angle at the present place (rad)."""
        angle = like(q, self.angle)
        if "section" in self.active:
            angle = angle + self.section * section(xp, self.lap(q), self.centre, self.length)
        if self.active & set(_KNOTS):
            knots = [getattr(self, name) for name in _KNOTS]
            for k, knot in enumerate([-sum(knots), *knots]):
                angle = angle + knot * _spline(_PIECES * away(xp, self.lap(q), k / _PIECES))
        return angle


@dataclass(frozen=True)
class RoadBank(RoadAngle):
    """``F_y - m g sin(bank)``, bank as roll: positive with the left side up, so that the car is pulled to the right.

    ``camber`` is how far the road leans into its sharpest bends, and less in proportion to the curvature elsewhere, as
    roads are built. ``roll_gain`` adds that much of the measured roll of the car. The axle loads stay those of the level
    road.
    """

    NAME = "road_bank"
    SUMMARY = "The road leans to one side, so gravity pulls the car sideways."
    ADVICE = "Map the banking of the track, or feed the measured roll to the model."
    MANOEUVRE = "the same stretch at different speeds, straight as far as possible"
    PARAMETERS = {
        **RoadAngle.PARAMETERS,
        "camber": Parameter("rad", -0.5, 0.5, 0.0, context=("bend",)),
        "roll_gain": Parameter("1", -2.0, 2.0, 0.0, context=("roll",)),
    }
    TYPICAL = (0.015, 0.1)
    VARIANTS = (("angle",), ("camber",), *RoadAngle.VARIANTS[1:], ("roll_gain",))
    camber: Array = 0.0
    roll_gain: Array = 0.0

    def here(self, xp: Any, q: Motion) -> Array:
        """The angle at the present place (rad), but for the measured roll."""
        angle = super().here(xp, q)
        return angle - self.camber * self.read(q, "bend") if "camber" in self.active else angle

    def forces(self, xp: Any, q: Motion) -> None:
        bank = self.here(xp, q)
        if "roll_gain" in self.active:
            bank = bank + self.roll_gain * self.read(q, "roll")
        q.F_y = q.F_y - q.m * GRAVITY * xp.sin(bank)


@dataclass(frozen=True)
class RoadGrade(RoadAngle):
    """``F_x - m g sin(grade)``, positive uphill."""

    NAME = "road_grade"
    SUMMARY = "The road climbs or falls, so gravity pulls the car back or forth."
    ADVICE = "Map the height of the track and give the model its slope."
    MANOEUVRE = "the same stretch with and without throttle"
    PARAMETERS = RoadAngle.PARAMETERS
    VARIANTS = (("angle",), _SECTION, _KNOTS)
    OPEN_ROAD = (("angle",),)
    TYPICAL = (0.005, 0.05)

    def forces(self, xp: Any, q: Motion) -> None:
        q.F_x = q.F_x - q.m * GRAVITY * xp.sin(self.here(xp, q))

    @classmethod
    def drawn(cls, amount: float, rng: np.random.Generator) -> dict[str, float]:
        """A wave over the lap with about that amplitude: what climbs falls again."""
        top = float(rng.uniform(0, _PIECES))
        return {name: amount * math.cos(2 * math.pi * (k - top) / _PIECES) for k, name in enumerate(_KNOTS, 1)}

    @classmethod
    def amount(cls, values: Mapping[str, float]) -> float:
        """The amplitude of such a wave, where the grade is a curve."""
        if not set(_KNOTS) <= set(values):
            return super().amount(values)
        knots = [values[name] for name in _KNOTS]
        return math.sqrt(2.0 / _PIECES) * math.hypot(sum(knots), *knots)


def _spline(away: Array) -> Array:
    """The uniform cubic B-spline at a distance in knots, not negative; shifted by whole knots they sum to one."""
    wide, narrow = at_least(2.0 - away, 0.0), at_least(1.0 - away, 0.0)
    return (wide * wide * wide - 4.0 * narrow * narrow * narrow) / 6.0


@dataclass(frozen=True)
class Crosswind(Effect):
    """Wind with the world-fixed velocity ``(x, y)``, the direction in which it blows.

    With ``w`` the wind and ``v`` the car in the body frame and ``a = v - w`` the air that it meets, drag follows the air,
    ``C_r2 a_x |a_x|`` in place of ``C_r2 v_x |v_x|``, and the side force is ``side C_r2 |a| w_y``, ``arm`` ahead of the
    centre of gravity. The side force that the car's own drift makes in still air belongs to the nominal model.
    """

    NAME = "crosswind"
    SUMMARY = "A steady wind pushes the car, to another side in every direction of driving."
    ADVICE = "Compare with the weather station; treat laps in wind apart, or give the model the wind."
    MANOEUVRE = "the same speed in opposite directions"
    PARAMETERS = {
        "x": Parameter("m/s", -25.0, 25.0, 0.0, context=("theta",)),
        "y": Parameter("m/s", -25.0, 25.0, 0.0, context=("theta",)),
        "side": Parameter("1", 0.0, 100.0, 3.0, shape=True, tried=(1.0, 3.0, 10.0)),
        "arm": Parameter("m", -1.0, 1.0, 0.0, shape=True, tried=(-0.4, 0.4)),
    }
    TYPICAL = (0.7, 12.0)
    VARIANTS = (("x", "y"), ("x", "y", "side"), ("x", "y", "side", "arm"))
    x: Array = 0.0
    y: Array = 0.0
    side: Array = 3.0
    arm: Array = 0.0

    def drive(self, xp: Any, q: Motion) -> None:
        w_x, _ = self._wind(xp, q)
        a_x = q.v_x - w_x
        q.F_rx = q.F_rx - q.theta.C_r2 * (a_x * abs(a_x) - q.v_x * abs(q.v_x))

    def forces(self, xp: Any, q: Motion) -> None:
        w_x, w_y = self._wind(xp, q)
        a_x, a_y = q.v_x - w_x, q.v_y - w_y
        push = self.side * q.theta.C_r2 * xp.sqrt(a_x * a_x + a_y * a_y + _CALM) * w_y
        q.F_y = q.F_y + push
        q.M_z = q.M_z + self.arm * push

    @classmethod
    def drawn(cls, amount: float, rng: np.random.Generator) -> dict[str, float]:
        """Wind of that speed (m/s) from a random direction."""
        direction = float(rng.uniform(0, 2 * math.pi))
        return {"x": amount * math.cos(direction), "y": amount * math.sin(direction)}

    def _wind(self, xp: Any, q: Motion) -> tuple[Array, Array]:
        """The wind in the body frame (m/s)."""
        theta = self.read(q, "theta")
        sin, cos = xp.sin(theta), xp.cos(theta)
        return cos * self.x + sin * self.y, cos * self.y - sin * self.x
