"""What a cause is worth where it was not fitted: every unit of the drive is left out in turn, and the car fitted again.

A unit is a recording, a lap, or a quarter of the time. Its windows are predicted by a car that was fitted to all others.
What acts in one recording alone is judged by parts of that recording, and what acts at places that were passed once by
stretches of a few seconds.
The logarithm of their predictive likelihood with a cause, less that without it, is what the cause gains there (Vehtari,
Gelman and Gabry 2017). A cause that follows the accidents of one stretch gains nothing elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from dynssm_ros.arrays import Indices, Mask, Vector
from dynssm_ros.identification.problem.fit import Fit, IdentificationProblem
from dynssm_ros.identification.problem.noise import Noise
from dynssm_ros.identification.problem.recordings import CrossValidation, Folds
from dynssm_ros.parallel import IN_TURN, Pool
from dynssm_ros.vehicle.effects import EFFECTS

_KNOWN = 2.0  # standard errors that the nominal values must be spared, where left-out units tell nothing
_ONE_OF_MANY = 2.0  # standard errors to be gained by what one recording has, or a place passed once: many are tried
_ROUNDS = 4  # of linearising anew, from the fit of all
_HARDLY = 3.0  # logarithm of a likelihood ratio that is no strong evidence yet (Kass and Raftery 1995)


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
        improvement: logarithm of the predictive likelihood with it less that without it, by unit, ``(U,)``; correlated
            errors count once.
        std: standard error of their sum.
        known: the same of the nominal values under what was known of them: what it spares them to be moved.
        share: of the squared error at the end of the simulations that is gone, by channel, ``(3,)``.
        least: standard errors that the improvement must be more than.
    """

    improvement: Vector
    std: float
    known: float
    share: Vector
    least: float = 1.0

    @property
    def total(self) -> float:
        """Of all units, and of what was known."""
        return float(self.improvement.sum()) + self.known

    @property
    def rests_on_known(self) -> bool:
        """Whether what was known of the nominal values tells more for it than the left-out units."""
        return self.known > float(self.improvement.sum())

    @property
    def holds(self) -> bool:
        """Whether the improvement is more than :attr:`least` standard errors, and there in half of the units or more.

        More mass, say, predicts no better than less drive and less drag. What tells them apart is that the car was weighed:
        then it is enough that nothing speaks against the cause elsewhere.
        """
        elsewhere, least = float(self.improvement.sum()), self.least * self.std
        if self.total <= least:
            return False
        repeats = 2 * int((self.improvement > 0).sum()) >= len(self.improvement)
        if repeats and (elsewhere > least or not self.rests_on_known):
            return True
        return self.rests_on_known and elsewhere > -self.std and self.known > _KNOWN * self.std

    @property
    def alike(self) -> bool:
        """Whether the two cannot be told apart: the improvement is within its standard error, or too little."""
        return self.total < max(self.std, _HARDLY)


class LeaveOneOut:
    """Fits without each unit in turn.

    Args:
        problem: all windows.
        left_out: how.
        pool: where the fits are made.
    """

    def __init__(self, problem: IdentificationProblem, left_out: CrossValidation, pool: Pool = IN_TURN) -> None:
        self._problem, self._left_out, self._pool = problem, left_out, pool
        self._known: dict[tuple[int, int], tuple[Fit, _Predicted]] = {}

    def compare(self, without: Fit, fit: Fit) -> Confirmation:
        """What ``fit`` gains over ``without``."""
        only_in = _differ_only_in(without, fit)
        folds = self._folds(without, fit, only_in)
        before, after = self._predicted(without, folds), self._predicted(fit, folds)
        number = self._problem.windows.number
        told = np.isin(number, only_in) if only_in else np.ones(len(number), dtype=bool)
        by_window = ((after.likelihood - before.likelihood) / self._problem.tempering)[told]
        by_unit, by_block = (sums_of(by_window, n[told]) for n in (folds.unit, self._problem.block))
        known = (self._problem.surprise(without) - self._problem.surprise(fit)) / 2.0
        left = after.error[told].sum(axis=0) / np.maximum(before.error[told].sum(axis=0), 1e-300)
        passed_once = self._left_out.has_places_once and folds is self._left_out.places
        least = _ONE_OF_MANY if only_in or passed_once else 1.0
        return Confirmation(by_unit, max(standard_error(by_unit), standard_error(by_block)), known, 1.0 - left, least)

    def _folds(self, without: Fit, fit: Fit, only_in: tuple[int, ...]) -> Folds:
        """What is left out in turn to tell two fits apart."""
        if not only_in and self._left_out.has_recordings:
            return self._left_out.recordings
        return self._left_out.places if _differ_by_place(without, fit) else self._left_out.parts

    def _predicted(self, fit: Fit, folds: Folds) -> _Predicted:
        """Of each window by the fit without its fold; noise and the place of a local effect stay as they were found.

        So do effects of single recordings where whole recordings are left out, which tell nothing of them.
        """
        fold, key = folds.fold, (id(fit), id(folds))
        if key not in self._known:
            near = _held(fit, self._left_out.has_recordings and folds is self._left_out.recordings)
            likelihood, error = np.empty(len(fold)), np.empty((len(fold), 3))
            out = [fold == number for number in range(int(fold.max()) + 1)]
            for these, found in zip(out, self._pool.map(partial(_without, self._problem, near), out), strict=True):
                likelihood[these], error[these] = found
            self._known[key] = fit, _Predicted(likelihood, error)
        return self._known[key][1]


def _without(problem: IdentificationProblem, near: Fit, out: Mask) -> _Predicted:
    """What a fit without some windows says of these."""
    rest, unseen = problem.select(~out), problem.select(out)
    start = replace(near, errors=near.errors[~out], jacobian=near.jacobian[~out])
    noise = Noise(rest.spread, near.noise.v)
    found = rest.fit(near.car, near.free, start, rounds=_ROUNDS, rough=True, noise=noise)
    errors = unseen.errors(found.car)
    return _Predicted(unseen.log_likelihood(errors, Noise(unseen.spread, near.noise.v)), errors[:, -3:] ** 2)


def _differ_only_in(one: Fit, other: Fit) -> tuple[int, ...]:
    """The recordings outside of which two fits have the same effects; empty: they differ in all."""
    acts = [{name: fit.car.only_in.get(name, ()) for name in fit.car.effects} for fit in (one, other)]
    differ = set(acts[0].items()) ^ set(acts[1].items())
    return () if not all(where for _, where in differ) else tuple({k for _, where in differ for k in where})


def _differ_by_place(one: Fit, other: Fit) -> bool:
    """Whether what one fit has free and the other has not acts at places of the lap."""
    return any(EFFECTS[effect].acts_by_place((name,)) for effect, name in set(one.free) ^ set(other.free))


def _held(fit: Fit, recordings: bool) -> Fit:
    """The fit with what shapes its effects, such as the place of a local one, no longer free.

    Args:
        fit: of all.
        recordings: whether effects of single recordings are no longer free either.
    """
    held = [
        k
        for k, (effect, name) in enumerate(fit.free)
        if EFFECTS[effect].PARAMETERS[name].shape or (recordings and effect in fit.car.only_in)
    ]
    free = tuple(pair for k, pair in enumerate(fit.free) if k not in held)
    return replace(fit, free=free, jacobian=np.delete(fit.jacobian, [len(fit.car.moved) + k for k in held], axis=2))


def sums_of(values: Vector, number: Indices) -> Vector:
    """Sums of values with the same number, of those numbers that there are."""
    return np.bincount(np.unique(number, return_inverse=True)[1], values).astype(np.float64)


def standard_error(parts: Vector) -> float:
    """Standard error of the sum of independent parts."""
    return float(np.sqrt(len(parts)) * np.std(parts, ddof=1)) if len(parts) > 1 else float("inf")
