"""One measure over several seeds: mean and standard deviation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dynssm_ros.arrays import Vector


@dataclass(frozen=True)
class SeedSpread:
    """Mean and sample standard deviation of a number that was measured with ``n`` seeds; 0 for a single one."""

    mean: float
    std: float
    n: int


def mean_and_std(values: Sequence[Vector]) -> tuple[Vector, Vector]:
    """Mean and sample standard deviation over ``values``, entry by entry; a single one has no spread."""
    stacked = np.stack(values)
    with np.errstate(over="ignore", invalid="ignore"):  # a run that diverged has no finite mean
        spread = stacked.std(axis=0, ddof=1) if len(stacked) > 1 else np.zeros_like(stacked[0])
        return stacked.mean(axis=0), spread


def spreads(values: Sequence[Vector]) -> list[SeedSpread]:
    """A :class:`SeedSpread` for each entry of the arrays ``values``, one array per seed."""
    mean, std = mean_and_std(values)
    return [SeedSpread(float(m), float(s), len(values)) for m, s in zip(mean.ravel(), std.ravel(), strict=True)]
