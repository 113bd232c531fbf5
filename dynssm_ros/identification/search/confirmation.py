"""What a cause is worth where it was not fitted: every unit of the drive is left out in turn, and the car fitted again.

A unit is a recording, a lap, or a quarter of the time. Its windows are predicted by a car that was fitted to all others.
What acts in one recording alone is judged by parts of that recording, and what acts at places that were passed once by
stretches of a few seconds. The logarithm of their predictive likelihood with a cause, less that without it, is its
improvement there (Vehtari, Gelman and Gabry 2017). A cause that follows the accidents of one stretch has none elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from dynssm_ros.arrays import Mask, Vector, sums_by
from dynssm_ros.identification import tuning
from dynssm_ros.identification.problem.fit import Fit, IdentificationProblem
from dynssm_ros.identification.problem.noise import Noise
from dynssm_ros.identification.problem.recordings import CrossValidation, Folds
from dynssm_ros.parallel import IN_TURN, Pool
from dynssm_ros.vehicle.effects import EFFECTS


@dataclass(frozen=True)
class Confirmation:
    """What a cause improves on units that were left out.

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
    def elsewhere(self) -> float:
        """Of all units."""
        return float(self.improvement.sum())

    @property
    def total(self) -> float:
        """Of all units, and of what was known."""
        return self.elsewhere + self.known

    @property
    def rests_on_known(self) -> bool:
        """Whether what was known of the nominal values tells more for it than the left-out units."""
        return self.known > self.elsewhere

    @property
    def is_known(self) -> bool:
        """Whether what was known of the nominal values is very strong evidence for it by itself."""
        return 2.0 * self.known > tuning.DECISIVE_DELTA_BIC

    @property
    def holds(self) -> bool:
        """Whether the improvement is more than :attr:`least` standard errors, and there in half of the units or more.

        More mass, say, predicts no better than less drive and less drag. What tells them apart is that the car was weighed:
        then it is enough that nothing speaks against the cause elsewhere.
        """
        least = self.least * self.std
        if self.total <= least:
            return False
        repeats = 2 * int((self.improvement > 0).sum()) >= len(self.improvement)
        if repeats and (self.elsewhere > least or not self.rests_on_known):
            return True
        return self.rests_on_known and self.elsewhere > -self.std and self.known > tuning.DOUBTFUL_STD * self.std

    @property
    def alike(self) -> bool:
        """Whether the two cannot be told apart: the improvement is within its standard error, or too little."""
        return self.total < max(self.std, tuning.WEAK_LOG_RATIO)


class LeaveOneOut:
    """Fits without each unit in turn.

    Args:
        problem: all windows.
        left_out: how.
        pool: where the fits are made.
    """

    def __init__(self, problem: IdentificationProblem, left_out: CrossValidation, pool: Pool = IN_TURN) -> None:
        self._problem, self._left_out, self._pool = problem, left_out, pool
        self._known: dict[tuple[int, int], tuple[Fit, tuple[Vector, Vector]]] = {}

    def compare(self, without: Fit, fit: Fit) -> Confirmation:
        """What ``fit`` improves over ``without``."""
        only_in = _differ_only_in(without, fit)
        folds = self._folds(without, fit, only_in)
        (before, error_before), (after, error_after) = self._predicted(without, folds), self._predicted(fit, folds)
        windows = self._problem.windows
        told = np.isin(windows.number, only_in) if only_in else np.ones(len(windows), dtype=bool)
        by_window = ((after - before) / self._problem.tempering)[told]
        by_unit, by_block = (sums_by(number[told], by_window) for number in (folds.unit, windows.block))
        known = (self._problem.surprise(without) - self._problem.surprise(fit)) / 2.0
        left = error_after[told].sum(axis=0) / np.maximum(error_before[told].sum(axis=0), 1e-300)
        passed_once = self._left_out.has_places_once and folds is self._left_out.places
        least = tuning.DOUBTFUL_STD if only_in or passed_once else 1.0
        return Confirmation(by_unit, max(standard_error(by_unit), standard_error(by_block)), known, 1.0 - left, least)

    def _folds(self, without: Fit, fit: Fit, only_in: tuple[int, ...]) -> Folds:
        """What is left out in turn to tell two fits apart."""
        if not only_in and self._left_out.has_recordings:
            return self._left_out.recordings
        by_place = any(EFFECTS[effect].acts_by_place((name,)) for effect, name in set(without.free) ^ set(fit.free))
        return self._left_out.places if by_place else self._left_out.parts

    def _predicted(self, fit: Fit, folds: Folds) -> tuple[Vector, Vector]:
        """Log-likelihood ``(W,)`` and squared error at the end ``(W, 3)`` of each window by the fit without its fold.

        Noise and the place of a local effect stay as they were found. So do effects of single recordings where whole
        recordings are left out, which tell nothing of them.
        """
        fold, key = folds.fold, (id(fit), id(folds))
        if key not in self._known:
            near = _held(fit, self._left_out.has_recordings and folds is self._left_out.recordings)
            likelihood, error = np.empty(len(fold)), np.empty((len(fold), 3))
            out = [fold == number for number in range(int(fold.max()) + 1)]
            for these, found in zip(out, self._pool.map(partial(_without, self._problem, near), out), strict=True):
                likelihood[these], error[these] = found
            self._known[key] = fit, (likelihood, error)
        return self._known[key][1]


def _without(problem: IdentificationProblem, near: Fit, out: Mask) -> tuple[Vector, Vector]:
    """What a fit without some windows says of these."""
    rest, unseen = problem.select(~out), problem.select(out)
    start = replace(near, errors=near.errors[~out], jacobian=near.jacobian[~out])
    noise = Noise(rest.spread, near.noise.v)
    found = rest.fit(near.car, near.free, start, rough=True, noise=noise)
    errors = unseen.errors(found.car)
    return unseen.log_likelihood(errors, Noise(unseen.spread, near.noise.v)), errors[:, -3:] ** 2


def _differ_only_in(one: Fit, other: Fit) -> tuple[int, ...]:
    """The recordings outside of which two fits have the same effects; empty: they differ in all."""
    acts = [{name: fit.car.only_in.get(name, ()) for name in fit.car.effects} for fit in (one, other)]
    differ = set(acts[0].items()) ^ set(acts[1].items())
    return () if not all(where for _, where in differ) else tuple({k for _, where in differ for k in where})


def _held(fit: Fit, recordings: bool) -> Fit:
    """The fit with what shapes its effects no longer free, nor, with ``recordings``, effects of single recordings."""
    held = [
        k
        for k, (effect, name) in enumerate(fit.free)
        if EFFECTS[effect].PARAMETERS[name].shape or (recordings and effect in fit.car.only_in)
    ]
    free = tuple(pair for k, pair in enumerate(fit.free) if k not in held)
    return replace(fit, free=free, jacobian=np.delete(fit.jacobian, [len(fit.car.moved) + k for k in held], axis=2))


def standard_error(parts: Vector) -> float:
    """Standard error of the sum of independent parts."""
    return float(np.sqrt(len(parts)) * np.std(parts, ddof=1)) if len(parts) > 1 else float("inf")
