"""The gate: what is worse where nobody looked is not kept, nor what can only stand for something else."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.identification.car import CarEstimate
from dynssm_ros.identification.diagnosis import EXTENDED, GIVEN, RECALIBRATED
from dynssm_ros.identification.improvement import Improvement, measure_improvement
from dynssm_ros.identification.integrator import SearchResult
from dynssm_ros.identification.noise import weights
from dynssm_ros.identification.problem import IdentificationProblem
from dynssm_ros.identification.residuals import ClusteredResiduals, ExplainedVariance, clustered, explained_variance
from dynssm_ros.identification.selection import Refined, Search, Selection
from dynssm_ros.identification.windows import SimulationWindows

_NO_WORSE = 0.01  # of the error on held-out laps, that the car may be worse with a cause than without


class HeldOut(NamedTuple):
    """The simulations that only measure.

    Attributes:
        windows: on held-out rows.
        steps: of the horizon that the diagnosis is about.
    """

    windows: SimulationWindows
    steps: int


def gated(found: SearchResult, given: CarEstimate, at: HeldOut, notes: list[str]) -> tuple[Selection, Improvement]:
    """A selection of which no cause is worse on held-out rows beside the others, nor all together; and what it gains.

    Args:
        found: what a search has selected; it goes on without what is not kept.
        given: the car as the vehicle file has it.
        at: the held-out simulations.
        notes: told what is not kept.
    """
    selection = found.selection
    while selection.chosen:
        gains = [held_out_gain(*held_out_errors(one, selection, found.search, at)) for one in selection.chosen]
        worst = selection.candidates[int(np.argmin(gains))].effect
        strange = [one.candidate.effect for one in selection.chosen if not one.is_met]
        if min(gains) <= -_NO_WORSE:
            notes.append(_not_kept(worst))
            selection = found.search.reject(worst)
        elif strange and any(rest.is_there for rest in left_behind(found.problem, selection)):
            notes.append(
                f"{strange[0]} would be on the side of neutral on which no car has it, and leaves errors that come together: "
                "it stands for something else, so that nothing of it is kept"
            )
            selection = found.search.reject(strange[0])
        else:
            break
    cars = {GIVEN: given, RECALIBRATED: selection.base.car, EXTENDED: selection.fit.car}
    improvement = measure_improvement(at.windows, cars, at.steps)
    if selection.chosen and _worse(improvement):
        notes.append(_not_kept(", ".join(one.effect for one in selection.candidates)))
        return found.search.dropped(()), improvement.ending_with(RECALIBRATED)
    return selection, improvement


def left_behind(problem: IdentificationProblem, selection: Selection) -> tuple[ExplainedVariance, ClusteredResiduals]:
    """What the selected car leaves: what is systematic, and what comes together in time."""
    windows, fit = problem.windows, selection.fit
    white = fit.noise.whiten(fit.errors)
    size = weights(white) * (white**2).mean(axis=1)
    size = size / (np.bincount(windows.number, size) / np.bincount(windows.number))[windows.number]
    ends = fit.errors.reshape(len(windows), -1, 3)[:, -1]
    together = clustered(size, windows.time, problem.block, selection.inflation)
    return explained_variance(windows, ends, problem.block), together


def _not_kept(effects: str) -> str:
    return f"{effects} explained the fitted laps but not the held-out ones, so that nothing of it is kept"


def held_out_errors(one: Refined, selection: Selection, search: Search, at: HeldOut) -> tuple[Vector, Vector]:
    """Errors at the horizon without one of the causes and with all, each ``(W, 3)``."""
    without, with_it = (
        at.windows.errors(car)[:, at.steps - 1] for car in (search.leave_out(selection, one).car, selection.fit.car)
    )
    return without, with_it


def held_out_gain(without: Vector, with_it: Vector) -> float:
    """Share of the error that is gone, as a mean of the channels."""
    left = (with_it**2).mean(axis=0) / np.maximum((without**2).mean(axis=0), 1e-300)
    return float(1.0 - np.sqrt(left.mean()))


def _worse(improvement: Improvement) -> bool:
    """Whether the extended car errs more than the recalibrated one, in the geometric mean of the channels.

    Causes that a recalibration would make up for, such as more mass for less drive, change nothing but noise.
    """
    ratio = 1.0 - improvement.reduction_from(RECALIBRATED)[improvement.horizon]
    return bool(np.log(np.maximum(ratio, 1e-300)).mean() > _NO_WORSE)
