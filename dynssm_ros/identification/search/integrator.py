"""Which steps the simulation makes: the file's, else Runge-Kutta with inputs that are held, unless the data say otherwise.

Euler steps of the sampling time, as some simulators make them, act about half a step late. Inputs that went on changing
between their samples act half a sample early, as a line from sample to sample does. Steering that lags hides that, and so
does another yaw inertia, so the steps are compared with both fitted beside. Before the causes are known a car that errs may
be closer to the data with either by chance, so that the choice is made anew with the causes that were found.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from copy import copy
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from dynssm_ros.identification.problem.car import CarEstimate
from dynssm_ros.identification.problem.fit import Fit, IdentificationProblem, closest
from dynssm_ros.identification.problem.levels import ONE_RECORDING, Levels
from dynssm_ros.identification.problem.recordings import CrossValidation
from dynssm_ros.identification.problem.windows import SimulationWindows
from dynssm_ros.identification.search.candidates import candidates
from dynssm_ros.identification.search.selection import Search, Selection
from dynssm_ros.parallel import IN_TURN, Pool
from dynssm_ros.progress import OnProgress
from dynssm_ros.signals.signal_map import Hold
from dynssm_ros.vehicle.effects.actuators import SteeringLag
from dynssm_ros.vehicle.effects.inertia import YawInertia
from dynssm_ros.vehicle.integrators import Integrator

_OPTIONS: tuple[tuple[Integrator, Hold], ...] = (("rk4", "zero"), ("rk4", "first"), ("euler", "zero"))


class SearchResult(NamedTuple):
    """What a search found, with what it was made of.

    Attributes:
        problem: of the windows in the steps that were taken.
        search: all fits.
        selection: the causes.
        impossible: effects that cannot be tried, and why.
    """

    problem: IdentificationProblem
    search: Search
    selection: Selection
    impossible: dict[str, str]


def search_causes(
    windows: SimulationWindows,
    car: CarEstimate,
    left_out: CrossValidation,
    *,
    integrator: Integrator | None = None,
    on_progress: OnProgress = lambda words: None,
    exclude: Collection[str] = (),
    levels: Levels = ONE_RECORDING,
    pool: Pool = IN_TURN,
) -> SearchResult:
    """Searches for causes.

    Args:
        windows: for the fit.
        car: as the vehicle file has it.
        left_out: how windows are left out: recordings in turn, and parts of each.
        integrator: of the simulation; ``None``: chosen by the data.
        on_progress: told what is being done.
        exclude: effects that are not tried.
        levels: which recordings may have an effect that the others do not have.
        pool: where candidates are tried.
    """
    # noise is carried along as by the car that was known, so that a calibration on the same laps changes nothing
    known = car.as_known

    def search(stepped: tuple[IdentificationProblem, Fit], start: Fit | None = None) -> SearchResult:
        problem, base = stepped
        found, impossible = candidates(problem, known, exclude, levels)
        searching = Search(problem, car, found, left_out, on_progress=on_progress, pool=pool, base=base)
        return SearchResult(problem, searching, searching.run(start), impossible)

    on_progress("choosing how the model steps")
    options = [one for one in _OPTIONS if integrator in (None, one[0])]
    options.sort(key=lambda one: car.vehicle.integrator not in (None, one[0]))  # those of the file first
    stepped = {one: _stepped(replace(windows, hold=one[1]), car, one[0]) for one in options}
    first = _closest(stepped)
    found = search((copy(stepped[first][0]), stepped[first][1]))
    fit = found.selection.fit
    if first == options[0] and not found.selection.chosen:
        return found  # nothing has come beside it, and errors that hang together tell less, not more

    def refitted(one: tuple[Integrator, Hold]) -> tuple[IdentificationProblem, Fit]:
        if one == first:
            return found.problem, fit
        problem = IdentificationProblem(stepped[one][0].windows, known, found.problem.tempering)
        return problem, problem.fit(fit.car, fit.free)

    last = _closest({one: refitted(one) for one in options})
    return found if last == first else search(stepped[last], fit)


def _stepped(windows: SimulationWindows, car: CarEstimate, integrator: Integrator) -> tuple[IdentificationProblem, Fit]:
    """The windows in steps that are short enough for the recalibrated car too, and that car's fit to them.

    That car may be much stiffer than the one of the file, and a simulation whose steps are too long for it runs away.
    """
    trial = windows.with_integrator(integrator, car.vehicle)
    problem = IdentificationProblem(trial, car.as_known)
    fit = problem.recalibrated(car)
    finer = trial.with_integrator(integrator, car.vehicle.with_nominal(np.array(fit.car.theta)))
    if finer.substeps > trial.substeps:
        problem = IdentificationProblem(finer, car.as_known)
        fit = problem.fit(fit.car, ())
    return problem, fit


def _closest(fits: Mapping[tuple[Integrator, Hold], tuple[IdentificationProblem, Fit]]) -> tuple[Integrator, Hold]:
    """The steps in which the car, with what hides them, is closest to the data; those alone if there are no others."""
    if len(fits) == 1:
        return next(iter(fits))
    return closest({one: _with_what_hides(problem, fit) for one, (problem, fit) in fits.items()})


def _with_what_hides(problem: IdentificationProblem, fit: Fit) -> Fit:
    """The same with steering that lags and a yaw inertia of its own, as far as it has not got them already."""
    hides = (SteeringLag.NAME, "time_constant", problem.windows.data.T_s), (YawInertia.NAME, "factor", 1.0)
    car, free = fit.car, fit.free
    for effect, parameter, value in hides:
        if effect not in car.effects and all(entry.name != effect for entry in car.vehicle.effects):
            car, free = car.with_effect(effect, {parameter: value}), (*free, (effect, parameter))
    return fit if free == fit.free else min(fit, problem.fit(car, free, fit), key=lambda one: one.objective)
