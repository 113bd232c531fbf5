"""Whether a pattern is more than chance, where neighbouring errors are alike: tests over blocks of time.

Under the null hypothesis the sums of an error over blocks of a few seconds are independent and as likely positive as
negative. Their t statistic then has tails no heavier than Student's, whatever the noise within a block is like.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import stats

from dynssm_ros.arrays import Indices, Mask, Vector

FALSE_ALARMS = 0.02
"""Chance that anything at all is reported of a drive that has no pattern."""
FEWEST_BLOCKS = 8
"""Blocks of time in which something must have happened to be judged: fewer say nothing of chance."""
_FAR = 8.0
"""Robust standard deviations to which errors are limited in tests, so that one outlier does not hide a pattern."""


def limited(errors: Vector) -> Vector:
    """Errors ``(N,)`` for a test: less their median, none farther than 8 robust standard deviations from it."""
    centre = float(np.median(errors))
    spread = robust_std(errors)
    return np.clip(errors - centre, -_FAR * spread, _FAR * spread) if spread > 0 else errors - centre


def robust_std(errors: Vector) -> float:
    """Standard deviation by the median of the magnitudes."""
    return float(np.median(np.abs(errors - np.median(errors)))) / 0.6745


def block_sums(values: Vector, block: Indices, kind: Indices, kinds: int) -> Vector:
    """Sums of ``values`` ``(N,)`` by block and kind, shape ``(blocks, kinds)``."""
    blocks = int(block[-1]) + 1
    found = np.bincount(block * kinds + kind, values, blocks * kinds)
    return np.asarray(found, np.float64).reshape(blocks, kinds)


def sums_of_blocks(values: Vector, block: Indices) -> Vector:
    """Sums of ``values`` ``(N,)`` by block, shape ``(blocks,)``."""
    return np.asarray(np.bincount(block, values), np.float64)


def chances(sums: Vector) -> Vector:
    """Two-sided chance of means as far from zero as of the columns of ``sums`` ``(blocks, kinds)``, shape ``(kinds,)``."""
    there = np.count_nonzero(sums, axis=0)
    root = np.sqrt((sums**2).sum(axis=0))
    z = np.divide(sums.sum(axis=0), root, out=np.zeros(sums.shape[1]), where=root > 0)
    left = np.maximum(there - z**2, 1e-12)
    t = z * np.sqrt(np.maximum(there - 1, 0) / left)
    found = 2.0 * stats.t.sf(np.abs(t), np.maximum(there - 1, 1))
    return np.where(there >= FEWEST_BLOCKS, found, 1.0)


def share_explained(errors: Vector, fitted: Vector) -> float:
    """Share of the squared ``errors`` ``(N,)`` that ``fitted`` takes away; negative where it adds to them."""
    total = float(np.sum(errors**2))
    return 1.0 - float(np.sum((errors - fitted) ** 2)) / total if total > 0 else 0.0


def means_of_kinds(errors: Vector, block: Indices, kind: Indices, kinds: int) -> tuple[Vector, Vector]:
    """Mean error of each kind ``(kinds,)``, and the means of the other half of the blocks at each row ``(N,)``.

    The second is fitted to even blocks where it is for odd ones, and the other way round: what it explains is no chance.
    """
    half = block % 2
    total = np.stack([np.bincount(kind[half == h], errors[half == h], kinds) for h in (0, 1)])
    count = np.stack([np.bincount(kind[half == h], minlength=kinds) for h in (0, 1)])
    apart = total / np.maximum(count, 1)
    whole = total.sum(axis=0) / np.maximum(count.sum(axis=0), 1)
    return whole, apart[1 - half, kind]


def regression(errors: Vector, columns: Vector, block: Indices) -> tuple[Vector, Vector]:
    """Least squares of errors ``(N,)`` on ``columns`` ``(N, k)``: fitted to all, and to the other half of the blocks."""
    half = block % 2

    def weights(rows: Mask) -> Vector:
        X = columns[rows]
        return np.linalg.solve(X.T @ X + 1e-9 * np.eye(X.shape[1]) * (np.trace(X.T @ X) + 1e-300), X.T @ errors[rows])

    apart = np.empty_like(errors)
    for h in (0, 1):
        apart[half == h] = columns[half == h] @ weights(half != h)
    return columns @ weights(np.ones(len(errors), bool)), apart


def holm(p_values: Sequence[float], level: float) -> list[bool]:
    """Which of several null hypotheses are rejected so that any is wrongly with at most the chance ``level`` (Holm 1979)."""
    order = np.argsort(p_values)
    rejected = [False] * len(p_values)
    for rank, k in enumerate(order):
        if p_values[k] > level / (len(p_values) - rank):
            break
        rejected[k] = True
    return rejected
