"""Calibration: the nominal coefficients by bounded nonlinear least squares on prediction errors.

Errors of one or several steps ahead are minimised rather than differentiated noisy states. Everything is computed in
coordinates where each coefficient's admissible range is [0, 1]; nominal values and bounds act as weak knowledge (a
uniform distribution's variance), so that what the data cannot tell stays nominal and comes out as "known by its bounds
only" and not as a wild value with a wild error.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dynssm_ros.arrays import Vector
from dynssm_ros.errors import RecordingError
from dynssm_ros.learning.least_squares import Influence, Loss, influence, least_squares
from dynssm_ros.signals.context import recording_context
from dynssm_ros.signals.inputs import applied_inputs
from dynssm_ros.signals.recording import Recording
from dynssm_ros.vehicle import COEFFICIENTS, Applied, Coefficients, State, Vehicle
from dynssm_ros.vehicle.effects import require_context
from dynssm_ros.vehicle.single_track import Integrator, settled_memory, step_with_memory

Progress = Callable[[int, int], None]

_UNIFORM_PRECISION = 12.0  # inverse variance of a uniform distribution on [0, 1]
_ON_BOUND = 1e-3  # fraction of the range
_BLOCK = 2.0  # s; errors closer than this are treated as correlated,
_BLOCKS = 4  # as far as that leaves this many blocks for each coefficient
_ROUNDS = 10  # of fitting and weighing anew, at most
_MAX_RESIDUALS = 40_000  # per channel
_MAX_SEARCHED = 4_000  # the same while it looks for the right valley


@dataclass(frozen=True)
class Calibration:
    """What the data say of the coefficients.

    Attributes:
        vehicle: the vehicle with calibrated nominal values and their standard deviations.
        theta: coefficients ``(17,)``; ``std`` their standard deviations.
        on_bound: names of coefficients that the data push against a bound.
        unidentified: combinations that the data do not determine better than the bounds do, as
            ``{coefficient: weight}`` in units of the ranges.
        rmse_before: one-step RMSE ``(3,)`` with the former nominal values; ``rmse_after`` with the calibrated ones.
        rows: number of prediction errors used per channel; ``steps`` ahead.
    """

    vehicle: Vehicle
    theta: Vector
    std: Vector
    on_bound: tuple[str, ...]
    unidentified: tuple[dict[str, float], ...]
    rmse_before: Vector
    rmse_after: Vector
    rows: int
    steps: int


class PredictionErrors:
    """Errors of ``steps``-step predictions from every usable row, as a function of the coefficients.

    Raises:
        RecordingError: too few usable rows.
        ConfigurationError: an effect of the vehicle needs a signal that the recording does not have.
    """

    def __init__(
        self,
        recording: Recording,
        vehicle: Vehicle,
        steps: int = 1,
        min_speed: float = 0.0,
        integrator: Integrator = "euler",
        substeps: int = 1,
        limit: int = _MAX_RESIDUALS,
    ) -> None:
        starts = recording.window_ends(1, horizon=steps, min_speed=min_speed)
        stride = max(1, -(-len(starts) * steps // limit))
        self.starts = starts[::stride]
        if len(self.starts) * 3 < 10 * len(COEFFICIENTS):
            raise RecordingError(
                f"recording {', '.join(recording.info.source)}: only {len(self.starts)} usable rows at {min_speed:g} m/s or "
                f"more; expected at least {10 * len(COEFFICIENTS) // 3 + 1} to calibrate {len(COEFFICIENTS)} coefficients"
            )
        self.vehicle, self.steps = vehicle, steps
        self._integrator: Integrator = integrator
        self._substeps = substeps
        self._effects = vehicle.active_effects
        context = recording_context(recording)
        require_context(self._effects, context, f"recording {', '.join(recording.info.source)}")
        self._context = [{name: v[self.starts + k] for name, v in context.items()} for k in range(steps)]
        rows = recording.matrix.T
        self._rows = [rows[:, self.starts + k] for k in range(steps)]
        self._target = np.stack([rows[:3, self.starts + k + 1] for k in range(steps)], axis=1)
        # an error of k steps is measured against what the state does in k steps
        self.scale = np.stack([(self._target[:, k] - rows[:3, self.starts]).std(axis=1) for k in range(steps)], axis=1)
        block = min(_BLOCK, len(starts) * recording.T_s / (_BLOCKS * len(COEFFICIENTS)))
        self.blocks = recording.time[self.starts] // round(block * 1e9)

    def __call__(self, theta: Vector) -> Vector:
        """Errors ``(3, steps, N)`` in m/s, m/s, rad/s for coefficients ``(17,)``."""
        first, coefficients, constants = self._rows[0], Coefficients(*theta), self.vehicle.constants
        state, feedback = State(*first[:3]), Applied(*first[3:5])
        memory = settled_memory(np, state, feedback, coefficients, constants, self._effects, context=self._context[0])
        predicted = np.empty_like(self._target)
        for k in range(self.steps):
            state, memory = step_with_memory(
                np,
                state,
                memory,
                applied_inputs(self._rows[k]),
                coefficients,
                constants,
                self.vehicle.sampling_time,
                self._effects,
                self._integrator,
                self._substeps,
                self._context[k],
            )
            predicted[:, k] = state
        return predicted - self._target

    def one_step_rmse(self, theta: Vector) -> Vector:
        """RMSE of the first step, ``(3,)``."""
        rmse: Vector = np.sqrt((self(theta)[:, 0] ** 2).mean(axis=1))
        return rmse


def calibrate(
    recording: Recording,
    vehicle: Vehicle,
    steps: int = 1,
    loss: Loss = "soft_l1",
    min_speed: float = 0.0,
    starts: int = 4,
    seed: int = 0,
    progress: Progress | None = None,
) -> Calibration:
    """Fits the nominal coefficients within their bounds.

    Args:
        recording: measured or simulated laps.
        vehicle: start values and bounds; its effects are part of the model.
        steps: steps ahead that are predicted; more weigh slow errors higher.
        loss: robust loss, by its name in scipy's ``least_squares``.
        min_speed: rows that are slower are left out (m/s).
        starts: starting points: the nominal values, the middle of the bounds, then seeded random ones.
        seed: of the random starting points.
        progress: told after each starting point.

    Raises:
        RecordingError: another sampling time than the vehicle's, or too few rows.
    """
    recording.require_sampling_time(vehicle.sampling_time, f"vehicle {vehicle.name}")
    errors = PredictionErrors(recording, vehicle, steps, min_speed)
    lower, width = vehicle.lower, vehicle.upper - vehicle.lower
    sample = _Weighted(PredictionErrors(recording, vehicle, steps, min_speed, limit=_MAX_SEARCHED), lower, width)
    fits = []
    for number, point in enumerate(_starting_points(vehicle, starts, seed), 1):
        fits.append(least_squares(sample, point, loss, tolerance=1e-5, iterations=60))
        if progress is not None:
            progress(number, starts + 1)
    weighted = _Weighted(errors, lower, width)
    best = min(fits, key=lambda fit: fit.cost).p
    p = _polish(weighted, best, (vehicle.nominal - lower) / width, loss)
    if progress is not None:
        progress(starts + 1, starts + 1)
    theta = lower + p * width
    free = (p > _ON_BOUND) & (p < 1 - _ON_BOUND)
    covariance, unidentified = _knowledge(influence(weighted, p, loss), np.tile(errors.blocks, 3 * steps), free)
    std = np.where(free, np.sqrt(np.diag(covariance)), np.sqrt(1 / _UNIFORM_PRECISION)) * width
    return Calibration(
        vehicle.with_nominal(np.clip(theta, vehicle.lower, vehicle.upper), std),
        theta,
        std,
        tuple(name for name, inside in zip(COEFFICIENTS, free, strict=True) if not inside),
        unidentified,
        errors.one_step_rmse(vehicle.nominal),
        errors.one_step_rmse(theta),
        len(errors.starts),
        steps,
    )


class _Weighted:
    """Prediction errors in units of a scale per channel and step, as a function of the unit coordinates."""

    def __init__(self, errors: PredictionErrors, lower: Vector, width: Vector) -> None:
        self._errors, self._lower, self._width = errors, lower, width
        self._scale = np.maximum(errors.scale, 1e-12)

    def __call__(self, p: Vector) -> Vector:
        weighted: Vector = (self._errors(self._lower + p * self._width) / self._scale[:, :, None]).ravel()
        return np.nan_to_num(weighted, copy=False, nan=1e6, posinf=1e6, neginf=-1e6)

    def reweigh(self, p: Vector) -> bool:
        """Weighs each channel by its own error at ``p``; returns whether that halves any.

        The floor keeps exact data finite.
        """
        before, left = self._scale, self._errors(self._lower + p * self._width)
        floor = 1e-9 * self._errors.scale + 1e-15
        self._scale = np.maximum(1.4826 * np.median(np.abs(left), axis=2), floor)
        return bool((self._scale < 0.5 * before).any())


def _polish(weighted: _Weighted, start: Vector, nominal: Vector, loss: Loss) -> Vector:
    """Fits with each channel weighed by its own error, which is only known along the way."""

    def residuals(p: Vector) -> Vector:
        return np.concatenate([weighted(p), np.sqrt(_UNIFORM_PRECISION) * (p - nominal)])

    p = start
    for number in range(_ROUNDS):
        if not weighted.reweigh(p) and number > 0:
            break
        p = least_squares(residuals, p, loss, tolerance=1e-12, iterations=1000).p
    return p


def _starting_points(vehicle: Vehicle, count: int, seed: int) -> list[Vector]:
    """The nominal values, the middle of the bounds, then random points, in unit coordinates off the bounds."""
    random = np.random.default_rng(seed)
    nominal = (vehicle.nominal - vehicle.lower) / (vehicle.upper - vehicle.lower)
    points = [np.clip(nominal, 1e-6, 1 - 1e-6), np.full(len(nominal), 0.5)]
    return [*points, *(random.uniform(0.1, 0.9, len(nominal)) for _ in range(count - 2))][:count]


def _knowledge(
    at: Influence, blocks: npt.NDArray[np.int64], free: npt.NDArray[np.bool_]
) -> tuple[Vector, tuple[dict[str, float], ...]]:
    """Covariance in unit coordinates, and the directions that the data leave open.

    Neighbouring errors are correlated, so the scores are summed over blocks in time (cluster-robust "sandwich").
    """
    size = len(at.jacobian)
    # brings the robust loss, whatever its scale, to the units of a likelihood: information and scores' variance agree
    calibration = float(at.slope.mean()) / max(float((at.psi**2).mean()), 1e-300)
    information = calibration * (at.jacobian * at.slope) @ at.jacobian.T
    scores = calibration * (at.jacobian * at.psi).T
    _, index = np.unique(blocks, return_inverse=True)
    summed = np.zeros((index.max() + 1, size))
    np.add.at(summed, index, scores)
    keep = np.flatnonzero(free)
    part = np.ix_(keep, keep)
    # fitting takes as many degrees of freedom from the blocks as there are free coefficients
    meat = summed[:, keep].T @ summed[:, keep] * (len(summed) / max(1, len(summed) - len(keep)))
    bread = np.linalg.inv(information[part] + _UNIFORM_PRECISION * np.eye(len(keep)))
    covariance = np.zeros((size, size))
    covariance[part] = bread @ (meat + _UNIFORM_PRECISION * np.eye(len(keep))) @ bread
    values, vectors = np.linalg.eigh(information[part])
    open_directions = tuple(
        {COEFFICIENTS[keep[k]]: round(float(v), 2) for k, v in enumerate(vectors[:, d]) if abs(v) > 0.25}
        for d in np.flatnonzero(values < _UNIFORM_PRECISION)
    )
    return covariance, open_directions
