"""What a cause is worth where it was not fitted: every unit of the drive is left out in turn, and the car fitted again.

A unit is a lap, or a quarter of the time. Its windows are predicted by a car that was fitted to all others.
The logarithm of their predictive likelihood with a cause, less that without it, is what the cause gains there (Vehtari,
Gelman and Gabry 2017). A cause that follows the accidents of one stretch gains nothing elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from dynssm_ros.arrays import Indices, Vector
from dynssm_ros.identification.noise import Noise
from dynssm_ros.identification.problem import Fit, IdentificationProblem
from dynssm_ros.vehicle.effects import EFFECTS

_KNOWN = 2.0  # standard errors that the nominal values must be spared, where left-out units tell nothing
_ROUNDS = 4  # of linearising anew, from the fit of all


class _Predicted(NamedTuple):
    """How well left-out windows were predicted."""

    likelihood: Vector
    """Logarithm, of each window, ``(W,)``."""
    error: Vector
    """Squared, at the end of each window, ``(W, 3)``."""


@dataclass(frozen=True)
class Confirmation:
    """What a cause gains on units that were left out.

    Attributes:
        gain: logarithm of the predictive likelihood with it less that without it, by unit, ``(U,)``; what hangs together
            counts once.
        std: standard error of their sum.
        known: the same of the nominal values under what was known of them: what it spares them to be moved.
        share: of the squared error at the end of the simulations that is gone, by channel, ``(3,)``.
    """

    gain: Vector
    std: float
    known: float
    share: Vector

    @property
    def total(self) -> float:
        """Of all units, and of what was known."""
        return float(self.gain.sum()) + self.known

    @property
    def holds(self) -> bool:
        """Whether the gain is more than its standard error, and there in half of the units or more.

        More mass, say, predicts no better than less drive and less drag. What tells them apart is that the car was weighed:
        then it is enough that nothing speaks against the cause elsewhere.
        """
        if self.total <= self.std:
            return False
        told = float(self.gain.sum())
        if told >= self.known:
            return 2 * int((self.gain > 0).sum()) >= len(self.gain)
        return told > -self.std and self.known > _KNOWN * self.std

    @property
    def alike(self) -> bool:
        """Whether the two cannot be told apart: the gain is within its standard error."""
        return self.total < self.std


class LeaveOneOut:
    """Fits without each unit in turn.

    Args:
        problem: all windows.
        unit: number of each window's unit, ``(W,)``.
    """

    def __init__(self, problem: IdentificationProblem, unit: Indices) -> None:
        self._problem, self._unit = problem, unit
        self._known: dict[int, tuple[Fit, _Predicted]] = {}

    def compare(self, without: Fit, fit: Fit) -> Confirmation:
        """What ``fit`` gains over ``without``."""
        before, after = self._predicted(without), self._predicted(fit)
        by_window = (after.likelihood - before.likelihood) / self._problem.tempering
        gain: Vector = np.bincount(self._unit, by_window).astype(np.float64)
        std = max(_spread(gain), _spread(np.bincount(self._problem.block, by_window).astype(np.float64)))
        known = (self._problem.surprise(without) - self._problem.surprise(fit)) / 2.0
        left = after.error.sum(axis=0) / np.maximum(before.error.sum(axis=0), 1e-300)
        return Confirmation(gain, std, known, 1.0 - left)

    def _predicted(self, fit: Fit) -> _Predicted:
        """Of each window by the fit without its unit; noise and the place of a local effect stay as they were found."""
        if id(fit) not in self._known:
            near = _placed(fit)
            likelihood, error = np.empty(len(self._unit)), np.empty((len(self._unit), 3))
            for number in range(int(self._unit.max()) + 1):
                out = self._unit == number
                rest, unseen = self._problem.select(~out), self._problem.select(out)
                start = replace(near, errors=near.errors[~out], jacobian=near.jacobian[~out])
                noise = Noise(rest.spread, fit.noise.v)
                found = rest.fit(fit.car, near.free, start, _ROUNDS, rough=True, noise=noise)
                errors = unseen.errors(found.car)
                likelihood[out] = unseen.log_likelihood(errors, Noise(unseen.spread, fit.noise.v))
                error[out] = errors[:, -3:] ** 2
            self._known[id(fit)] = fit, _Predicted(likelihood, error)
        return self._known[id(fit)][1]


def _placed(fit: Fit) -> Fit:
    """The fit with what shapes its effects, such as the place of a local one, no longer free."""
    shaping = [k for k, (effect, name) in enumerate(fit.free) if EFFECTS[effect].PARAMETERS[name].shape]
    free = tuple(pair for k, pair in enumerate(fit.free) if k not in shaping)
    return replace(fit, free=free, jacobian=np.delete(fit.jacobian, [len(fit.car.moved) + k for k in shaping], axis=2))


def _spread(parts: Vector) -> float:
    """Standard error of the sum of independent parts."""
    return float(np.sqrt(len(parts)) * np.std(parts, ddof=1)) if len(parts) > 1 else float("inf")
