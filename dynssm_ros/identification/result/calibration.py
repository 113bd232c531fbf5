"""Calibration: the nominal coefficients of a vehicle from measured laps, with their uncertainty.

It is a diagnosis without candidates: the same prediction errors, noise model and covariance. What the vehicle file knows of a
coefficient (its standard deviation, else its bounds) is its prior. The data choose how the model steps. Coefficients that
are fitted in Euler steps to a car that moves continuously are those of no car: the yaw inertia of an AV-21 comes out a
quarter too large. So Euler steps are taken only if they explain the data, as those of some simulators do.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import count

import numpy as np
from scipy import optimize

from dynssm_ros.arrays import Vector
from dynssm_ros.errors import RecordingError
from dynssm_ros.identification import tuning
from dynssm_ros.identification.problem.car import CarEstimate
from dynssm_ros.identification.problem.fit import Fit, IdentificationProblem, closest
from dynssm_ros.identification.problem.windows import RecordedRows, SimulationWindows, fit_windows, recorded_rows
from dynssm_ros.progress import Progress
from dynssm_ros.signals.recording import Recording
from dynssm_ros.track.lap_position import first_lap, lap_context
from dynssm_ros.track.lines import Line
from dynssm_ros.vehicle import COEFFICIENTS, Vehicle
from dynssm_ros.vehicle.effects import require_context
from dynssm_ros.vehicle.effects.base import LAP
from dynssm_ros.vehicle.integrators import Integrator
from dynssm_ros.vehicle.single_track import State

_INTEGRATORS: tuple[Integrator, ...] = ("rk4", "euler")  # the first, unless another is clearly closer to the data


@dataclass(frozen=True)
class Calibration:
    """What the data say of the coefficients.

    Attributes:
        vehicle: the vehicle with calibrated nominal values and their standard deviations.
        theta: coefficients ``(17,)``; ``std`` their standard deviations, at most those known before.
        on_bound: names of coefficients that the data push against a bound.
        unidentified: combinations that the data determine less well than was known before, as ``{coefficient: weight}`` in
            units of what was known.
        rmse_before: one-step RMSE ``(3,)`` with the former nominal values; ``rmse_after`` with the calibrated ones.
        rows: number of prediction errors used per channel.
        horizon: length of the simulations (s).
        rmse_ahead: error ``(3,)`` at the end of the simulations; ``persistence`` that of the prediction that nothing changes.
    """

    vehicle: Vehicle
    theta: Vector
    std: Vector
    on_bound: tuple[str, ...]
    unidentified: tuple[dict[str, float], ...]
    rmse_before: Vector
    rmse_after: Vector
    rows: int
    horizon: float
    rmse_ahead: Vector
    persistence: Vector

    @property
    def tells_nothing_of(self) -> list[str]:
        """The states whose error is no less than :attr:`persistence`."""
        each = zip(State._fields, self.rmse_ahead, self.persistence, strict=True)
        return [name for name, error, still in each if 0 < still <= error]


def calibrate(
    recording: Recording,
    vehicle: Vehicle,
    *,
    horizon: float | None = None,
    min_speed: float | None = None,
    integrator: Integrator | None = None,
    starts: int = 3,
    seed: int = 0,
    on_progress: Progress | None = None,
    line: Line | None = None,
) -> Calibration:
    """Fits the nominal coefficients within their bounds; mass and geometry stay.

    Args:
        recording: measured or simulated laps.
        vehicle: start values, bounds and what is known before; its effects are part of the model.
        horizon: length of the simulations that are compared with the laps (s); ``None``: 0.5, less for short recordings.
        min_speed: rows that are slower are left out (m/s); ``None``: the vehicle file's.
        integrator: of the model; ``None``: Runge-Kutta, unless Euler steps of T_s explain the data and are clearly closer to
            them.
        starts: starting points: the nominal values, the middle of the bounds, then seeded random ones.
        seed: of the random starting points.
        on_progress: called after each starting point.
        line: of the track, from which the places of the vehicle's effects are counted; ``None``: only how the road bends is
            known, from the first full lap.

    Raises:
        RecordingError: another sampling time than the vehicle's, or too few rows.
        ConfigurationError: an effect of the vehicle needs a signal that the recording does not have.
    """
    recording.require_sampling_time(vehicle.sampling_time, f"vehicle {vehicle.name}")
    recording.require_set_point(vehicle.inputs.set_point, f"vehicle {vehicle.name}")
    context = _context(recording, vehicle, line)
    require_context(vehicle.active_effects, context, f"recording {', '.join(recording.info.source)}")
    speed = vehicle.minimum_speed if min_speed is None else min_speed
    data = recorded_rows(recording, context)
    windows = _windows(recording, data, tuning.HORIZONS_S if horizon is None else (horizon,), speed)
    given = CarEstimate.of(vehicle.known_before(recording.fingerprints), mass_std=0.0).at(vehicle.nominal)
    one_step = SimulationWindows(data, recording.window_ends(1, horizon=1, min_speed=speed), 1, 0)
    points = _starting_points(vehicle, starts, seed)
    tried = _INTEGRATORS if integrator is None else (integrator,)
    tick = _counter(on_progress, len(tried) * len(points) + 1)
    fits = {one: _fitted(windows, one_step.with_integrator(one, vehicle), given, points, tick) for one in tried}
    problem, fit = fits[closest({one: found for one, (_, found) in fits.items()})]
    if problem.inflation(fit) > tuning.EXPLAINED_INFLATION:
        problem, fit = fits[tried[0]]
    fit = problem.temper(fit)
    tick()
    return _calibration(recording, vehicle, problem, fit, given, one_step.stepped_as(problem.windows))


def _calibration(
    recording: Recording,
    vehicle: Vehicle,
    problem: IdentificationProblem,
    fit: Fit,
    given: CarEstimate,
    one_step: SimulationWindows,
) -> Calibration:
    """What the ``fit`` of ``problem`` says beside the car as ``given``."""
    windows, n = problem.windows, len(COEFFICIENTS)
    calibrated = fit.car.known(problem.covariance(fit)).model_copy(update={"integrator": windows.integrator})
    calibrated = calibrated.calibrated_on(recording.fingerprints, vehicle)
    lower, upper = given.limits
    held = (fit.position <= lower + tuning.AT_BOUND) | (fit.position >= upper - tuning.AT_BOUND)
    return Calibration(
        calibrated,
        np.array(fit.car.theta),
        np.array([calibrated.coefficients[name].std for name in COEFFICIENTS]),
        tuple(name for name, on in zip(COEFFICIENTS, held[:n], strict=True) if on),
        _unidentified(problem, fit),
        _rmse(one_step, given),
        _rmse(one_step, fit.car),
        windows.target.shape[0] * windows.target.shape[1],
        windows.steps * recording.T_s,
        *_ahead(windows, fit.errors.reshape(windows.target.shape)),
    )


def _ahead(windows: SimulationWindows, errors: Vector) -> tuple[Vector, Vector]:
    """RMS ``(3,)`` of the last ``errors`` ``(W, K, 3)``, and of the measured changes."""
    changes = windows.target[:, -1] - windows.data.rows[:3, windows.starts].T
    error, still = (np.asarray(np.sqrt(np.mean(each**2, axis=0))) for each in (errors[:, -1], changes))
    return error, still


def _rmse(one_step: SimulationWindows, car: CarEstimate) -> Vector:
    """RMSE of each state over all rows, ``(3,)``, some at a time: a long recording has many."""
    squares = sum(np.sum(one_step.select(block).errors(car)[:, 0] ** 2, axis=0) for block in one_step.blocks())
    return np.asarray(np.sqrt(squares / len(one_step)))


def _context(recording: Recording, vehicle: Vehicle, line: Line | None) -> dict[str, Vector]:
    """What is known beside state and inputs. Where a lap starts its first full one does not tell, but how the road bends."""
    if line is not None or not any("bend" in effect.needs for effect in vehicle.active_effects):
        return lap_context(recording, line)
    along = lap_context(recording, first_lap(recording))
    return {name: signal for name, signal in along.items() if name in recording.columns or name not in LAP}


def _fitted(
    windows: SimulationWindows,
    one_step: SimulationWindows,
    given: CarEstimate,
    points: list[Vector],
    tick: Callable[[], None],
) -> tuple[IdentificationProblem, Fit]:
    """The car ``given``, fitted to ``windows`` in the steps of ``one_step``."""
    near = _nearest_start(one_step, given, points, tick)
    vehicle = given.vehicle.with_nominal(np.array(near.theta))
    problem = IdentificationProblem(windows.with_integrator(one_step.integrator, vehicle), near)
    # what is known before counts from here on, so the nominal values are a starting point again
    return problem, min((problem.fit(car, ()) for car in (near, given)), key=lambda fit: fit.objective)


def _counter(on_progress: Progress | None, of: int) -> Callable[[], None]:
    """Tells the next count with each call."""
    done = count(1)
    return lambda: on_progress(next(done), of) if on_progress is not None else None


def _windows(
    recording: Recording, data: RecordedRows, horizons: Sequence[float], min_speed: float
) -> SimulationWindows:
    """Simulations of the longest of ``horizons`` (s) for which there are stretches enough."""
    for horizon in horizons[:-1]:
        with suppress(RecordingError):
            return fit_windows(recording, data, horizon, min_speed)
    return fit_windows(recording, data, horizons[-1], min_speed)


def _nearest_start(
    one_step: SimulationWindows, given: CarEstimate, points: list[Vector], tick: Callable[[], None]
) -> CarEstimate:
    """The car from which the fit is to begin: the best of robust fits of one-step errors from each of the points.

    Far from the truth the noise model would take a wrong car for a disturbed one. Here errors are in units of the
    increments. What is known before is weighed with the errors that are left, found by a few rounds.
    """
    few, many = (
        one_step.select(np.arange(0, len(one_step), max(1, len(one_step) // n)))
        for n in (tuning.SEARCH_ROWS, tuning.POLISH_ROWS)
    )
    rows = many.data.rows
    scale = np.maximum((rows[:3, many.starts + 1] - rows[:3, many.starts]).std(axis=1), 1e-12)
    lower, width = given.vehicle.lower, given.vehicle.upper - given.vehicle.lower

    def fitted(
        some: SimulationWindows, start: Vector, prior: float, limits: tuple[float, int]
    ) -> optimize.OptimizeResult:
        tolerance, evaluations = limits
        inside = np.clip(start, tuning.AT_BOUND, 1.0 - tuning.AT_BOUND)

        def residuals_at(places: Vector) -> Vector:
            cars = [given.at(lower + p * width) for p in places]
            errors = some.errors_of(cars)[:, :, 0] / scale
            return np.concatenate(
                [errors.reshape(len(cars), -1), prior * np.array([car.moved for car in cars])], axis=1
            )

        def derivatives(p: Vector) -> Vector:
            moved = p + np.diag(np.where(p + tuning.DIFFERENCE > 1.0, -tuning.DIFFERENCE, tuning.DIFFERENCE))
            at = residuals_at(np.vstack([p, moved]))
            return np.asarray((at[1:] - at[0]).T / (np.diag(moved) - p))

        def residuals(p: Vector) -> Vector:
            return np.asarray(residuals_at(p[None])[0])

        return optimize.least_squares(
            residuals, inside, derivatives, bounds=(0.0, 1.0), loss="soft_l1", x_scale="jac", ftol=tolerance,
            xtol=tolerance, gtol=tolerance, max_nfev=evaluations,
        )  # fmt: skip

    found = []
    for theta in points:
        found.append(fitted(few, (theta - lower) / width, tuning.SEARCH_PRIOR, tuning.SEARCH_LIMITS))
        tick()
    best = min(found, key=lambda fit: float(fit.cost))
    left = float(np.median(np.abs(best.fun[: 3 * len(few)])))
    for _ in range(tuning.POLISH_ROUNDS):
        best = fitted(many, best.x, left, tuning.POLISH_LIMITS)
        left = float(np.median(np.abs(best.fun[: 3 * len(many)])))
    return given.at(lower + best.x * width)


def _starting_points(vehicle: Vehicle, count: int, seed: int) -> list[Vector]:
    """The nominal values, the middle of the bounds, then random points well inside them."""
    random, width = np.random.default_rng(seed), vehicle.upper - vehicle.lower
    drawn = (vehicle.lower + random.uniform(0.1, 0.9, len(width)) * width for _ in range(count - 2))
    return [vehicle.nominal, (vehicle.lower + vehicle.upper) / 2, *drawn][:count]


def _unidentified(problem: IdentificationProblem, fit: Fit) -> tuple[dict[str, float], ...]:
    """Eigenvectors of the information with less of it than was known before."""
    n = len(COEFFICIENTS)
    values, vectors = np.linalg.eigh(problem.information(fit)[:n, :n])
    return tuple(
        {COEFFICIENTS[k]: round(float(v), 2) for k, v in enumerate(vectors[:, d]) if abs(v) > tuning.WEIGHT_SHOWN}
        for d in np.flatnonzero(values < 1.0)
    )
