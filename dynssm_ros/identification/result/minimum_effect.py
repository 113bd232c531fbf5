"""How small an effect would still be named: what the driving, the noise and badly known nominal values leave of it.

It has to be sure, and it has to matter: an effect that takes little off the errors is listed as small and not named, unless
what was known of the nominal values tells most of it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import groupby

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.identification import tuning
from dynssm_ros.identification.problem.car import Values
from dynssm_ros.identification.problem.fit import Fit, IdentificationProblem, limits, unit, with_values
from dynssm_ros.identification.problem.noise import weights
from dynssm_ros.identification.search.candidates import Candidate
from dynssm_ros.vehicle.effects import LOCATION


def minimum_detectable(problem: IdentificationProblem, fit: Fit, found: Iterable[Candidate]) -> dict[str, float]:
    """The least change of each effect's first parameter, beside a fit, that the data would call a cause.

    An effect on a stretch of the lap is taken at several places, and the middle of their answers given.

    Args:
        problem: the windows.
        fit: of the car with all causes.
        found: what can be tried; the first candidate of an effect speaks for it, those of the fit are left out.

    Returns:
        By effect, in the unit of the parameter; infinite where it changes nothing that was measured.
    """
    taken = {effect for effect, _ in fit.free}
    sizes: dict[str, list[_Size]] = {}
    for candidate in found:
        if candidate.effect not in taken and candidate.effect not in sizes:
            places = [{LOCATION[0]: at} for at in tuning.DETECTION_PLACES] if candidate.local else [{}]
            sizes[candidate.effect] = [_Size(candidate, at, len(fit.position)) for at in places]
    nearby = _Nearby(problem, fit)
    for _ in range(tuning.DETECTION_ROUNDS):
        left = [one for each in sizes.values() for one in each if not one.settled]
        for one, worth in zip(left, nearby.worth(left), strict=True):
            one.change(float(worth))
    seen = {effect: float(np.median([one.size for one in each])) for effect, each in sizes.items()}
    steered = problem.windows.steered
    return {
        effect: max(size, nearby.surely_more(size, fit.car.least(effect, steered))) for effect, size in seen.items()
    }


class _Size:
    """How far off neutral an effect has to be, looked for from little on.

    Args:
        candidate: the effect; its shape is neutral.
        at: parameters of the place.
        fitted: how many values were fitted.
    """

    def __init__(self, candidate: Candidate, at: Values, fitted: int) -> None:
        self.effect, self._parameter, about = candidate.effect, candidate.amplitudes[0], candidate.about
        self._about = about[self._parameter]
        self._form = {name: about[name].neutral for name in candidate.shapes} | dict(candidate.held) | at
        bound = self._about.upper if self._about.direction > 0 else self._about.lower
        self._most = abs(bound - self._about.neutral)
        self.size = min(tuning.FIRST_SIZE * unit(self.effect, self._parameter), self._most)
        self.follows: Vector = np.zeros(fitted)
        """What the fitted values do for each unit of it."""
        self.settled = False
        self._less, self._enough = 0.0, np.inf

    @property
    def values(self) -> Values:
        """Its parameters."""
        return self._form | {self._parameter: self._about.neutral + self._about.direction * self.size}

    def change(self, worth: float) -> None:
        """Takes what an effect of :attr:`values` is worth: it is to be 1, and grows like the size squared, or faster."""
        worth = worth if np.isfinite(worth) else np.inf  # the simulation runs away
        if worth < 1.0:
            self._less = self.size
        else:
            self._enough = self.size
        change, tolerance = worth**-0.5 if worth > 1e-9 else np.inf, tuning.DETECTION_TOLERANCE
        close, beyond = 1 / tolerance < change < tolerance, worth < 1.0 and self.size >= self._most
        self.settled = bool(close or beyond or self._enough < tolerance * self._less)
        if close or beyond:
            self.size *= change
        elif self._less > 0.0 and np.isfinite(self._enough):
            self.size = float(np.sqrt(self._less * self._enough))
        else:
            limited = float(np.clip(change, 1 / tuning.SIZE_CHANGE, tuning.SIZE_CHANGE))
            self.size = min(self.size * limited, self._most)


class _Nearby:
    """Cars that are like that of a fit but for an effect, as the data see them."""

    def __init__(self, problem: IdentificationProblem, fit: Fit) -> None:
        some, near = problem.part(fit, -(-len(problem.windows) // tuning.DETECTION_WINDOWS))
        self._problem, self._fit = some, near
        counts = len(problem.windows) / (len(some.windows) * problem.counted_once(fit))
        self._root = np.sqrt(weights(near.noise.whiten(near.errors)) * counts)[:, None]
        self._J = (near.noise.whiten(near.jacobian) * self._root[..., None]).reshape(-1, near.jacobian.shape[2])
        self._prior = problem.prior_precision(fit.position)
        self._H = self._J.T @ self._J + self._prior
        self._error = np.maximum((near.errors[:, -3:] ** 2).sum(axis=0), 1e-300)
        self._limits = limits(near.car, near.free)
        self._needed = np.log(problem.windows.target.size) + tuning.DECISIVE_DELTA_BIC

    def worth(self, sizes: Sequence[_Size]) -> Vector:
        """How far each exceeds what makes it a cause, once all fitted values have followed it as far as they can, ``(n,)``.

        It is the lesser of two ratios: twice the logarithm of the likelihood that it is worth, over what is needed; and its
        share of the squared error of a channel at the end of the simulations, over what matters, where the first does not
        rest on what was known beforehand.
        """
        if not sizes:
            return np.empty(0)
        fit, car = self._fit, self._fit.car
        present = np.concatenate(
            [
                self._problem.errors_of([car.with_effect(name, {**car.effects.get(name, {}), **each.values}) for each in own])
                for name, own in groupby(sizes, lambda size: size.effect)
            ]
        )  # fmt: skip
        followed = np.zeros((len(sizes), len(self._H)))
        rest = present - fit.errors
        told = self._told(rest, followed)
        for k in range(1 + tuning.FOLLOW_ROUNDS):
            if k:  # as if errors were linear in the fitted values
                pull = self._seen(rest).reshape(len(rest), -1) @ self._J - followed @ self._prior
                move = np.asarray(np.linalg.solve(self._H, pull.T).T)
            else:  # as for the size before
                move = np.stack([one.size * one.follows for one in sizes])
            for share in tuning.FOLLOW_SHARES if k else (1.0,):
                tried = np.clip(fit.position + followed + share * move, *self._limits) - fit.position
                moved = [with_values(car, fit.free, fit.position + each) for each in tried]
                other = present - self._problem.errors_of(moved)
                less = self._told(other, tried)
                better = less < told
                rest[better], followed[better], told[better] = other[better], tried[better], less[better]
        for one, each in zip(sizes, followed, strict=True):
            one.follows = each / one.size
        seen = told - self._surprise(followed)
        # of the squared error of what is left
        share = np.max((rest[..., -3:] ** 2).sum(axis=1) / self._error, axis=1)
        matters = share / (tuning.SMALL_SHARE / (1 - tuning.SMALL_SHARE))
        return np.asarray(np.minimum(told / self._needed, np.where(2 * seen < told, np.inf, matters)))

    def surely_more(self, size: float, least: float) -> float:
        """What is surely more than ``least``, which any car has; nothing if that is nothing.

        An effect of ``size`` is worth what makes it a cause, so that this many standard deviations are known.
        """
        return least + tuning.BEYOND_STD * size / float(np.sqrt(self._needed)) if least else 0.0

    def _told(self, rest: Vector, followed: Vector) -> Vector:
        """Twice the logarithm of the likelihood of what is left and of how far the fitted values moved, ``(n,)``."""
        return np.asarray(self._surprise(followed) + np.sum(self._seen(rest) ** 2, axis=(1, 2)))

    def _surprise(self, followed: Vector) -> Vector:
        """How far the fitted values moved: squared, in standard deviations of what was known, ``(n,)``."""
        return np.asarray(np.einsum("np,pq,nq->n", followed, self._prior, followed))

    def _seen(self, change: Vector) -> Vector:
        """Changes ``(n, W, 3 K)`` of the errors in units of the noise, as far as they count; outliers count less."""
        white = [self._fit.noise.whiten(one) for one in change]
        return np.stack([self._root * np.sqrt(weights(one))[:, None] * one for one in white])
