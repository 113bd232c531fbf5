"""The gate: what is worse where nobody looked is not kept, nor what can only stand for something else."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.identification import tuning
from dynssm_ros.identification.problem.car import CarEstimate
from dynssm_ros.identification.problem.fit import Fit, IdentificationProblem
from dynssm_ros.identification.problem.noise import weights
from dynssm_ros.identification.problem.windows import SimulationWindows
from dynssm_ros.identification.result.diagnosis import EXTENDED, GIVEN, RECALIBRATED
from dynssm_ros.identification.result.improvement import Improvement, mean_reduction, measure_improvement
from dynssm_ros.identification.result.residuals import Left, clustered, explained_variance, lasting
from dynssm_ros.identification.search.integrator import SearchResult
from dynssm_ros.identification.search.selection import Refined, Search, Selection


class Without(NamedTuple):
    """The car with all causes but one."""

    errors: Vector
    """On the held-out rows at the horizon, ``(W, 3)`` (m/s, m/s, rad/s)."""
    improvement: float
    """Share of them that the cause takes away, as a mean of the channels."""
    of_given: float
    """The same while the coefficients are those of the file."""


class Gated(NamedTuple):
    """What passes the gate.

    Attributes:
        selection: the causes.
        without: the car without each of them, in the same order.
        nearest: whether each of them stands for something that no effect has, in the same order.
        named: the car with the others alone.
        left: what that car leaves on the rows of the fit.
        improvement: on the held-out rows, of the car with all of them.
    """

    selection: Selection
    without: tuple[Without, ...]
    nearest: tuple[bool, ...]
    named: CarEstimate
    left: Left
    improvement: Improvement


def gated(found: SearchResult, given: CarEstimate, windows: SimulationWindows, steps: int, notes: list[str]) -> Gated:
    """A selection of which no cause is worse on held-out rows beside the others, nor all together.

    Args:
        found: what a search has selected; it goes on without what is not kept.
        given: the car as the vehicle file has it.
        windows: simulations on held-out rows.
        steps: of the horizon that the diagnosis is about.
        notes: told what is not kept.
    """
    selection = found.selection
    while True:
        without = _without_each(selection, found.search, given, windows, steps)
        left = _left(found.problem, selection.fit)
        strange = [one.candidate.effect for one in selection.chosen if not one.is_met]
        worst = min(zip(without, selection.candidates, strict=True), key=lambda pair: pair[0].improvement, default=None)
        if worst is not None and worst[0].improvement <= -tuning.NEGLIGIBLE_SHARE:
            rejected = worst[1].effect
            notes.append(_not_kept(rejected))
        elif strange and left.is_there:
            rejected = strange[0]
            notes.append(
                f"{rejected} would be on the side of neutral on which no car has it, and leaves errors that come together: "
                "it stands for something else, so that nothing of it is kept"
            )
        else:
            break
        selection = found.search.reject(rejected)
    cars = {GIVEN: given, RECALIBRATED: selection.base.car, EXTENDED: selection.fit.car}
    improvement = measure_improvement(windows, cars, steps)
    if selection.chosen and _worse(improvement):
        notes.append(_not_kept(", ".join(one.effect for one in selection.candidates)))
        none = found.search.eliminated(())
        left = _left(found.problem, none.fit)
        return Gated(none, (), (), none.fit.car, left, improvement.ending_with(RECALIBRATED))
    return _beside_nearest(found.problem, Gated(selection, without, (), selection.fit.car, left, improvement))


def _beside_nearest(problem: IdentificationProblem, gate: Gated) -> Gated:
    """Tells apart what is a cause and what is the effect nearest to something else.

    A cause takes what it explains away. A nearest effect leaves a part of it, which lasts from a simulation to the next.
    """
    selection, fit = gate.selection, gate.selection.fit
    lasts = (
        lasting(problem.windows, _ends(problem, fit))
        if selection.inflation > tuning.EXPLAINED_INFLATION
        else np.zeros(3)
    )
    nearest = tuple(stands_for_else(one, lasts) for one in selection.chosen)
    if not any(nearest):
        return gate._replace(nearest=nearest)
    out = [one.candidate.effect for one, else_ in zip(selection.chosen, nearest, strict=True) if else_]
    car = fit.car
    for effect in out:
        car = car.without(effect)
    named = problem.fit(car, tuple(pair for pair in fit.free if pair[0] not in out), fit)
    return gate._replace(nearest=nearest, named=named.car, left=_left(problem, named))


def stands_for_else(one: Refined, lasts: Vector) -> bool:
    """Whether too much of what a cause explains is left, in the channels in which it explains most.

    What is named because coefficients are known explains nothing that could be left.
    """
    assert one.confirmation is not None
    explains = np.maximum(one.confirmation.share, 0.0)
    if explains.max() <= tuning.SMALL_SHARE:
        return False
    most = explains >= explains.max() / 2
    left = lasts * (1.0 - explains)
    return bool(left[most].sum() > tuning.NEAREST_SHARE * explains[most].sum())


def _without_each(
    selection: Selection, search: Search, given: CarEstimate, windows: SimulationWindows, steps: int
) -> tuple[Without, ...]:
    def errors(car: CarEstimate) -> Vector:
        return windows.errors(car)[:, steps - 1]

    def one(cause: Refined) -> Without:
        refitted = errors(search.leave_out(selection, cause).car)
        set_back = errors(of_file.without(cause.candidate.effect))
        return Without(refitted, mean_reduction(refitted, with_all), mean_reduction(set_back, as_file))

    of_file = replace(selection.fit.car, moved=given.moved)
    with_all, as_file = errors(selection.fit.car), errors(of_file)
    return tuple(map(one, selection.chosen))


def _ends(problem: IdentificationProblem, fit: Fit) -> Vector:
    """Errors at the end of the simulations of a fit, ``(W, 3)``."""
    return np.asarray(fit.errors.reshape(len(problem.windows), -1, 3)[:, -1])


def _left(problem: IdentificationProblem, fit: Fit) -> Left:
    windows = problem.windows
    white = fit.noise.whiten(fit.errors)
    size = weights(white) * (white**2).mean(axis=1)
    size = size / (np.bincount(windows.number, size) / np.bincount(windows.number))[windows.number]
    together = clustered(size, windows.time, windows.block, problem.inflation(fit))
    return Left(explained_variance(windows, _ends(problem, fit), windows.block), together)


def _not_kept(effects: str) -> str:
    return f"{effects} explained the fitted laps but not the held-out ones, so that nothing of it is kept"


def _worse(improvement: Improvement) -> bool:
    """Whether the extended car errs more than the recalibrated one, in the geometric mean of the channels.

    Causes that a recalibration would make up for, such as more mass for less drive, change nothing but noise.
    """
    ratio = 1.0 - improvement.reduction_from(RECALIBRATED)[improvement.horizon]
    return bool(np.log(np.maximum(ratio, 1e-300)).mean() > tuning.NEGLIGIBLE_SHARE)
