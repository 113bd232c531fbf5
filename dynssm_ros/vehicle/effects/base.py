"""What an effect is: named, bounded parameters, stages at which it acts, states of its own, signals that it needs.

At its neutral value an effect is absent: nothing of it is evaluated. The values may be floats, as in a vehicle file, or
arrays, tensors or symbols, so that a fit can vary many at once or differentiate; those are always evaluated.
"""

from __future__ import annotations

import math
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.errors import ConfigurationError
from dynssm_ros.vehicle.effects.step_errors import StepErrors
from dynssm_ros.vehicle.single_track import (
    Applied,
    Array,
    Coefficients,
    Motion,
    StageEffect,
    State,
    VehicleConstants,
    at_least,
)

CONTEXT_UNITS: dict[str, str] = {
    "t": "s", "clock": "s", "s": "m", "lap_length": "m", "bend": "1", "x": "m", "y": "m", "theta": "rad", "roll": "rad",
    "gear": "1", "engine_speed": "rad/s",
}  # fmt: skip
"""The signals beside state and inputs that effects may read: time since the start of the drive or recording, time of the
day (UTC) by the stamps, position along the track's centre line (which may count on over the laps), the length of a lap, and
how sharply the line bends there (from -1 to the right to 1 to the left, its sharpest places), pose, measured roll of the car
(positive with the left side up), gear and speed of the engine."""

PLACE = ("s", "lap_length", "bend")
LAP = PLACE[:2]
_AT = 1e-3  # of the span, nearer to a bound than which a value is on it
SLOWEST = 1e-3  # m/s; what divides by the speed does not divide by less


@dataclass(frozen=True)
class Parameter:
    """A parameter of an effect."""

    unit: str  # SI unit; ``1`` for a plain number, ``lap`` for a fraction of the lap
    lower: float  # smallest admissible value
    upper: float  # largest admissible value
    neutral: float  # the value at which the effect vanishes; also the default
    shape: bool = False
    """It says where or how the effect acts and not how much. The effect vanishes with its other parameters, at whatever
    value this one has."""
    context: tuple[str, ...] = ()  # the signals that the effect needs once this parameter is not neutral
    local: bool = False  # it says how much the effect acts within the section of the lap that centre and length give
    tried: tuple[float, ...] = ()  # values at which a search tries a parameter that shapes

    @property
    def span(self) -> float:
        """The farthest that it can be off its neutral value."""
        return max(self.upper - self.neutral, self.neutral - self.lower)

    @property
    def scales(self) -> bool:
        """Whether it multiplies what is positive; then it is fitted as a logarithm."""
        return self.neutral == 1.0 and self.lower > 0.0

    def at_bound(self, value: float) -> bool:
        """Whether ``value`` is as far off neutral as it can be."""
        return any(abs(value - bound) < _AT * self.span and bound != self.neutral for bound in (self.lower, self.upper))

    @property
    def direction(self) -> float:
        """1 if it can grow from its neutral value, else -1."""
        return 1.0 if self.upper > self.neutral else -1.0


CENTRE = Parameter("lap", 0.0, 1.0, 0.5, shape=True, tried=tuple(k / 32 for k in range(32)))
"""Middle of the section of the lap on which a local effect acts."""
LENGTH = Parameter("lap", 0.01, 0.8, 0.1, shape=True, tried=(0.03, 0.06, 0.12, 0.25))  # length of that section
LOCATION = ("centre", "length")  # names of the parameters that place a local effect


@dataclass(frozen=True)
class Effect(StageEffect):
    """Base of all effects. The dataclass fields of a subclass are its parameters, described in ``PARAMETERS``.

    A subclass overrides the stages of :class:`~dynssm_ros.vehicle.single_track.StageEffect` at which it acts.
    """

    NAME: ClassVar[str] = ""  # as in vehicle files
    SUMMARY: ClassVar[str] = ""  # what it is, in one sentence
    ADVICE: ClassVar[str] = ""  # what a team would do about it
    MANOEUVRE: ClassVar[str] = ""  # the driving that shows it best
    PARAMETERS: ClassVar[dict[str, Parameter]] = {}  # the parameters by name
    VARIANTS: ClassVar[tuple[tuple[str, ...], ...]] = ()
    """Sets of parameters to be fitted together, the simplest first; empty: all of them."""
    OPEN_ROAD: ClassVar[tuple[tuple[str, ...], ...]] = ()  # those of them that cannot be on a closed lap
    EFFECT_STATES: ClassVar[tuple[str, ...]] = ()  # names of its own states. :func:`lagged` settles and integrates them
    SENSOR: ClassVar[bool] = False  # it changes what the sensors show; the car moves as without it
    TYPICAL: ClassVar[tuple[float, float]] = (0.0, 0.0)
    """How far it is off neutral in a car that is badly set up: just noticeable in ordinary laps, and large."""
    DIRECTIONS: ClassVar[tuple[float, ...]] = ()
    """To which sides of neutral it is met in a car that can be driven; empty: those that its bounds admit."""
    LEAST: ClassVar[float] = 0.0  # how far it is off neutral in any car
    READ_OFF: ClassVar[tuple[str, ...]] = ()
    """Parameters that :meth:`read_off` finds in the errors of single steps, and no fit moves: when the effect acts."""
    GIVEN: ClassVar[tuple[str, ...]] = ()  # those of them that the driving tells, whatever the errors are

    @classmethod
    def variants(cls) -> tuple[tuple[str, ...], ...]:
        """Sets of parameters to be fitted together, the simplest first."""
        return cls.VARIANTS or (tuple(cls.PARAMETERS),)

    @classmethod
    def signals(cls, parameters: Iterable[str] | None = None) -> tuple[str, ...]:
        """The context that the effect needs when ``parameters`` (all if not given) are not neutral."""
        names = cls.PARAMETERS if parameters is None else parameters
        return tuple(dict.fromkeys(signal for name in names for signal in cls.PARAMETERS[name].context))

    @classmethod
    def acts_by_place(cls, parameters: Iterable[str]) -> bool:
        """Whether these parameters act differently from place to place on the lap."""
        return LAP[0] in cls.signals(parameters)

    @classmethod
    def magnitude(cls) -> Parameter:
        """The first parameter that says how much."""
        return next(about for about in cls.PARAMETERS.values() if not about.shape)

    @classmethod
    def drawn(cls, amount: float, rng: np.random.Generator) -> dict[str, float]:
        """Parameters of an effect that is ``amount`` off neutral, to a random side; for simulated test drives."""
        name, about = next((name, about) for name, about in cls.PARAMETERS.items() if not about.shape)
        side = float(rng.choice([-1.0, 1.0])) if about.lower < about.neutral else 1.0
        if cls.DIRECTIONS and side not in cls.DIRECTIONS:
            side = cls.DIRECTIONS[0]
        values = {name: about.neutral + side * amount}
        if about.local:
            values |= dict(zip(LOCATION, (float(rng.uniform(0.1, 0.9)), float(rng.uniform(0.12, 0.3))), strict=True))
        return values

    @classmethod
    def amount(cls, values: Mapping[str, float]) -> float:
        """How far off neutral an effect with these parameters is: what :meth:`drawn` was given."""
        about = {name: p for name, p in cls.PARAMETERS.items() if not p.shape and name in values}
        return math.hypot(*(values[name] - p.neutral for name, p in about.items()))

    @classmethod
    def unusable(cls, constants: VehicleConstants) -> str | None:
        """What is wrong with a car of these constants for the effect to be able to act; ``None`` if nothing is."""
        return None

    @classmethod
    def least(cls, constants: VehicleConstants, steered: float) -> float:
        """How far it must be off neutral to be a cause in a car of these constants; less is in any car.

        Args:
            constants: of the car.
            steered: the largest steering angle that was driven (rad).
        """
        return cls.LEAST

    @classmethod
    def read_off(cls, steps: StepErrors) -> dict[str, float] | None:
        """Values of ``READ_OFF``; ``None``: nothing in these errors asks for the effect, so that it is not tried."""
        return {}

    @property
    def parameters(self) -> dict[str, Array]:
        """The values by name."""
        return {f.name: getattr(self, f.name) for f in fields(self)}

    @cached_property
    def active(self) -> frozenset[str]:
        """The parameters that are off their neutral value; those that shape do not count."""
        return frozenset(
            name
            for name, about in self.PARAMETERS.items()
            if not about.shape and not _is_number(getattr(self, name), about.neutral)
        )

    @property
    def is_neutral(self) -> bool:
        """Whether the effect is absent."""
        return bool(self.PARAMETERS) and not self.active

    @property
    def needs(self) -> tuple[str, ...]:
        """The context that it needs with its present values."""
        return self.signals(name for name in self.PARAMETERS if name in self.active)

    @property
    def carries(self) -> tuple[str, ...]:
        """Its own states, by name; none while it is absent."""
        return () if self.is_neutral else self.EFFECT_STATES

    @property
    def reading_delay(self) -> float:
        """How late (s) all states are read, in a simulation; a prediction has its own means of it."""
        return 0.0

    def read(self, q: Motion, signal: str) -> Array:
        """A signal of the context.

        Raises:
            ConfigurationError: it is not known here.
        """
        if signal not in q.context:
            raise ConfigurationError(_lacking(self, signal, q.context))
        return q.context[signal]

    def along_lap(self, lap: Vector, bend: Vector | None = None) -> tuple[str, Vector] | None:
        """Name with unit, and values at places ``(n,)`` (fractions of the lap).

        ``None``: the place does not matter, or only by how the road bends, which is not given.
        """
        return None

    def lap(self, q: Motion) -> Array:
        """Track position as a fraction of the lap."""
        return self.read(q, "s") / self.read(q, "lap_length")


def _is_number(value: Array, number: float) -> bool:
    return isinstance(value, (int, float)) and value == number


def initial_effect_states(effects: Sequence[StageEffect], r: Array, delta: Array) -> dict[str, Array]:
    """The own states of ``effects`` on the inputs, settled under throttle ``r`` and steering ``delta``.

    States on anything else depend on the car's motion: ``CarModel.settled`` finds all of them, and its steps those that
    are missing.
    """
    return inputs_alone(None, State(0.0, 0.0, 0.0), Applied(r, delta), effects, effect_states={}).effect_states


def inputs_alone(
    xp: Any,
    state: State,
    applied: Applied,
    effects: Sequence[StageEffect],
    *,
    effect_states: Mapping[str, Array],
    h: float = 0.0,
) -> Motion:
    """The stage of the inputs alone, without a car: the states on the inputs and their rates."""
    zero = Coefficients(*(0.0,) * len(Coefficients._fields))
    q = Motion(
        *state, *applied, theta=zero, m=0.0, l_f=0.0, l_r=0.0, h_cg=0.0, F_z0=0.0, load_transfer=False,
        effect_states=dict(effect_states), h=h,
    )  # fmt: skip
    for effect in effects:
        if not effect.is_neutral:
            effect.inputs(xp, q)
    return q


def require_context(effects: Iterable[StageEffect], available: Iterable[str], where: str) -> None:
    """Checks that ``where`` knows what ``effects`` need.

    Raises:
        ConfigurationError: a signal is missing; names the effect, the signal and what there is.
    """
    have = set(available)
    for effect in effects:
        for signal in effect.needs:
            if signal not in have:
                raise ConfigurationError(f"{where}: {_lacking(effect, signal, have)}")


def _lacking(effect: StageEffect, signal: str, have: Container[str]) -> str:
    known = ", ".join(name for name in CONTEXT_UNITS if name in have) or "none"
    return (
        f"effect {effect.NAME} needs the signal {signal} ({CONTEXT_UNITS[signal]}), which is not known here ({known})"
    )


def lagged(q: Motion, name: str, target: Array, time_constant: Array) -> Array:
    """``target`` behind a first-order lag with the state ``q.effect_states[name]``; a state that is missing is settled.

    A lag that is quicker than the integrator's step would ring. Its state then reaches the target within the step, and
    the result lies between the two, for forward Euler as the mean over the step does; with a time constant of 0 it is
    the target.
    """
    resolved = at_least(time_constant, q.h)
    state = q.effect_states.setdefault(name, target)
    q.effect_state_rates[name] = (target - state) / resolved
    return target + time_constant / resolved * (state - target)


def like(q: Motion, value: Array) -> Array:
    """``value`` as the kind of array that the motion is made of: torch takes no sine of a float."""
    return value + 0.0 * q.v_x


def section(xp: Any, lap: Array, centre: Array, length: Array) -> Array:
    """1 within a section of the lap, 0 outside; each edge takes about a fifth of the length.

    Args:
        xp: array namespace.
        lap: track position (lap).
        centre: middle of the section (lap).
        length: its length (lap).
    """
    return (1 + xp.tanh((length / 2 - away(xp, lap, centre)) / (0.1 * length))) / 2


def away(xp: Any, lap: Array, centre: Array) -> Array:
    """Distance of the track position ``lap`` from ``centre`` along the lap, the shorter way round (lap)."""
    angle = 2 * math.pi * (lap - centre)
    return abs(xp.arctan2(xp.sin(angle), xp.cos(angle))) / (2 * math.pi)
