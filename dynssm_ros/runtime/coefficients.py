"""Coefficients that follow the car: a recursive Bayesian estimate, published only as far as the data support it.

Measured and predicted increments are compared over blocks of rows. Within a block the noise of all states but the first
and the last cancels, and the noise in the physics' inputs averages out. An extended Kalman filter estimates the
coefficients' changes together with a slow error of the physics in each channel, so that what a bank or wind does to the car
is not put into its tyres. The changes follow Ornstein-Uhlenbeck processes around the calibrated values.

Beside it runs the car that has not changed. The logarithm of the two cars' likelihood ratio, with forgetting, says which
predicts the blocks better before it has seen them (Bayesian model comparison); the published change is shrunk by the
probability that there is one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from functools import cached_property
from typing import NamedTuple

import numpy as np

from dynssm_ros import compiled
from dynssm_ros.arrays import Indices, Vector
from dynssm_ros.errors import ConfigurationError
from dynssm_ros.signals.inputs import applied_inputs
from dynssm_ros.vehicle import COEFFICIENTS, Applied, CarModel, Coefficients, State, Vehicle
from dynssm_ros.vehicle.compiled_car import CompiledCar
from dynssm_ros.vehicle.integrators import Integrator

SPREAD: dict[str, float] = {
    "B_f": 0.1, "C_f": 0.03, "D_f": 0.15, "B_r": 0.1, "C_r": 0.03, "D_r": 0.15, "S_hf": 0.01, "S_hr": 0.01,
    "C_m1": 0.1, "C_m2": 0.1, "C_r0": 0.2, "C_r2": 0.1, "I_z": 0.1,
}  # fmt: skip
"""Standard deviation of each coefficient's change from one day to another: a share of its nominal value, for the shifts of
the slip angles in rad. Coefficients that are not named stay as calibrated."""
SHIFTS = ("S_hf", "S_vf", "S_hr", "S_vr")
"""Coefficients that are about zero: a share of them says nothing."""
_BLOCK_S = 0.3
_MEMORY_S = 300.0  # over which changes return to the calibrated values
_ERROR_MEMORY_S = 2.0  # of the physics' slow error
_NOISE_MEMORY_S = 8.0
_SMALLEST = 1e-6  # noise variance, in squared s_delta
_FARTHEST = 3.0  # changes beyond this many standard deviations are not believed
_OUTLIER = 3.0
_EVIDENCE_MEMORY_S = 20.0
_EVIDENCE_WANTED = 3.0  # log likelihood ratio that makes a change as likely as none
_LEAST_EVIDENCE, _MOST_EVIDENCE = -2.0, 12.0  # as in a cumulative sum test: a long calm must not delay the alarm
_FEWEST = 10  # blocks that tell what is usual
_SECANT = 0.5  # of the spread: step of the derivatives


def daily_change(vehicle: Vehicle, spread: Mapping[str, float] = SPREAD) -> Vector:
    """Standard deviations of the coefficients' changes from one day to another, ``(17,)``, by :data:`SPREAD`."""
    size = np.where(np.isin(COEFFICIENTS, SHIFTS), 1.0, np.abs(vehicle.nominal))
    change: Vector = size * [spread.get(name, 0.0) for name in COEFFICIENTS]
    return change


Measured = Callable[[slice], tuple[Vector, Vector]]
"""Some of a drive's rows ``(n, 7)``, and the increments from each to the next, ``(n, 3)`` (m/s, m/s, rad/s)."""


class BlockErrors(NamedTuple):
    """Variances of the calibrated car's mean errors over blocks of training laps, in squared s_delta, ``(3,)`` each."""

    noise: Vector
    """From block to block."""
    slow: Vector
    """Of what a block shares with the one before: bank, wind, what the physics lacks."""


class CoefficientEstimator:
    """Follows the coefficients of one car from row to row.

    Args:
        vehicle: the calibrated car.
        scale: s_delta (m/s, m/s, rad/s), ``(3,)``.
        errors: what is usual of the calibrated car; see :class:`BlockErrors`.
        integrator: of the physics.
        substeps: integration steps per sampling time.
        spread: as :data:`SPREAD`.

    Raises:
        ConfigurationError: a coefficient that does not exist.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        scale: Vector,
        errors: BlockErrors,
        integrator: Integrator = "euler",
        substeps: int = 1,
        *,
        spread: Mapping[str, float] = SPREAD,
    ) -> None:
        if unknown := [name for name in spread if name not in COEFFICIENTS]:
            raise ConfigurationError(f"spread: unknown {', '.join(unknown)}; expected some of {' '.join(COEFFICIENTS)}")
        self.nominal = vehicle.nominal
        self._vehicle, self._scale = vehicle, scale
        self._car = CarModel.of(vehicle, integrator, substeps)
        change = daily_change(vehicle, spread)
        known = np.array([vehicle.coefficients[name].std or 0.0 for name in COEFFICIENTS])
        self.adapted = np.flatnonzero(change > 0)
        """Which of the coefficients can change."""
        self.spread = np.hypot(change, known)[self.adapted]
        self._known = known
        n = len(self.adapted)
        self.rows = max(1, round(_BLOCK_S / vehicle.sampling_time))
        block = self.rows * vehicle.sampling_time
        self._kept = np.exp(-block / np.concatenate([np.full(n, _MEMORY_S), np.full(3, _ERROR_MEMORY_S)]))
        self._usual = errors
        self._prior = np.concatenate([np.ones(n), errors.slow])
        self._forget = min(1.0, block / _NOISE_MEMORY_S)
        self._compiled = CompiledCar.of(self._car, self.rows)
        self._evidence_kept = math.exp(-block / _EVIDENCE_MEMORY_S)
        self.reset()

    def reset(self) -> None:
        """Returns to the calibrated car."""
        n = len(self.adapted)
        self._x, self._P = np.zeros(n + 3), np.diag(self._prior)
        self._error, self._error_P = np.zeros(3), self._usual.slow.copy()  # of the unchanged car
        self._noise = self._usual.noise.copy()
        self.evidence = 0.0
        """Logarithm of the likelihood ratio of a changed car and the calibrated one."""
        self._block: list[tuple[Vector, Vector]] = []
        self._whole: list[tuple[Vector, Vector]] | None = None
        self._changed()

    @property
    def belief(self) -> float:
        """Probability that the car has changed."""
        return 1.0 / (1.0 + math.exp(min(_EVIDENCE_WANTED - self.evidence, 50.0)))

    @cached_property
    def theta(self) -> Vector:
        """Coefficients as they are to be taken now, ``(17,)``: within their bounds."""
        theta = self.nominal.copy()
        theta[self.adapted] += self.belief * self.spread * self._x[: len(self.adapted)]
        limited: Vector = np.clip(theta, self._vehicle.lower, self._vehicle.upper)
        return limited

    @cached_property
    def std(self) -> Vector:
        """Their standard deviations, ``(17,)``."""
        n, belief = len(self.adapted), self.belief
        std = self._known.copy()
        within = np.diag(self._P)[:n] + (1 - belief) * self._x[:n] ** 2
        std[self.adapted] = np.sqrt((1 - belief) * std[self.adapted] ** 2 + belief * self.spread**2 * within)
        return std

    def _changed(self) -> None:
        """What was derived from the estimate is to be derived anew."""
        self.__dict__.pop("theta", None)
        self.__dict__.pop("std", None)

    def step(self, row: Vector, increment: Vector) -> None:
        """Takes a measured row ``(7,)`` and the measured increment ``(3,)`` to the next (m/s, m/s, rad/s).

        A block that it completes counts from :meth:`finish` on.
        """
        self.finish()
        if not len(self.adapted):
            return
        self._block.append((row, increment))
        if len(self._block) == self.rows:
            self._whole, self._block = self._block, []

    def finish(self) -> None:
        """Learns from the block that is complete. The next step does it else, so that a prediction need not wait for it."""
        whole, self._whole = self._whole, None
        if whole is not None:
            rows, increments = map(np.array, zip(*whole, strict=True))
            if np.isfinite(rows).all() and np.isfinite(increments).all():
                self._update(rows, increments)

    def usual_errors(self, laps: Iterable[tuple[Indices, Measured]]) -> BlockErrors:
        """What is usual of the calibrated car, from laps that it was calibrated on.

        Args:
            laps: numbers of rows, ascending, and what was measured at some of them; blocks have no gap.
        """
        errors = []
        for ends, measured in laps:
            for first in range(0, len(ends) - self.rows + 1, self.rows):
                block = slice(first, first + self.rows)
                if ends[block][-1] - ends[first] == self.rows - 1:
                    rows, increments = measured(block)
                    predicted = self._mean_increments(rows, self.nominal[None])[0]
                    errors.append((increments.mean(axis=0) - predicted) / self._scale)
        if len(errors) < _FEWEST:
            return BlockErrors(np.full(3, _SMALLEST), np.full(3, _SMALLEST))
        e = np.clip(errors, *np.quantile(errors, [0.01, 0.99], axis=0))
        whole = np.mean(e * e, axis=0)
        slow = np.clip(np.mean(e[1:] * e[:-1], axis=0), 0.05 * whole, 0.95 * whole)
        return BlockErrors(np.maximum(whole - slow, _SMALLEST), np.maximum(slow, _SMALLEST))

    def kept(self) -> dict[str, Vector]:
        """What was learned, by name."""
        self.finish()
        return {
            "changes": self._x, "covariance": self._P, "error": self._error, "error_covariance": self._error_P,
            "noise": self._noise, "evidence": np.array([self.evidence]),
        }  # fmt: skip

    def restore(self, kept: Mapping[str, Vector]) -> None:
        """Goes on from what :meth:`kept` gave."""
        self._whole = None
        self._x, self._P = kept["changes"].copy(), kept["covariance"].copy()
        self._error, self._error_P = kept["error"].copy(), kept["error_covariance"].copy()
        self._noise, self.evidence = kept["noise"].copy(), float(kept["evidence"][0])
        self._changed()
        self.interrupt()

    def interrupt(self) -> None:
        """The next row does not follow on the last one: the block that was begun is dropped."""
        self.finish()
        self._block = []

    def _update(self, rows: Vector, increments: Vector) -> None:
        n = len(self.adapted)
        theta = self.nominal.copy()
        theta[self.adapted] += self.spread * self._x[:n]
        cars = np.tile(theta, (n + 2, 1))
        cars[np.arange(1, n + 1), self.adapted] += _SECANT * self.spread
        cars[-1] = self.nominal
        predicted = self._mean_increments(rows, cars) / self._scale
        measured = increments.mean(axis=0) / self._scale
        if not np.isfinite(predicted).all():
            return
        H = (predicted[1 : n + 1] - predicted[0]).T / _SECANT  # (3, n)
        # e = measured - predicted at the estimate, which the derivatives are taken at
        left = measured - predicted[0]
        self._x *= self._kept
        self._P = self._kept[:, None] * self._P * self._kept + np.diag((1 - self._kept**2) * self._prior)
        left = left + H @ (self._x[:n] / self._kept[:n] - self._x[:n])
        kept = self._kept[-3:]
        self._error *= kept
        self._error_P = kept**2 * self._error_P + (1 - kept**2) * self._usual.slow
        ratio = 0.0
        base = self._x[:n].copy()
        for c in range(3):
            h = np.zeros(n + 3)
            h[:n], h[n + c] = H[c], 1.0
            spread = self._P @ h
            explained = float(h @ spread)
            error = float(left[c] - H[c] @ (self._x[:n] - base) - self._x[n + c])
            variance = explained + float(self._noise[c])
            plain = float(measured[c] - predicted[-1, c] - self._error[c])
            plain_variance = float(self._error_P[c] + self._noise[c])
            # Student-like: no single block decides
            ratio += math.log1p(plain**2 / plain_variance / 4) * 2.5 + 0.5 * math.log(plain_variance)
            ratio -= math.log1p(error**2 / variance / 4) * 2.5 + 0.5 * math.log(variance)
            inflation = max(1.0, abs(error) / math.sqrt(variance) / _OUTLIER)
            gain = spread / (explained + float(self._noise[c]) * inflation)
            self._x = self._x + gain * error
            self._P = self._P - np.outer(gain, spread)
            plain_gain = self._error_P[c] / plain_variance
            self._error[c] += plain_gain * plain
            self._error_P[c] *= 1 - plain_gain
            square = min(max(error**2 - explained, 0.05 * self._noise[c]), 20.0 * self._noise[c])
            self._noise[c] += self._forget * (square - self._noise[c])
        self._x[:n] = np.clip(self._x[:n], -_FARTHEST, _FARTHEST)
        self._changed()
        self.evidence = min(max(self._evidence_kept * self.evidence + ratio, _LEAST_EVIDENCE), _MOST_EVIDENCE)

    def _mean_increments(self, rows: Vector, cars: Vector) -> Vector:
        """Mean increments over ``rows`` ``(L, 7)`` of cars with coefficients ``(P, 17)``: ``(P, 3)``."""
        if self._compiled is not None and compiled.LIBRARY is not None:
            return np.array([self._compiled.over(rows, theta).mean(axis=0) for theta in cars])
        now = np.broadcast_to(rows.T[:, None], (rows.shape[1], len(cars), len(rows)))
        with np.errstate(all="ignore"):
            moved = self._car.over(
                State(*now[:3]), applied_inputs(now), Applied(*now[3:5]), Coefficients(*cars.T[:, :, None])
            )
        means: Vector = np.stack([part.mean(axis=1) for part in moved], axis=1)
        return means
