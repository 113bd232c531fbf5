"""What of a vehicle file is off: the fewest coefficients that explain what recalibration takes off the error.

A fit moves all coefficients, those that matter and those that the data hardly tell from them. Here they begin at the file's
values, and one after the other is let go, the one first that explains most, while the evidence for it is very strong (forward
selection on the quadratic that the fit has of its objective). What each takes away is measured on held-out laps, where it
alone is set back to the file's value.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from itertools import product

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.identification import tuning
from dynssm_ros.identification.problem.car import CarEstimate
from dynssm_ros.identification.problem.fit import Fit, IdentificationProblem, limits, unit, with_values
from dynssm_ros.identification.problem.windows import SimulationWindows
from dynssm_ros.identification.result.improvement import (
    Improvement,
    channel_reduction,
    is_noticed,
    mean_reduction,
    reduction_interval,
)
from dynssm_ros.identification.search.candidates import Candidate, Responses
from dynssm_ros.vehicle import COEFFICIENTS
from dynssm_ros.vehicle.effects import EFFECTS

MOVABLE = (*COEFFICIENTS, "m")
"""What is recalibrated, by name."""


@dataclass(frozen=True)
class CoefficientShift:
    """A coefficient, or ``m``, that is off in the vehicle file, while those that are not listed beside it hold.

    Attributes:
        name: of the coefficient.
        given: its value in the vehicle file.
        value: what the data say; ``std`` its standard deviation.
        deviations: how far it is off, in standard deviations of the vehicle file.
        share: of the RMSE on held-out laps that is gone by it, by channel, ``(3,)``.
        explains: the same as a mean of the channels.
        alike: coefficients that would explain the errors as well in its place.
    """

    name: str
    given: float
    value: float
    std: float
    deviations: float
    share: Vector
    explains: float
    alike: tuple[str, ...]


@dataclass(frozen=True)
class HiddenCandidate:
    """An effect that would explain what the coefficients explain, if these held: only what is known of them tells it.

    Attributes:
        effect: its name; ``values`` the parameters that it would have.
        share: of what the recalibration improves, that it improves in its place.
    """

    effect: str
    values: dict[str, float]
    share: float


@dataclass(frozen=True)
class Recalibration:
    """What recalibration takes off the error on held-out laps, beside the causes.

    Attributes:
        share: of the RMSE that is gone, by channel, ``(3,)``, with its 95 % interval, ``(2, 3)``.
        explains: the same as a mean of the channels.
        coefficients: the fewest that explain it, the one that takes most away first.
        candidates: effects that recalibration may hide.
    """

    share: Vector
    interval: Vector
    explains: float
    coefficients: tuple[CoefficientShift, ...]
    candidates: tuple[HiddenCandidate, ...]


def recalibration(
    problem: IdentificationProblem, fit: Fit, given: CarEstimate, improvement: Improvement, *, small: Iterable[str] = ()
) -> Recalibration | None:
    """What of the vehicle file is off.

    It is off where a channel errs noticeably less by recalibration. It is too where the evidence is very strong that a
    coefficient is more than two of its standard deviations off, however little that changes. Else there is ``None``.

    Args:
        problem: of the fit.
        fit: of the car with its causes.
        given: the car as the vehicle file has it.
        improvement: on held-out laps; the last car is that of the fit.
        small: effects of the fit that are no causes: what coefficients only make up for them is not off in the file.
    """
    windows, at = improvement.windows, improvement.horizon
    after = improvement.errors[list(improvement.errors)[-1]][:, at]

    def gained(car: CarEstimate) -> tuple[Vector, Vector, float]:
        before = _errors(windows, car, improvement)
        interval = reduction_interval(before, after, windows.block)
        return channel_reduction(before, after), interval, mean_reduction(before, after)

    of_file = replace(fit.car, moved=given.moved)
    share, interval, explains = gained(of_file)
    noticed = is_noticed(share, interval, explains) and is_noticed(*gained(reduce(CarEstimate.without, small, of_file)))
    selection = _ForwardSelection(problem, fit, given)
    chosen = selection.fewest()
    if not noticed and not selection.is_sure(chosen):
        return None
    at_once = selection.refined(chosen)
    car = with_values(fit.car, fit.free, at_once)
    if not noticed and float(np.abs(car.moved - given.moved).max()) < tuning.DOUBTFUL_STD:
        return None
    with_all = _errors(windows, car, improvement)
    found = []
    for k in chosen:
        back = car.moved.copy()
        back[k] = given.moved[k]
        without = _errors(windows, replace(car, moved=back), improvement)
        value, std = selection.value_and_std(k, at_once, chosen)
        found.append(
            CoefficientShift(
                MOVABLE[k],
                _values(given)[k],
                value,
                std,
                float(car.moved[k] - given.moved[k]),
                channel_reduction(without, with_all),
                mean_reduction(without, with_all),
                tuple(MOVABLE[j] for j in selection.alike(chosen, k)),
            )
        )
    found.sort(key=lambda one: -one.explains)
    return Recalibration(share, interval, explains, tuple(found), ())


def hidden_candidates(
    problem: IdentificationProblem, fit: Fit, given: CarEstimate, found: Sequence[Candidate], responses: Responses
) -> tuple[HiddenCandidate, ...]:
    """Effects that explain nearly all that recalibration explains, alone and with the coefficients of the file.

    Args:
        problem: of the fit.
        fit: of the car with its causes.
        given: the car as the vehicle file has it.
        found: what can be tried; the first candidate of an effect speaks for it.
        responses: of the library.
    """
    white, _, root = fit.noise.robust(problem.errors(replace(fit.car, moved=given.moved)), fit.white_jacobian)
    gone = float((white**2).sum() - ((fit.noise.whiten(fit.errors) * root) ** 2).sum())
    if gone <= 0.0:
        return ()
    first = {one.effect: one for one in reversed(found) if not one.only_in and one.effect not in fit.car.effects}
    out = []
    for candidate in first.values():
        best: HiddenCandidate | None = None
        for shape, columns in _columns(candidate, responses):
            C = np.stack([(fit.noise.whiten(c) * root).ravel() for c in columns], axis=1)
            amounts = np.linalg.lstsq(C, -white.ravel(), rcond=None)[0]
            share = float(-amounts @ (C.T @ white.ravel())) / gone
            values = dict(shape)
            inside = share > tuning.NEAR_BEST_SHARE and (best is None or share > best.share)
            for name, amount in zip(candidate.amplitudes, amounts, strict=True):
                about = candidate.about[name]
                values[name] = about.neutral + float(amount) * unit(candidate.effect, name)
                inside = inside and about.lower < values[name] < about.upper
            if inside:
                best = HiddenCandidate(candidate.effect, values, share)
        if best is not None and EFFECTS[best.effect].amount(best.values) > 0.0:
            out.append(best)
    return tuple(sorted(out, key=lambda one: -one.share))


def _columns(candidate: Candidate, responses: Responses) -> Iterator[tuple[dict[str, float], list[Vector]]]:
    """The shapes of a candidate, each with what a unit of its amplitudes does to the errors."""
    for values in product(*(candidate.about[p].tried for p in candidate.shapes)):
        shape = dict(candidate.held) | dict(zip(candidate.shapes, values, strict=True))
        known = [responses.of(candidate, p, shape) for p in candidate.amplitudes]
        for k in range(max(len(each) for each, _ in known)):
            yield (
                shape,
                [each[min(k, len(each) - 1)].errors * (1.0 if acts is None else acts[:, None]) for each, acts in known],
            )


def _errors(windows: SimulationWindows, car: CarEstimate, improvement: Improvement) -> Vector:
    """Errors ``(W, 3)`` at the horizon."""
    step = round(float(improvement.horizons[improvement.horizon]) / windows.data.T_s)
    return windows.errors(car)[:, step - 1]


def _values(car: CarEstimate) -> list[float]:
    return [*car.theta, car.constants.m]


class _ForwardSelection:
    """Which of the coefficients have to leave the file's values.

    Args:
        problem: of the fit.
        fit: with all of them free, from whose minimum the quadratic is taken.
        given: the car with those of the file.
    """

    def __init__(self, problem: IdentificationProblem, fit: Fit, given: CarEstimate) -> None:
        self._problem, self._fit = problem, fit
        self._H, _ = problem.normal(fit.errors, fit.white_jacobian, fit.position, fit.noise)
        self._held = np.append(given.moved, fit.position[len(MOVABLE) :])
        self._always = list(range(len(MOVABLE), len(self._H)))  # of the causes
        self._price = np.log(problem.windows.target.size) + tuning.DECISIVE_DELTA_BIC

    def fewest(self) -> list[int]:
        """The coefficients that matter, at least one: forward, then without those that others have made superfluous."""
        chosen: list[int] = []
        lost = self._lost(chosen)
        while len(chosen) < len(MOVABLE):
            others = {k: self._lost([*chosen, k]) for k in range(len(MOVABLE)) if k not in chosen}
            best = min(others, key=others.__getitem__)
            if chosen and lost - others[best] < self._price:
                break
            chosen.append(best)
            lost = others[best]
            for k in chosen[:-1]:
                rest = [j for j in chosen if j != k]
                if self._lost(rest) - lost < self._price:
                    chosen, lost = rest, self._lost(rest)
        return chosen

    def is_sure(self, chosen: list[int]) -> bool:
        """Whether the evidence for ``chosen`` is very strong."""
        return bool(self._lost([]) - self._lost(chosen) > self._price)

    def alike(self, chosen: list[int], one: int) -> list[int]:
        """Those that would explain as much in the place of ``one``."""
        rest, limit = [k for k in chosen if k != one], self._lost(chosen) + tuning.AMBIGUITY_DELTA_BIC
        return [k for k in range(len(MOVABLE)) if k not in chosen and self._lost([*rest, k]) < limit]

    def refined(self, chosen: list[int]) -> Vector:
        """The values ``(P,)`` where only ``chosen``, and the causes, leave those of the file, by simulation."""
        free = [*chosen, *self._always]
        p = self._optimum(free)
        lower, upper = limits(self._fit.car, self._fit.free)
        p = np.clip(p, lower, upper)
        errors = self._problem.errors(self._car(p))
        best = self._problem.objective(errors, p, self._fit.noise)
        for _ in range(tuning.MAX_TRIES):  # with the derivatives of the fit
            H, g = self._problem.normal(errors, self._fit.white_jacobian, p, self._fit.noise)
            tried = p.copy()
            tried[free] -= np.linalg.solve(H[np.ix_(free, free)], g[free])
            tried = np.clip(tried, lower, upper)
            there = self._problem.errors(self._car(tried))
            value = self._problem.objective(there, tried, self._fit.noise)
            if not value < best:
                break
            done, p, errors, best = best - value < tuning.CONVERGED, tried, there, value
            if done:
                break
        return p

    def value_and_std(self, one: int, p: Vector, chosen: list[int]) -> tuple[float, float]:
        """A coefficient at ``p``, and its standard deviation while those that were not chosen hold."""
        free = [*chosen, *self._always]
        spread = np.sqrt(np.diag(np.linalg.inv(self._H[np.ix_(free, free)])))[free.index(one)]
        moved = p.copy()
        moved[one] += spread
        here, there = (_values(self._car(each))[one] for each in (p, moved))
        return here, abs(there - here)

    def _car(self, p: Vector) -> CarEstimate:
        return with_values(self._fit.car, self._fit.free, p)

    def _off(self, free: list[int]) -> tuple[list[int], Vector]:
        """What is held, and how far from the minimum."""
        held = [k for k in range(len(self._H)) if k not in free]
        return held, (self._held - self._fit.position)[held]

    def _lost(self, chosen: list[int]) -> float:
        """How much more the objective is than at its minimum, at best, where only ``chosen`` and the causes move."""
        free = [*chosen, *self._always]
        held, off = self._off(free)
        inner, cross = self._H[np.ix_(free, free)], self._H[np.ix_(free, held)]
        rest = self._H[np.ix_(held, held)] - cross.T @ np.linalg.solve(inner, cross)
        return float(off @ rest @ off)

    def _optimum(self, free: list[int]) -> Vector:
        held, off = self._off(free)
        p = self._held.copy()
        follow = np.linalg.solve(self._H[np.ix_(free, free)], self._H[np.ix_(free, held)] @ off)
        p[free] = self._fit.position[free] - follow
        return p
