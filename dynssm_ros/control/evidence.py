"""What a model adapts is planned with only where it has predicted better than the calibrated car, over whole
horizons.

Every few steps the car is predicted from where it was measured, under the commands that were sent, by each of
:data:`SOURCES`. At the end of the horizon these paths are compared with the measured one; all follow from velocities,
so the noise of a pose does not matter. Without evidence the calibrated car is planned with. What each mispredicts is
followed, and counts as part of it (:mod:`dynssm_ros.control.disturbance`).

Choosing by what was predicted before it was seen is prequential model selection (Dawid 1984).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.control.caution import Caution, Margins
from dynssm_ros.control.horizon_model import VELOCITIES
from dynssm_ros.control.nmpc import Adapted
from dynssm_ros.runtime.comparison import RunningComparison
from dynssm_ros.vehicle import State
from dynssm_ros.vehicle.kinematics import Pose, advance_pose, axle_direction

Source = Literal["calibrated", "coefficients", "model"]
SOURCES: tuple[Source, ...] = ("calibrated", "coefficients", "model")
"""The calibrated car; with the adapted coefficients; with all that the model says."""

_AT_ONCE = 4  # horizons under way
_FEWEST = 6  # of them, before anything is believed
_CLEARLY = 0.05  # logarithm of the distances' ratio
_SETTLING = 1.0  # horizons in which 63 % of a switch are made

Following = Callable[[Vector, Vector, Adapted, float], Vector]
"""From states ``(n, size)``, increments of the inputs, what holds for each, and the time (s) to the states one T_s later."""


class _Rollouts(NamedTuple):
    """Predictions under way to the end of their horizons, ``n`` of them, three from each start: one of each source."""

    states: Vector  # (n, size)
    paths: Vector  # poses on the way, from the predicted velocities, (n, 3)
    measured: Vector  # likewise from the measured ones, (n, 3)
    theta: Vector  # what they are predicted with, (n, 17)
    correction: Vector  # likewise, (n, 3)
    distances: Vector  # from the measured path, summed over the steps so far (m), (n,)
    left: Vector  # steps to the end, (n,)


class Evidence:
    """Chooses between the calibrated car and what a model says of it, step by step.

    Args:
        following: one step of the car.
        steps: of the horizon.
        T_s: length of a step (s).
        axles: distances of the front and the rear axle from the centre of gravity, forwards (m).
    """

    def __init__(self, following: Following, steps: int, T_s: float, axles: tuple[float, float]) -> None:
        self._following = following
        self._axles = np.array(axles)
        self._caution = Caution(len(SOURCES), steps)
        self._T_s = T_s
        self._steps = steps
        self._every = max(1, steps // _AT_ONCE)
        self._rate = -math.expm1(-1.0 / (_SETTLING * steps))
        self.forget()

    def forget(self) -> None:
        """Begins anew, with the calibrated car."""
        self._comparison = RunningComparison(len(SOURCES))
        self.weights = np.array([1.0, 0.0, 0.0])
        """Shares with which each source is planned with, ``(3,)``."""
        self._caution.forget()
        self.interrupt()

    def interrupt(self) -> None:
        """Drops what is under way: the next state does not follow on the last one."""
        self._under_way: _Rollouts | None = None
        self._since = 0
        self._sent: tuple[Vector, Vector, float] | None = None

    @property
    def source(self) -> Source:
        """What is believed now."""
        advantage, best = self._comparison.advantage, int(np.argmax(self._comparison.advantage))
        return SOURCES[best if self._comparison.paths >= _FEWEST and advantage[best] > _CLEARLY else 0]

    def earned(self, said: Sequence[Adapted]) -> Adapted:
        """What to plan with: a mixture of what each of :data:`SOURCES` says."""
        target = np.array([source == self.source for source in SOURCES], dtype=np.float64)
        self.weights = self.weights + self._rate * (target - self.weights)
        parts = [(weight, one) for weight, one in zip(self.weights, said, strict=True) if weight > 0]
        theta, correction = (sum(weight * one[k] for weight, one in parts) for k in range(2))
        return Adapted(np.asarray(theta), np.asarray(correction))

    def margins(self) -> Margins:
        """For plans with what was :meth:`earned`: by what it would have been wrong lately."""
        return self._caution.margins(self.weights)

    def sent(self, state: Vector, increments: Vector, said: Sequence[Adapted], t: float) -> None:
        """Takes the next state as estimated from its measurement, ``(size,)``, and the ``increments`` ``(2,)`` sent
        there at ``t`` (s).

        ``said`` is at that state by each of :data:`SOURCES`.
        """
        if self._under_way is not None and self._sent is not None:
            self._under_way = self._advanced(self._under_way, state)
        self._sent = state, increments, t
        if self._since % self._every == 0:
            self._under_way = self._started(state, together(said))
        self._since += 1

    def _started(self, state: Vector, said: Adapted) -> _Rollouts:
        """What is under way, with one more from ``state`` for each source."""
        n, old = len(SOURCES), self._under_way
        starts = np.tile(state, (n, 1))
        new = _Rollouts(starts, np.zeros((n, 3)), np.zeros((n, 3)), *said, np.zeros(n), np.full(n, float(self._steps)))
        return new if old is None else _Rollouts(*map(np.concatenate, zip(old, new, strict=True)))

    def _advanced(self, rollouts: _Rollouts, measured: Vector) -> _Rollouts:
        """All one step further; those at their end are compared with what was measured, and dropped."""
        assert self._sent is not None
        before, increments, t = self._sent
        states = self._following(rollouts.states, increments, Adapted(rollouts.theta, rollouts.correction), t)
        paths = self._moved(rollouts.paths, rollouts.states, states)
        reached = self._moved(rollouts.measured, before[None], measured[None])
        away = paths - reached
        distances = rollouts.distances + np.hypot(*away[:, :2].T)
        self._watch(rollouts.left, states, measured, away, reached[:, 2])
        moved = rollouts._replace(
            states=states, paths=paths, measured=reached, distances=distances, left=rollouts.left - 1.0
        )
        done = moved.left <= 0
        if done.any():
            self._comparison.add(moved.distances[done][0], moved.distances[done])
        return _Rollouts(*(part[~done] for part in moved))

    def _watch(self, left: Vector, states: Vector, measured: Vector, away: Vector, heading: Vector) -> None:
        """Takes what predictions with ``left`` steps to go were wrong by after the next one."""
        rows = np.arange(len(left))
        step = np.asarray(self._steps - left, dtype=np.intp)
        lateral = np.cos(heading) * away[:, 1] - np.sin(heading) * away[:, 0]
        gone = states[:, VELOCITIES].T[..., None]
        slip = axle_direction(np, self._axles, *gone) - axle_direction(np, self._axles, *measured[VELOCITIES])
        self._caution.update(rows % len(SOURCES), step, lateral, slip)

    def _moved(self, poses: Vector, before: Vector, after: Vector) -> Vector:
        """Poses ``(n, 3)`` one step on, by the velocities of the states ``(n, size)`` before and after it."""
        first, second = (State(*states[:, VELOCITIES].T) for states in (before, after))
        moved = advance_pose(np, Pose(*poses.T), first, second, self._T_s)
        return np.stack(np.broadcast_arrays(*moved), axis=1)


def sources(calibrated: Adapted, said: Adapted) -> tuple[Adapted, ...]:
    """What each of :data:`SOURCES` says: the calibrated car, its coefficients as a model has them, and all of the model."""
    return calibrated, Adapted(said.theta, calibrated.correction), said


def together(said: Sequence[Adapted]) -> Adapted:
    """What several say of the first step, ``(n, 17)`` and ``(n, 3)``."""
    return Adapted(*(np.stack(parts) for parts in zip(*(one.first for one in said), strict=True)))
