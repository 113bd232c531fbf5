"""What a model does with the physical coefficients that it adapts: the numbers of the paper's coefficient table."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.evaluation.metrics import finite
from dynssm_ros.vehicle import COEFFICIENT_UNITS, COEFFICIENTS, Vehicle

AT_BOUND = 0.01  # of the admissible range: nearer to a bound than this counts as resting on it


@dataclass(frozen=True)
class CoefficientStatistics:
    """Statistics of the adapted coefficients over the scored rows, each of shape ``(17,)`` in the coefficient's unit.

    ``at_bound`` is the share of the rows in which the coefficient rests on a bound of the vehicle's, in [0, 1].
    """

    mean: Vector
    std: Vector
    low: Vector
    high: Vector
    at_bound: Vector
    vehicle: Vehicle

    def to_json(self) -> dict[str, Any]:
        """By coefficient; what is not finite becomes ``None``."""
        values = {"mean": self.mean, "std": self.std, "min": self.low, "max": self.high, "at_bound": self.at_bound}
        bounds = np.stack([self.vehicle.lower, self.vehicle.upper], axis=1).tolist()
        return {
            name: {key: finite(value[k]) for key, value in values.items()}
            | {"bounds": bounds[k], "unit": COEFFICIENT_UNITS[name]}
            for k, name in enumerate(COEFFICIENTS)
        }


def coefficient_unit(name: str) -> str:
    """Unit of a coefficient as people write it; empty for pure numbers."""
    unit = COEFFICIENT_UNITS[name].replace("^2", "²")
    return "" if unit == "1" else unit


def coefficient_label(name: str, symbol: str = "") -> str:
    """Name of a coefficient, or another ``symbol`` for it, with its unit."""
    unit = coefficient_unit(name)
    return f"{symbol or name} ({unit})" if unit else symbol or name


class CoefficientTally:
    """Statistics of a vehicle's coefficients that come block by block, so that nobody has to hold them all."""

    def __init__(self, vehicle: Vehicle | None):
        self._vehicle = vehicle
        self._rows = 0
        self._low = self._high = np.empty(0)
        self._mean = self._squares = self._resting = np.zeros(len(COEFFICIENTS))

    def add(self, theta: Vector) -> None:
        """Counts a block of rows in, ``(N, 17)``, ``N > 0``."""
        if self._vehicle is None:
            return
        if self._rows == 0:
            self._low = self._high = theta[0]
        rows = self._rows + len(theta)
        # Chan, Golub, LeVeque (1983): mean and squared deviations of two sets as one
        mean = theta.mean(axis=0)
        apart, share = mean - self._mean, len(theta) / rows
        self._squares = self._squares + ((theta - mean) ** 2).sum(axis=0) + self._rows * share * apart**2
        self._mean = self._mean + share * apart
        self._low, self._high = np.minimum(self._low, theta.min(axis=0)), np.maximum(self._high, theta.max(axis=0))
        self._resting = self._resting + resting(theta, self._vehicle).sum(axis=0)
        self._rows = rows

    @property
    def statistics(self) -> CoefficientStatistics | None:
        """Of all rows; ``None`` without rows, without a car, or if the coefficients are constant: nothing adapts."""
        if self._vehicle is None or self._rows == 0 or not (self._high != self._low).any():
            return None
        return CoefficientStatistics(
            mean=self._mean,
            std=np.sqrt(self._squares / self._rows),
            low=self._low,
            high=self._high,
            at_bound=self._resting / self._rows,
            vehicle=self._vehicle,
        )


def range_used(theta: Vector, vehicle: Vehicle) -> Vector:
    """Coefficients ``(N, 17)`` as their place in the admissible range: 0 is the lower bound, 1 the upper."""
    return np.asarray((theta - vehicle.lower) / (vehicle.upper - vehicle.lower))


def resting(theta: Vector, vehicle: Vehicle) -> Vector:
    """1 where a coefficient rests on a bound, else 0; shape ``(N, 17)``."""
    used = range_used(theta, vehicle)
    return ((used < AT_BOUND) | (used > 1 - AT_BOUND)).astype(np.float64)
