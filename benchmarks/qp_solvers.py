"""The controller's quadratic programs by the solvers of the field: ``python -m benchmarks.qp_solvers``.

The programs of some seconds on a track are kept, with noise on what is measured, and solved again in two forms. *Condensed*:
as the controller has them, states eliminated, dense. *By stages*: states as variables tied by the car's steps, sparse, the
form of interior-point solvers for optimal control (HPIPM, which acados uses). Both have the same solution; how far the
first command is from that of the controller's own solver is told with the times. Casadi has all of these solvers; its
fatrop solves none of the programs (3.8.2) and is left out.
"""

from __future__ import annotations

import argparse
import operator
import time
from collections.abc import Sequence
from functools import reduce
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from benchmarks.closed_loop.cells import Cell, sensing
from benchmarks.generalisation.cells import CARS
from benchmarks.live_laps import ROAD
from dynssm_ros.arrays import Vector
from dynssm_ros.cli.console import console
from dynssm_ros.control.buffered import QuadraticProgram
from dynssm_ros.control.caution import Margins
from dynssm_ros.control.horizon_model import HorizonModel
from dynssm_ros.control.nmpc import Adapted, Nmpc
from dynssm_ros.control.program import DELTA, V_X, R
from dynssm_ros.control.race import Course
from dynssm_ros.control.race_models import true_model
from dynssm_ros.control.reference import load_reference
from dynssm_ros.control.settings import Settings
from dynssm_ros.reporting.tables import Column, Table, Value
from dynssm_ros.simulation.plant import make_plant
from dynssm_ros.simulation.sensing import Sensors
from dynssm_ros.vehicle import Applied, State, load_vehicle

_SPEED_SCALE = 0.9
_EASE = 4  # of the increments and slacks of a stage: two and two
_OPTIONS: dict[str, dict[str, Any]] = {
    "daqp": {},
    "qpoases": {"printLevel": "none"},
    "osqp": {"osqp": {"verbose": False, "eps_abs": 1e-6, "eps_rel": 1e-6, "max_iter": 20000}},
    "proxqp": {"proxqp": {"verbose": False, "eps_abs": 1e-6}},
    "hpipm": {"inf": 1e4, "hpipm": {"iter_max": 100, "mode": "balance"}},
}
_SOLVERS = (("condensed", ("daqp", "qpoases", "osqp", "proxqp")), ("by stages", ("osqp", "hpipm")))
_SETTLED = 10  # programs of the first plan


class Problem(NamedTuple):
    """A program ``z' H z / 2 + g' z`` with ``low <= A z <= high``, ``z_low <= z <= z_high``."""

    H: ca.DM
    g: Vector
    A: ca.DM
    low: Vector
    high: Vector
    z_low: Vector
    z_high: Vector
    first: int
    """Where in ``z`` the increments of the first step stand."""


class RecordingSolver(QuadraticProgram):
    """Keeps the programs that it solves."""

    def __init__(self, variables: int, rows: int) -> None:
        super().__init__(variables, rows)
        self.problems: list[Problem] = []

    def solve(
        self, H: Vector, g: Vector, A: Vector, low: Vector, high: Vector, z_low: Vector, z_high: Vector
    ) -> Vector:
        """See :meth:`QuadraticProgram.solve`."""
        self.problems.append(Problem(ca.DM(H), g, ca.DM(A), low, high, z_low, z_high, 0))
        return super().solve(H, g, A, low, high, z_low, z_high)


class Recorder(Nmpc):
    """Keeps the programs that it solves, in both forms."""

    def __init__(self, *given: Any) -> None:
        super().__init__(*given)
        self._solver = RecordingSolver(self._program.variables, self._program.rows)
        self.problems: dict[str, list[Problem]] = {"condensed": self._solver.problems, "by stages": []}

    def _improved(self, now: Vector, guess: Any, adapted: Adapted, t: float, margins: Margins) -> Any:
        x, p = np.concatenate([now[None], guess.x[1:]]), self._parameters(adapted, t)
        steps = self.model.linearised(x[:-1], guess.u, p)
        self.problems["by stages"].append(self._by_stages(x, guess.u, *steps, p, margins))
        return super()._improved(now, guess, adapted, t, margins)

    def _by_stages(
        self, x: Vector, u: Vector, following: Vector, by_x: Vector, by_u: Vector, p: Vector, margins: Margins
    ) -> Problem:
        """The program with states as variables: ``x_0, u_0, slacks, x_1, ...``; a stage's slacks are for the state after."""
        N, size, w = self.settings.N, x.shape[1], self.settings.weights
        wide, length, h = size + _EASE, self.settings.scale.length, self.model.car.T_s / self.settings.scale.time
        n = N * wide + size
        H, g = np.zeros((n, n)), np.zeros(n)
        z_low, z_high = np.full(n, -np.inf), np.full(n, np.inf)
        z_low[:size] = z_high[:size] = x[0]
        at, line, limits = self._program.reference_points(x), self._program.reference.line, self._program.limits
        point, tangents, normals = line.frame(at)
        reach, span = limits.steering_rate * self.model.car.T_s, np.ptp(limits.throttle)
        for k in range(N):
            first, after = k * wide + size, (k + 1) * wide
            inputs, slack, ending = slice(first, first + 2), first + 2, first + 3
            place, actuators = slice(after, after + 2), after + np.array([R, DELTA])
            along, across = (np.outer(each[k], each[k]) for each in (tangents, normals))
            at_end = w.terminal_across if k == N - 1 else 0.0
            W = 2 * (h * w.along * along + (h * w.across + at_end) * across) / length**2
            H[place, place], g[place] = W, -W @ point[k]
            H[inputs, inputs] = 2 * np.diag([w.throttle, w.steering]) / h
            H[slack, slack], g[slack] = 2 * h * w.border, h * w.border
            H[ending, ending] = 2 * max(w.terminal_speed, 1.0)
            z_low[inputs], z_high[inputs] = (-span, -reach), (span, reach)
            z_low[[slack, ending]] = 0.0
            z_low[actuators], z_high[actuators] = zip(limits.throttle, limits.steering, strict=True)
        g[N * wide : N * wide + 2] -= w.progress * tangents[-1] / length
        g[(N - 1) * wide + size + 3] = w.terminal_speed
        gaps = following - np.einsum("kij,kj->ki", by_x, x[:-1]) - np.einsum("kij,kj->ki", by_u, u)
        A, low, high = self._rows_by_stages(by_x, by_u, gaps, self._soft_rows(x, p, margins, float(at[-1])))
        return Problem(ca.sparsify(ca.DM(H)), g, ca.sparsify(ca.DM(A)), low, high, z_low, z_high, size)

    def _rows_by_stages(
        self, by_x: Vector, by_u: Vector, gaps: Vector, soft: tuple[Vector, Vector, Vector]
    ) -> tuple[Vector, Vector, Vector]:
        """Of each stage the step to the next state, then what softly bounds that; its speed is bounded at the end only."""
        N, size = gaps.shape
        wide, length = size + _EASE, self.settings.scale.length
        rows, low, high = [], [], []
        for k, (bounded, least, most) in enumerate(zip(*soft, strict=True)):
            now, inputs, after = k * wide, k * wide + size, (k + 1) * wide
            step, limits = np.zeros((size, N * wide + size)), np.zeros((len(bounded), N * wide + size))
            step[:, now:inputs], step[:, inputs : inputs + 2] = by_x[k], by_u[k]
            step[:, after : after + size] = -np.eye(size)
            limits[:, now:inputs], limits[:, inputs : inputs + 2] = bounded @ by_x[k], bounded @ by_u[k]
            limits[:-1, inputs + 2] = [length, -length, -1.0, -1.0, -1.0, -1.0]
            limits[-1, inputs + 3] = -length / self.settings.scale.time
            kept = slice(None) if k == N - 1 else slice(-1)
            rows += [step, limits[kept]]
            low += [-gaps[k], (least - bounded @ gaps[k])[kept]]
            high += [-gaps[k], (most - bounded @ gaps[k])[kept]]
        return np.concatenate(rows), np.concatenate(low), np.concatenate(high)

    def _soft_rows(self, x: Vector, p: Vector, margins: Margins, end: float) -> tuple[Vector, Vector, Vector]:
        """Rows of the soft constraints in the states after each step, ``(N, 7, size)``, and their bounds, ``(N, 7)``.

        They are the controller's own, read with unit vectors in place of what the increments do. The last is the speed, as
        it may be at ``end`` (m).
        """
        N, size = self.settings.N, x.shape[1]
        unit = np.zeros((N, size, 2 * N))
        unit[:, :, :size] = np.eye(size)
        program = self._program
        borders, slips = np.zeros((2 * N, program.variables)), np.zeros((4 * N, program.variables))
        low, high = np.full(2 * N, -np.inf), np.full(2 * N, np.inf)
        program.add_borders(borders, low, high, x, x[1:, :2], unit[:, :2], margins.lateral)
        bound = np.full(4 * N, np.inf)
        program.add_slip(slips, bound, x[1:], x[1:], unit, p, margins.slip)
        most = np.concatenate([high, bound]).reshape(6, N).T
        least = np.concatenate([low, np.full(4 * N, -np.inf)]).reshape(6, N).T
        rows = np.concatenate([borders, slips])[:, :size].reshape(6, N, size).swapaxes(0, 1)
        here = np.einsum("kij,kj->ki", rows, x[1:])
        bounds_end = self.settings.weights.terminal_speed > 0
        too_fast = float(program.reference.terminal_speed_at(end)) if bounds_end else np.inf
        speed = np.tile(np.eye(size)[V_X], (N, 1, 1))
        return (
            np.concatenate([rows, speed], axis=1),
            np.column_stack([least + here, np.full(N, -np.inf)]),
            np.column_stack([most + here, np.full(N, too_fast)]),
        )


def recorded(car: str, objective: Any, seconds: float) -> dict[str, list[Problem]]:
    """The programs of a drive with usual noise, the first ones left out.

    Args:
        car: of the robustness matrix.
        objective: of the controller.
        seconds: to drive.
    """
    vehicle, cell = load_vehicle(CARS[car].vehicle), Cell(car, ROAD, "none")
    road, settings = cell.road, Settings.of(vehicle, objective)
    reference, model = load_reference("racing", vehicle, road, _SPEED_SCALE), true_model(vehicle, "rk4")
    horizon = HorizonModel(model.car, settings.N, settings.travel, settings.scale.length / settings.scale.time)
    nmpc = Recorder(horizon, vehicle.inputs, reference, road, settings)
    course = Course(vehicle, road, "rk4", reference, settings, sensing=sensing(car, 1.0, False))
    plant, feedback = make_plant(vehicle, course.plant, *course.starting()), Applied(0.0, 0.0)
    sensors = Sensors(course.sensing, vehicle.sampling_time)
    for _ in range(round(seconds / vehicle.sampling_time)):
        sensors.measure(plant.pose, State(*plant.measured))
        pose, seen = sensors.newest
        plan = nmpc.plan(np.array([*pose, *seen, *feedback]), model.calibrated)
        feedback = nmpc.command(plan)
        plant.advance(feedback)
    return {form: problems[_SETTLED:] for form, problems in nmpc.problems.items()}


class Solutions(NamedTuple):
    """Of some programs."""

    seconds: list[float]
    first: Vector
    """Increments of the first step, ``(n, 2)``; not a number where there is no solution."""


def solved(problems: Sequence[Problem], solver: str) -> Solutions:
    """Solves programs of one form."""
    h = reduce(operator.add, (one.H.sparsity() for one in problems))  # what is ever not zero
    a = reduce(operator.add, (one.A.sparsity() for one in problems))
    solve = ca.conic("program", solver, {"h": h, "a": a}, {"error_on_fail": False, **_OPTIONS[solver]})
    seconds, first = [], []
    for one in problems:
        H, A = ca.project(one.H, h), ca.project(one.A, a)
        began = time.thread_time()
        z = solve(h=H, g=one.g, a=A, lba=one.low, uba=one.high, lbx=one.z_low, ubx=one.z_high)["x"].full()[:, 0]
        seconds.append(time.thread_time() - began)
        first.append(z[one.first : one.first + 2] if solve.stats()["success"] else [np.nan, np.nan])
    return Solutions(seconds, np.array(first))


def main(arguments: Sequence[str] | None = None) -> None:
    """Solves the programs of two cars and prints the table."""
    parser = argparse.ArgumentParser(prog="benchmarks.qp_solvers", description=__doc__)
    parser.add_argument("--cars", default="orca,av21", help="of the robustness matrix, separated by commas")
    parser.add_argument("--objective", default="progress", choices=("tracking", "progress"))
    parser.add_argument("--seconds", type=float, default=8.0, help="that are driven")
    given = parser.parse_args(arguments)
    rows: list[list[Value]] = []
    for car in given.cars.split(","):
        forms = recorded(car, given.objective, given.seconds)
        expected = solved(forms["condensed"], "daqp").first
        for form, solvers in _SOLVERS:
            for solver in solvers:
                seconds, first = solved(forms[form], solver)
                p50, p99 = (float(value) for value in 1e3 * np.percentile(seconds, [50, 99]))
                away = np.abs(first - expected).max(axis=1)
                rows.append([car, form, solver, p50, p99, float(np.nanmax(away)), int(np.isnan(away).sum())])
    names = ("car", "form", "solver", "p50 (ms)", "p99 (ms)", "off by", "failed")
    console.print(Table(tuple(map(Column, names)), rows).rich())


if __name__ == "__main__":
    main()
