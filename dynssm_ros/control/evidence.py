"""What a model adapts is planned with only where it has predicted better than the calibrated car, over whole horizons.

A plan rests on where the car will be at the end of the horizon, and not on the next row. So every few steps the car is
predicted from where it was measured, once by the calibrated car, once with the adapted coefficients, once with what the model
adds to them as well. The commands are those that were sent. At the end of the horizon each path is compared with the measured
one. Without evidence, and where the calibrated car has been as good lately, the calibrated car is planned with.

Choosing by what was predicted before it was seen is prequential model selection (Dawid 1984).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.control.nmpc import Adapted

Source = Literal["calibrated", "coefficients", "model"]
SOURCES: tuple[Source, ...] = ("calibrated", "coefficients", "model")
"""The calibrated car; with the adapted coefficients; with all that the model says."""

_AT_ONCE = 4  # horizons under way
_REMEMBERED = 20  # horizons that the comparison is of
_FEWEST = 6  # of them, before anything is believed
_CLEARLY = 0.05  # logarithm of the distances' ratio
_LARGEST = 2.0  # a single logarithm counts as at most that
_SETTLING = 1.0  # horizons in which 63 % of a switch are made
_NEAR = 1e-9  # m

Following = Callable[[Vector, Vector, Adapted, float], Vector]
"""From a state, increments of the inputs, what is said of the car, and the time (s) to the state one T_s later."""


class _Rollout(NamedTuple):
    """Predictions from one measured state, all under way to the end of the horizon."""

    said: tuple[Adapted, ...]
    states: list[Vector]
    distances: Vector
    done: int


class Evidence:
    """Chooses between the calibrated car and what a model says of it, step by step.

    Args:
        following: one step of the car.
        steps: of the horizon.
    """

    def __init__(self, following: Following, steps: int) -> None:
        self._following = following
        self._steps = steps
        self._every = max(1, steps // _AT_ONCE)
        self._rate = -math.expm1(-1.0 / (_SETTLING * steps))
        self.forget()

    def forget(self) -> None:
        """Begins anew, with the calibrated car."""
        self.advantage = np.zeros(len(SOURCES))
        """Mean logarithm of the calibrated car's distance from the measured paths over that of each source."""
        self.weights = np.array([1.0, 0.0, 0.0])
        """Shares with which each source is planned with, ``(3,)``."""
        self._horizons = 0
        self.interrupt()

    def interrupt(self) -> None:
        """Drops what is under way: the next state does not follow on the last one."""
        self._under_way: list[_Rollout] = []
        self._since = 0
        self._sent: tuple[Vector, float] | None = None

    @property
    def source(self) -> Source:
        """What is believed now."""
        best = int(np.argmax(self.advantage))
        return SOURCES[best if self._horizons >= _FEWEST and self.advantage[best] > _CLEARLY else 0]

    def earned(self, calibrated: Adapted, said: Adapted) -> Adapted:
        """What to plan with.

        Args:
            calibrated: the car without the model.
            said: by the model.
        """
        target = np.array([source == self.source for source in SOURCES], dtype=np.float64)
        self.weights = self.weights + self._rate * (target - self.weights)
        coefficients = 1.0 - self.weights[0]
        return Adapted(
            calibrated.theta + coefficients * (said.theta - calibrated.theta),
            calibrated.correction + self.weights[2] * (said.correction - calibrated.correction),
        )

    def sent(self, state: Vector, increments: Vector, calibrated: Adapted, said: Adapted, t: float) -> None:
        """Takes the next measured state, and what was sent there.

        Args:
            state: estimated from the measurement, ``(size,)``.
            increments: of the inputs, from there on, ``(2,)``.
            calibrated: the car without the model.
            said: by the model at that state.
            t: time (s).
        """
        if self._sent is not None:
            self._under_way = [one for one in (self._advanced(one, state) for one in self._under_way) if one]
        self._sent = increments, t
        if self._since % self._every == 0:
            first = _first(calibrated), Adapted(_first(said).theta, _first(calibrated).correction), _first(said)
            self._under_way.append(_Rollout(first, [state] * len(SOURCES), np.zeros(len(SOURCES)), 0))
        self._since += 1

    def _advanced(self, one: _Rollout, measured: Vector) -> _Rollout | None:
        """A rollout one step further; ``None`` once it is at its end."""
        assert self._sent is not None
        states = [
            self._following(state, self._sent[0], said, self._sent[1])
            for state, said in zip(one.states, one.said, strict=True)
        ]
        distances = one.distances + [math.hypot(*(state[:2] - measured[:2])) for state in states]
        if one.done + 1 < self._steps:
            return _Rollout(one.said, states, distances, one.done + 1)
        self._compare(distances)
        return None

    def _compare(self, distances: Vector) -> None:
        distances = np.nan_to_num(distances, nan=math.inf, posinf=math.inf) + _NEAR
        if not math.isfinite(distances[0]):
            return
        with np.errstate(divide="ignore"):
            ratios = np.clip(np.log(distances[0]) - np.log(distances), -_LARGEST, _LARGEST)
        self._horizons += 1
        self.advantage = self.advantage + (ratios - self.advantage) / min(self._horizons, _REMEMBERED)


def _first(said: Adapted) -> Adapted:
    """What is said of the first step, where steps differ."""
    theta, correction = said
    return Adapted(theta if theta.ndim == 1 else theta[0], correction if correction.ndim == 1 else correction[0])
