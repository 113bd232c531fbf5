"""What an extended car improves on laps that neither the fit nor the selection saw."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from dynssm_ros.arrays import Indices, Vector, sums_by
from dynssm_ros.identification import tuning
from dynssm_ros.identification.problem.car import CarEstimate
from dynssm_ros.identification.problem.windows import SimulationWindows
from dynssm_ros.identification.result.residuals import ExplainedVariance, explained_variance


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
    """

    cars: Mapping[str, CarEstimate]
    horizons: Vector
    horizon: int
    errors: Mapping[str, Vector]
    explained_variance: Mapping[str, tuple[ExplainedVariance, ...]]
    windows: SimulationWindows

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

    @cached_property
    def is_noticed(self) -> bool:
        """Whether the last car errs noticeably less than the first at the horizon of the diagnosis."""
        first, *_, last = (errors[:, self.horizon] for errors in self.errors.values())
        return is_noticed(self.reduction[self.horizon], self.interval[:, self.horizon], mean_reduction(first, last))

    def reduction_from(self, name: str) -> Vector:
        """Share of a car's error that is gone with the last, shape ``(n, 3)``."""
        return np.asarray(1.0 - self.rmse[list(self.rmse)[-1]] / np.maximum(self.rmse[name], 1e-300))

    def ending_with(self, name: str) -> Improvement:
        """The same with another car of it in the place of the last."""
        last = list(self.cars)[-1]
        by_car = {field: getattr(self, field) for field in ("cars", "errors", "explained_variance")}
        changed: dict[str, Any] = {field: {**cars, last: cars[name]} for field, cars in by_car.items()}
        return replace(self, **changed)

    def interval_from(self, name: str) -> Vector:
        """95 % interval of :meth:`reduction_from` by a bootstrap over blocks in time, shape ``(2, n, 3)``."""
        return reduction_interval(self.errors[name], self.errors[list(self.errors)[-1]], self.windows.block)

    @cached_property
    def persistence(self) -> Vector:
        """Root mean square of the measured changes, ``(n, 3)``: what a prediction errs by that nothing changes."""
        ahead = np.round(self.horizons / self.windows.data.T_s).astype(int)
        now = self.windows.data.rows[:3, self.windows.starts].T[:, None]
        return np.asarray(np.sqrt(((self.windows.target[:, ahead - 1] - now) ** 2).mean(axis=0)))

    def systematic_gone(self, name: str) -> Vector:
        """Share of the systematic squared error of a car that is gone with the last; NaN where there was next to none.

        Shape ``(n, 3)``.
        """
        shares = [np.stack([s.share for s in self.explained_variance[car]]) for car in (name, list(self.errors)[-1])]
        before, after = shares[0] * self.rmse[name] ** 2, shares[1] * self.rmse[list(self.errors)[-1]] ** 2
        return np.where(shares[0] > tuning.NEGLIGIBLE_SHARE, 1.0 - after / np.maximum(before, 1e-300), np.nan)


def reduction_interval(before: Vector, after: Vector, block: Indices) -> Vector:
    """95 % interval of the share of the RMSE that is gone, by a bootstrap over blocks in time, shape ``(2, ..., 3)``.

    Args:
        before: errors of windows, ``(W, ..., 3)``.
        after: errors of the same windows with what takes them away.
        block: number of the block in time of each window, shape ``(W,)``.
    """
    sums = [sums_by(block, errors**2) for errors in (before, after)]
    drawn = np.random.default_rng(0).integers(0, len(sums[0]), (tuning.DRAWS, len(sums[0])))
    squared = [each[drawn].sum(axis=1) for each in sums]
    ratios = np.sqrt(squared[1] / np.maximum(squared[0], 1e-300))
    return np.asarray(1.0 - np.quantile(ratios, [0.975, 0.025], axis=0))


def channel_reduction(before: Vector, after: Vector) -> Vector:
    """Share of the RMSE that is gone, by channel, ``(3,)``; errors of the same windows, each ``(W, 3)``."""
    squared = (after**2).sum(axis=0) / np.maximum((before**2).sum(axis=0), 1e-300)
    return np.asarray(1.0 - np.sqrt(squared))


def is_noticed(share: Vector, interval: Vector, mean: float) -> bool:
    """Whether the errors of a channel surely fall by a share that counts, and those of all in the mean.

    Args:
        share: as :func:`channel_reduction`.
        interval: as :func:`reduction_interval`.
        mean: as :func:`mean_reduction`.
    """
    return mean > 0.0 and bool(((share > tuning.NOTICEABLE_SHARE) & (interval[0] > 0.0)).any())


def mean_reduction(before: Vector, after: Vector) -> float:
    """Share of the RMSE that is gone, as a mean of the channels; errors of the same windows, each ``(W, 3)``."""
    left = (after**2).mean(axis=0) / np.maximum((before**2).mean(axis=0), 1e-300)
    return float(1.0 - np.sqrt(left.mean()))


def measure_improvement(windows: SimulationWindows, cars: Mapping[str, CarEstimate], steps: int) -> Improvement:
    """Simulates ``cars`` from every start.

    Args:
        windows: on held-out rows.
        cars: by name, what was first and what is last.
        steps: of the horizon that the diagnosis is about.
    """
    ahead = sorted({1, steps, windows.steps})
    errors = {name: windows.errors(car)[:, np.array(ahead) - 1] for name, car in cars.items()}
    found = {
        name: tuple(explained_variance(replace(windows, steps=k), e[:, i], windows.block) for i, k in enumerate(ahead))
        for name, e in errors.items()
    }
    return Improvement(cars, np.array(ahead) * windows.data.T_s, ahead.index(steps), errors, found, windows)
