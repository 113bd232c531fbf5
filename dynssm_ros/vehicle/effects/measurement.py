"""Measurement: what is measured differs from what happens.

The car moves as it does; these effects say what the sensors show of it, and back. A model that starts from measured
states and predicts measured states goes measured -> true -> step -> measured, in the order of the vehicle file.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from dynssm_ros.vehicle.effects.base import Effect, Parameter, lagged, like
from dynssm_ros.vehicle.effects.step_errors import StepErrors, recurring_step
from dynssm_ros.vehicle.single_track import Array, Motion, State, VehicleConstants, at_least

_CENTRE_KNOWN = 0.02  # of the wheelbase


@dataclass(frozen=True)
class MeasurementEffect(Effect):
    """Base of the effects that change what is measured, each by what it takes off again on the way back."""

    SENSOR = True

    @property
    def measures(self) -> bool:
        """Whether there is anything to change."""
        return not self.is_neutral

    def changed(self, xp: Any, state: State, effect_states: Mapping[str, Array], way: float) -> State:
        """What is measured of the true ``state`` (``way`` 1), or what is true where it is measured (-1)."""
        raise NotImplementedError

    def measured(self, xp: Any, state: State, effect_states: Mapping[str, Array]) -> State:
        return self.changed(xp, state, effect_states, 1.0)

    def true(self, xp: Any, state: State, effect_states: Mapping[str, Array]) -> State:
        return self.changed(xp, state, effect_states, -1.0)


@dataclass(frozen=True)
class OdometryLeverArm(MeasurementEffect):
    """Velocity of a point ``x`` ahead and ``y`` left of the centre of gravity: ``v + omega x (x, y)``. Exact."""

    NAME = "odometry_lever_arm"
    SUMMARY = "The velocity is measured off the centre of gravity, so yawing shows in it."
    ADVICE = "Measure where the antenna or sensor sits and move its velocity to the centre of gravity."
    MANOEUVRE = "tight corners to both sides"
    PARAMETERS = {"x": Parameter("m", -3.0, 3.0, 0.0), "y": Parameter("m", -2.0, 2.0, 0.0)}
    TYPICAL = (0.08, 2.0)
    VARIANTS = (("x",), ("x", "y"))
    x: Array = 0.0
    y: Array = 0.0

    @classmethod
    def least(cls, constants: VehicleConstants, steered: float) -> float:
        """How well anybody knows where the centre of gravity is."""
        return _CENTRE_KNOWN * constants.wheelbase

    def changed(self, xp: Any, state: State, effect_states: Mapping[str, Array], way: float) -> State:
        v_x, v_y, omega = state
        return State(v_x - omega * (way * self.y), v_y + omega * (way * self.x), omega)


@dataclass(frozen=True)
class OdometryMisalignment(MeasurementEffect):
    """Velocity in a frame turned by ``angle`` (counter-clockwise) against the car. Exact."""

    NAME = "odometry_misalignment"
    SUMMARY = "The velocity is measured in a frame turned against the car, so speed ahead shows as speed sideways."
    ADVICE = "Align the sensor, or correct its heading offset until driving straight shows no sideways speed."
    MANOEUVRE = "driving straight at different speeds"
    PARAMETERS = {"angle": Parameter("rad", -0.2, 0.2, 0.0)}
    TYPICAL = (0.003, 0.04)
    angle: Array = 0.0

    def changed(self, xp: Any, state: State, effect_states: Mapping[str, Array], way: float) -> State:
        v_x, v_y, omega = state
        turn = 0.0 * v_x - way * self.angle  # torch takes no sine of a float
        sin, cos = xp.sin(turn), xp.cos(turn)
        return State(v_x * cos - v_y * sin, v_x * sin + v_y * cos, omega)


@dataclass(frozen=True)
class OdometryDelay(Effect):
    """All three states are measured ``delay`` seconds late: ``z(t) = s(t - delay)``.

    From ``z(t)`` on such a measurement moves as the car does under the inputs of then, ``dz/dt = f(z, u(t - delay))``.
    A late odometry is thus early actuators, and that is how a model steps it. The inputs are delayed by a first-order
    Pade approximation, whose gain is 1 at all frequencies; with forward Euler steps of at least half the delay it is
    the mean of the delayed inputs over the step, exactly. Time and place in the context are not delayed.

    A simulated car is not slowed down: its velocity and yaw rate are the true ones, read late. Its pose is not late.
    """

    NAME = "odometry_delay"
    SUMMARY = "Velocity and yaw rate are stamped later than they were, so the car seems to answer late."
    ADVICE = "Stamp the odometry when it is measured, or take its delay off its stamps."
    MANOEUVRE = "quick changes of steering and throttle"
    PARAMETERS = {"delay": Parameter("s", 0.0, 0.3, 0.0)}
    TYPICAL = (0.008, 0.16)
    EFFECT_STATES = ("odometry_delay.r", "odometry_delay.delta")
    SENSOR = True
    delay: Array = 0.0

    @property
    def reading_delay(self) -> float:
        """The delay itself."""
        return float(self.delay)

    def inputs(self, xp: Any, q: Motion) -> None:
        throttle, steering = self.EFFECT_STATES
        q.r = 2 * lagged(q, throttle, q.r, self.delay / 2) - q.r
        q.delta = 2 * lagged(q, steering, q.delta, self.delay / 2) - q.delta


@dataclass(frozen=True)
class YawRateBias(MeasurementEffect):
    """``omega + bias`` is measured. Exact."""

    NAME = "yaw_rate_bias"
    SUMMARY = "The measured yaw rate is off by a constant."
    ADVICE = "Zero the gyroscope at standstill before each run."
    MANOEUVRE = "standing still or driving straight"
    PARAMETERS = {"bias": Parameter("rad/s", -0.3, 0.3, 0.0)}
    TYPICAL = (0.003, 0.03)
    bias: Array = 0.0

    def changed(self, xp: Any, state: State, effect_states: Mapping[str, Array], way: float) -> State:
        return state._replace(omega=state.omega + way * self.bias)


@dataclass(frozen=True)
class YawRateLag(MeasurementEffect):
    """A low-pass filter ``time_constant * dz/dt = omega - z``; ``z`` is measured.

    Its state is how far the measurement lags behind, ``L = omega - z`` with ``dL/dt = domega/dt - L / time_constant``.
    In a simulation and along a prediction that is exact. Where a prediction starts from one measured row, ``L`` is not
    known; it starts as if the yaw acceleration of the model had been there for long, ``L = time_constant * domega/dt``.
    """

    NAME = "yaw_rate_lag"
    SUMMARY = "The measured yaw rate is low-pass filtered, so it lags behind the car."
    ADVICE = "Widen the filter of the yaw rate sensor, or account for it where the signal is used."
    MANOEUVRE = "quick steering from side to side"
    PARAMETERS = {"time_constant": Parameter("s", 0.0, 0.5, 0.0)}
    TYPICAL = (0.013, 0.25)
    EFFECT_STATES = ("yaw_rate_lag.behind",)
    time_constant: Array = 0.0

    def accelerations(self, xp: Any, q: Motion) -> None:
        (name,) = self.EFFECT_STATES
        resolved = at_least(self.time_constant, q.h)
        behind = q.effect_states.setdefault(name, self.time_constant * q.omega_dot)
        q.effect_state_rates[name] = (self.time_constant * q.omega_dot - behind) / resolved

    def changed(self, xp: Any, state: State, effect_states: Mapping[str, Array], way: float) -> State:
        return state._replace(omega=state.omega - way * effect_states.get(self.EFFECT_STATES[0], 0.0))


@dataclass(frozen=True)
class OdometryCorrection(MeasurementEffect):
    """An estimate that drifts and is set right by a step of ``(v_x, v_y, omega)`` once a ``period``.

    ``z = s + (v_x, v_y, omega) (1/2 - u)``, with ``u`` from 0 to 1 the part of the period that has passed since the last
    step. Steps are at ``clock = (n + phase) period``. Its state is the clock, so that a step falls where it does however the
    motion is integrated. Exact for steps of one sign and size; those of random sign are for the online layer.
    """

    NAME = "odometry_correction"
    SUMMARY = "The estimate of the odometry drifts and is set right by a step, again and again after the same time."
    ADVICE = "Find the sensor of that period and let the filter take it in smoothly, with its true delay and noise."
    MANOEUVRE = "straight and steady driving for a minute"
    PARAMETERS = {
        "v_y": Parameter("m/s", -1.0, 1.0, 0.0, context=("clock",)),
        "v_x": Parameter("m/s", -1.0, 1.0, 0.0, context=("clock",)),
        "omega": Parameter("rad/s", -0.5, 0.5, 0.0, context=("clock",)),
        "period": Parameter("s", 0.02, 60.0, 1.0, shape=True),
        "phase": Parameter("1", 0.0, 1.0, 0.0, shape=True),
    }
    VARIANTS = (("v_y",), ("v_x",), ("omega",), ("v_x", "v_y"), ("v_x", "v_y", "omega"))
    READ_OFF = ("period", "phase")
    TYPICAL = (0.03, 0.2)
    EFFECT_STATES = ("odometry_correction.clock",)
    v_y: Array = 0.0
    v_x: Array = 0.0
    omega: Array = 0.0
    period: Array = 1.0
    phase: Array = 0.0

    @classmethod
    def read_off(cls, steps: StepErrors) -> dict[str, float] | None:
        """The period and phase at which errors of one sign recur."""
        found = recurring_step(steps)
        return None if found is None else {"period": found.period, "phase": found.phase}

    @classmethod
    def drawn(cls, amount: float, rng: np.random.Generator) -> dict[str, float]:
        """A step of that size in v_y at a rate as filters and receivers have it, at a random instant."""
        side, period = float(rng.choice([-1.0, 1.0])), float(rng.choice([0.5, 1.0, 2.0]))
        return {"v_y": side * amount, "period": period, "phase": float(rng.uniform())}

    def accelerations(self, xp: Any, q: Motion) -> None:
        (name,) = self.EFFECT_STATES
        if name not in q.effect_states:
            q.effect_states[name] = like(q, self.read(q, "clock"))
        q.effect_state_rates[name] = like(q, 1.0)

    def changed(self, xp: Any, state: State, effect_states: Mapping[str, Array], way: float) -> State:
        angle = (
            2.0 * math.pi * (effect_states.get(self.EFFECT_STATES[0], 0.0 * state.v_x) / self.period - self.phase - 0.5)
        )
        off = -way * xp.arctan2(xp.sin(angle), xp.cos(angle)) / (2.0 * math.pi)
        return State(state.v_x + off * self.v_x, state.v_y + off * self.v_y, state.omega + off * self.omega)
