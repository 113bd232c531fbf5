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
    """Statistics of the adapted coefficients over the scored rows, each of shape ``(17,)``.

    Attributes:
        mean: in the coefficient's unit; so are the next three.
        std: standard deviation.
        low: smallest value.
        high: largest value.
        at_bound: share of the rows in which the coefficient rests on a bound, in [0, 1].
        vehicle: whose bounds these are.
    """

    mean: Vector
    std: Vector
    low: Vector
    high: Vector
    at_bound: Vector
    vehicle: Vehicle

    def to_json(self) -> dict[str, Any]:
        """By coefficient; what is not finite becomes ``None``."""
        return {
            name: {
                "mean": finite(self.mean[k]),
                "std": finite(self.std[k]),
                "min": finite(self.low[k]),
                "max": finite(self.high[k]),
                "bounds": [float(self.vehicle.lower[k]), float(self.vehicle.upper[k])],
                "at_bound": finite(self.at_bound[k]),
                "unit": COEFFICIENT_UNITS[name],
            }
            for k, name in enumerate(COEFFICIENTS)
        }


def coefficient_unit(name: str) -> str:
    """Unit of a coefficient as people write it; empty for pure numbers."""
    unit = COEFFICIENT_UNITS[name].replace("^2", "²")
    return "" if unit == "1" else unit


def coefficient_label(name: str) -> str:
    """Name of a coefficient with its unit."""
    unit = coefficient_unit(name)
    return f"{name} ({unit})" if unit else name


def coefficient_statistics(theta: Vector | None, vehicle: Vehicle | None) -> CoefficientStatistics | None:
    """Statistics of the coefficients ``theta`` ``(N, 17)`` between the bounds of ``vehicle``.

    ``None`` for a model without coefficients, without a car of its own, or with constant ones: it adapts nothing.
    """
    if theta is None or vehicle is None or not (theta != theta[0]).any():
        return None
    return CoefficientStatistics(
        mean=theta.mean(axis=0),
        std=theta.std(axis=0),
        low=theta.min(axis=0),
        high=theta.max(axis=0),
        at_bound=resting(theta, vehicle).mean(axis=0),
        vehicle=vehicle,
    )


def range_used(theta: Vector, vehicle: Vehicle) -> Vector:
    """Coefficients ``(N, 17)`` as their place in the admissible range: 0 is the lower bound, 1 the upper."""
    place: Vector = (theta - vehicle.lower) / (vehicle.upper - vehicle.lower)
    return place


def resting(theta: Vector, vehicle: Vehicle) -> Vector:
    """1 where a coefficient rests on a bound, else 0; shape ``(N, 17)``."""
    used = range_used(theta, vehicle)
    return ((used < AT_BOUND) | (used > 1 - AT_BOUND)).astype(np.float64)
