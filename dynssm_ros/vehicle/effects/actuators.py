"""Actuators: what acts on the car is not quite what was measured."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from dynssm_ros.vehicle.effects.base import Effect, Parameter, lagged
from dynssm_ros.vehicle.single_track import Array, Motion, VehicleConstants, at_least

_STEERING_KNOWN = 0.008
"""Of the wheels' angle: what four wheels with linear steering leave beside the tyre formula of an axle (with load
sensitivity, toe and steering that gives way). Found in them were a gain of 1.004 and a curve of 0.6 % at the largest angle.
"""


@dataclass(frozen=True)
class SteeringOffset(Effect):
    """``delta + offset`` steers."""

    NAME = "steering_offset"
    SUMMARY = "The zero of the steering sensor is off: the wheels point elsewhere than measured by a fixed angle."
    ADVICE = "Re-zero the steering sensor with the wheels straight, and check toe and tie rods."
    MANOEUVRE = "driving straight at several speeds"
    PARAMETERS = {"offset": Parameter("rad", -0.05, 0.05, 0.0)}
    TYPICAL = (0.004, 0.02)
    offset: Array = 0.0

    def inputs(self, xp: Any, q: Motion) -> None:
        q.delta = q.delta + self.offset


@dataclass(frozen=True)
class SteeringGain(Effect):
    """``factor * delta`` steers."""

    NAME = "steering_gain"
    SUMMARY = "The wheels turn more or less than the measured steering says: the ratio from sensor to wheels is off."
    ADVICE = "Measure the road-wheel angle over the sensor's range and correct the steering ratio."
    MANOEUVRE = "corners to both sides at low lateral acceleration"
    PARAMETERS = {"factor": Parameter("1", 0.5, 1.5, 1.0)}
    TYPICAL = (0.015, 0.2)
    LEAST = _STEERING_KNOWN
    factor: Array = 1.0

    def inputs(self, xp: Any, q: Motion) -> None:
        q.delta = q.delta * self.factor


@dataclass(frozen=True)
class SteeringCurve(Effect):
    """``delta + quadratic delta^2 + cubic delta^3`` steers."""

    NAME = "steering_curve"
    SUMMARY = "The ratio from sensor to wheels changes with the angle, or is not the same to both sides."
    ADVICE = (
        "Measure the road-wheel angle over the sensor's range, to both sides, and take the curve into the signal map."
    )
    MANOEUVRE = "slow corners of every radius to both sides"
    PARAMETERS = {
        "cubic": Parameter("1/rad^2", -8.0, 8.0, 0.0),
        "quadratic": Parameter("1/rad", -1.5, 1.5, 0.0),
    }
    VARIANTS = (("cubic",), ("cubic", "quadratic"))
    TYPICAL = (1.5, 6.0)
    cubic: Array = 0.0
    quadratic: Array = 0.0

    @classmethod
    def least(cls, constants: VehicleConstants, steered: float) -> float:
        """What turns the wheels as much as nobody knows their angle."""
        return _STEERING_KNOWN / max(steered, 1e-3) ** 2

    @classmethod
    def amount(cls, values: Mapping[str, float]) -> float:
        """The cubic; a quadratic counts as the one that turns the wheels as much at 0.1 rad."""
        return math.hypot(values.get("cubic", 0.0), values.get("quadratic", 0.0) / 0.1)

    def inputs(self, xp: Any, q: Motion) -> None:
        q.delta = q.delta * (1.0 + self.quadratic * q.delta + self.cubic * q.delta * q.delta)


@dataclass(frozen=True)
class SteeringLag(Effect):
    """``time_constant * ddelta/dt = measured - delta``."""

    NAME = "steering_lag"
    SUMMARY = "The wheels follow the measured steering late, with a first-order lag."
    ADVICE = "Check the steering actuator, play and compliance, and the stamps of the steering signal."
    MANOEUVRE = "quick steering from side to side at constant speed"
    PARAMETERS = {"time_constant": Parameter("s", 0.0, 0.5, 0.0)}
    TYPICAL = (0.015, 0.2)
    EFFECT_STATES = ("steering_lag.delta",)
    time_constant: Array = 0.0

    def inputs(self, xp: Any, q: Motion) -> None:
        q.delta = lagged(q, self.EFFECT_STATES[0], q.delta, self.time_constant)


@dataclass(frozen=True)
class ThrottleDeadBand(Effect):
    """Throttle and brake below ``width`` do nothing, and beyond it act by what is left."""

    NAME = "throttle_dead_band"
    SUMMARY = "The first part of the throttle does nothing: play, a dead zone of the motor controller, a clutch."
    ADVICE = "Measure from which throttle on the car pulls, and take it off in the signal map."
    MANOEUVRE = "small throttle, slowly opened and closed on a straight"
    PARAMETERS = {"width": Parameter("1", 0.0, 0.5, 0.0)}
    TYPICAL = (0.008, 0.1)
    width: Array = 0.0

    def inputs(self, xp: Any, q: Motion) -> None:
        q.r = at_least(q.r - self.width, 0.0) - at_least(-q.r - self.width, 0.0)


@dataclass(frozen=True)
class ThrottleLag(Effect):
    """``time_constant * dr/dt = measured - r``."""

    NAME = "throttle_lag"
    SUMMARY = "Drive and brakes follow the measured throttle late, with a first-order lag."
    ADVICE = "Check turbo and engine response, brake pressure build-up, and the stamps of the throttle signal."
    MANOEUVRE = "steps of throttle and brake on a straight"
    PARAMETERS = {"time_constant": Parameter("s", 0.0, 0.5, 0.0)}
    TYPICAL = (0.012, 0.4)
    EFFECT_STATES = ("throttle_lag.r",)
    time_constant: Array = 0.0

    def inputs(self, xp: Any, q: Motion) -> None:
        q.r = lagged(q, self.EFFECT_STATES[0], q.r, self.time_constant)
