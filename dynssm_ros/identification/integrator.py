"""Which steps the simulation makes: Runge-Kutta, unless the data were clearly made by Euler steps of the sampling time.

Euler steps act about half a step late. Before the causes are known a car that errs may be closer to the data with them by
chance, so that the choice is made anew with the causes that were found.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from dynssm_ros.identification.candidates import candidates
from dynssm_ros.identification.car import CarEstimate
from dynssm_ros.identification.problem import Fit, IdentificationProblem
from dynssm_ros.identification.recordings import LeftOut
from dynssm_ros.identification.selection import Search, Selection
from dynssm_ros.identification.windows import SimulationWindows
from dynssm_ros.vehicle.single_track import Integrator

_TRIED = 300  # windows with which the integrator is chosen at first
_CLEARLY = 20.0  # difference of twice the log-likelihood for which another integrator is taken than Runge-Kutta


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
    left_out: tuple[LeftOut, LeftOut],
    integrator: Integrator | None,
    on_progress: Callable[[str], None],
    exclude: Collection[str] = (),
    groups: Sequence[tuple[int, ...]] = (),
) -> SearchResult:
    """Searches for causes.

    Args:
        windows: for the fit.
        car: as the vehicle file has it.
        left_out: how windows are left out: recordings in turn, and parts of each.
        integrator: of the simulation; ``None``: chosen by the data.
        on_progress: told what is being done.
        exclude: effects that are not tried.
        groups: of recordings, in each of which an effect may act that the others do not have.
    """

    def search(windows: SimulationWindows, start: Fit | None = None) -> SearchResult:
        problem = IdentificationProblem(windows, car)
        found, impossible = candidates(problem, car, exclude, groups)
        searching = Search(problem, car, found, left_out, on_progress)
        return SearchResult(problem, searching, searching.run(start), impossible)

    if integrator is not None:
        return search(_stepped(windows, car, integrator)[0])
    on_progress("choosing how the model steps")
    runge_kutta, euler = _stepped(windows, car, "rk4"), _stepped(windows, car, "euler")
    first, other = (euler, runge_kutta) if _by_euler(runge_kutta[1], euler[1]) else (runge_kutta, euler)
    found = search(first[0])
    fit = found.selection.fit
    beside = IdentificationProblem(other[0], car, found.problem.tempering).fit(fit.car, fit.free)
    fits = {first[0].integrator: fit, other[0].integrator: beside}
    if _by_euler(fits["rk4"], fits["euler"]) == (first is euler):
        return found
    return search(other[0], fit)


def _by_euler(runge_kutta: Fit, euler: Fit) -> bool:
    return euler.objective < runge_kutta.objective - _CLEARLY


def _stepped(windows: SimulationWindows, car: CarEstimate, integrator: Integrator) -> tuple[SimulationWindows, Fit]:
    """The windows in steps that are short enough for the recalibrated car too, and its fit to some of them.

    That car may be much stiffer than the one of the file, and a simulation whose steps are too long for it runs away.
    """
    some = windows.select(np.arange(0, len(windows), -(-len(windows) // _TRIED)))
    trial = some.with_integrator(integrator, car.vehicle)
    fit = IdentificationProblem(trial, car).fit(car, ())
    finer = trial.with_integrator(integrator, car.vehicle.with_nominal(np.array(fit.car.theta)))
    if finer.substeps > trial.substeps:
        trial, fit = finer, IdentificationProblem(finer, car).fit(fit.car, ())
    return replace(windows, integrator=integrator, substeps=trial.substeps), fit
