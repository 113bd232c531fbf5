"""What an extended car gains on laps that neither the fit nor the selection saw."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from dynssm_ros.arrays import Indices, Vector
from dynssm_ros.identification.problem.car import CarEstimate
from dynssm_ros.identification.problem.fit import BLOCK
from dynssm_ros.identification.problem.windows import SimulationWindows
from dynssm_ros.identification.result.residuals import ExplainedVariance, explained_variance

_DRAWS = 400
_NEXT_TO_NONE = 0.01  # of the squared error


@dataclass(frozen=True)
class Improvement:
    """Errors of several cars on the held-out rows.

    Attributes:
        cars: by name; what was first and what is last.
        horizons: times ahead (s), shape ``(n,)``.
        horizon: number of the one that the diagnosis is about.
        errors: predicted minus measured at these times by car, each ``(W, n, 3)`` (m/s, m/s, rad/s).
        explained_variance: what of them is no noise, by car, one for each horizon.
        windows: the simulations.
        seed: of the bootstrap over blocks in time.
    """

    cars: Mapping[str, CarEstimate]
    horizons: Vector
    horizon: int
    errors: Mapping[str, Vector]
    explained_variance: Mapping[str, tuple[ExplainedVariance, ...]]
    windows: SimulationWindows
    seed: int = 0

    @cached_property
    def rmse(self) -> dict[str, Vector]:
        """Root mean square error by car, each ``(n, 3)``."""
        return {name: np.sqrt((e**2).mean(axis=0)) for name, e in self.errors.items()}

    @property
    def reduction(self) -> Vector:
        """Share of the first car's error that is gone with the last, shape ``(n, 3)``."""
        return self.reduction_from(next(iter(self.errors)))

    @property
    def interval(self) -> Vector:
        """Its 95 % interval, shape ``(2, n, 3)``."""
        return self.interval_from(next(iter(self.errors)))

    def reduction_from(self, name: str) -> Vector:
        """Share of a car's error that is gone with the last, shape ``(n, 3)``."""
        return np.asarray(1.0 - self.rmse[list(self.rmse)[-1]] / np.maximum(self.rmse[name], 1e-300))

    def ending_with(self, name: str) -> Improvement:
        """The same with another car of it in the place of the last."""
        last = list(self.cars)[-1]
        return replace(
            self,
            cars={**self.cars, last: self.cars[name]},
            errors={**self.errors, last: self.errors[name]},
            explained_variance={**self.explained_variance, last: self.explained_variance[name]},
        )

    def interval_from(self, name: str) -> Vector:
        """95 % interval of :meth:`reduction_from` by a bootstrap over blocks in time, shape ``(2, n, 3)``."""
        block = blocks(self.windows)
        sums = [_sums(self.errors[car] ** 2, block) for car in (name, list(self.errors)[-1])]
        rng = np.random.default_rng(self.seed)
        drawn = rng.integers(0, len(sums[0]), (_DRAWS, len(sums[0])))
        ratios = np.sqrt(sums[1][drawn].sum(axis=1) / np.maximum(sums[0][drawn].sum(axis=1), 1e-300))
        return np.asarray(1.0 - np.quantile(ratios, [0.975, 0.025], axis=0))

    def systematic_gone(self, name: str) -> Vector:
        """Share of the systematic squared error of a car that is gone with the last, shape ``(n, 3)``.

        NaN where there was next to none.
        """
        before, after = (
            np.stack([s.share for s in self.explained_variance[car]]) * self.rmse[car] ** 2
            for car in (name, list(self.errors)[-1])
        )
        there = np.stack([s.share for s in self.explained_variance[name]]) > _NEXT_TO_NONE
        return np.where(there, 1.0 - after / np.maximum(before, 1e-300), np.nan)


def measure_improvement(
    windows: SimulationWindows, cars: Mapping[str, CarEstimate], steps: int, seed: int = 0
) -> Improvement:
    """Simulates ``cars`` from every start.

    Args:
        windows: on held-out rows.
        cars: by name, what was first and what is last.
        steps: of the horizon that the diagnosis is about.
        seed: of the bootstrap over blocks in time.
    """
    ahead = sorted({1, steps, windows.steps})
    errors = {name: windows.errors(car)[:, np.array(ahead) - 1] for name, car in cars.items()}
    block = blocks(windows)
    found = {
        name: tuple(explained_variance(replace(windows, steps=k), e[:, i], block) for i, k in enumerate(ahead))
        for name, e in errors.items()
    }
    return Improvement(cars, np.array(ahead) * windows.data.T_s, ahead.index(steps), errors, found, windows, seed)


def blocks(windows: SimulationWindows) -> Indices:
    """Number of the block in time of each window, shape ``(W,)``."""
    return np.unique((windows.time // BLOCK).astype(np.intp), return_inverse=True)[1]


def _sums(values: Vector, block: Indices) -> Vector:
    out = np.zeros((block.max() + 1, *values.shape[1:]))
    np.add.at(out, block, values)
    return out
