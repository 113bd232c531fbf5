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

from dynssm_ros.arrays import Mask, Vector
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
"""From states ``(n, size)``, increments of the inputs, what holds for each, and the time (s) to the states one T_s later."""


class _Rollouts(NamedTuple):
    """Predictions under way to the end of their horizons, ``n`` of them, three from each start: one of each source."""

    states: Vector
    """``(n, size)``."""
    said: Adapted
    """What they are predicted with, ``(n, 17)`` and ``(n, 3)``."""
    distances: Vector
    """From the measured path so far, summed over the steps (m), ``(n,)``."""
    left: Vector
    """Steps to the end, ``(n,)``."""

    def at(self, chosen: Mask) -> _Rollouts:
        """Some of them."""
        said = Adapted(self.said.theta[chosen], self.said.correction[chosen])
        return _Rollouts(self.states[chosen], said, self.distances[chosen], self.left[chosen])


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
        self._under_way: _Rollouts | None = None
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
        if self._under_way is not None and self._sent is not None:
            self._under_way = self._advanced(self._under_way, state)
        self._sent = increments, t
        if self._since % self._every == 0:
            self._under_way = self._started(state, _first(calibrated), _first(said))
        self._since += 1

    def _started(self, state: Vector, calibrated: Adapted, said: Adapted) -> _Rollouts:
        """What is under way, with three more from ``state``."""
        sources = calibrated, Adapted(said.theta, calibrated.correction), said
        n = len(SOURCES)
        new = _Rollouts(
            np.tile(state, (n, 1)),
            Adapted(*(np.stack(parts) for parts in zip(*sources, strict=True))),
            np.zeros(n),
            np.full(n, float(self._steps)),
        )
        old = self._under_way
        if old is None:
            return new
        said = Adapted(*(np.concatenate(parts) for parts in zip(old.said, new.said, strict=True)))
        parts = ((old.states, new.states), (old.distances, new.distances), (old.left, new.left))
        states, distances, left = (np.concatenate(pair) for pair in parts)
        return _Rollouts(states, said, distances, left)

    def _advanced(self, rollouts: _Rollouts, measured: Vector) -> _Rollouts:
        """All one step further; those at their end are compared with what was measured, and dropped."""
        assert self._sent is not None
        states = self._following(rollouts.states, self._sent[0], rollouts.said, self._sent[1])
        distances = rollouts.distances + np.hypot(*(states[:, :2] - measured[:2]).T)
        moved = rollouts._replace(states=states, distances=distances, left=rollouts.left - 1.0)
        done = moved.left <= 0
        if done.any():
            self._compare(moved.distances[done])
        return moved.at(~done)

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
