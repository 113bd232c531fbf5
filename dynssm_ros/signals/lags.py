"""By how much a signal comes before or after the response that it must cause, with an interval.

For each lag a linear model of the response is fitted with the signal at that lag. The lag whose model explains most is
found, and its interval by the bootstrap over blocks of time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dynssm_ros.arrays import Indices, Mask, Vector
from dynssm_ros.signals.spans import BLOCKS, Drive, blocks

LONGEST_LAG_S = 10.0
_STEP_S = 0.1
"""Of the lags that are tried; between them a parabola goes through the best three."""
_DRAWS = 80
_CONTENDING = 0.3
"""Share less than the best, up to which a lag may win in a drawn drive."""
_LEAST_ROWS = 100  # steps, at every lag
_SHARE_OF_ROWS = 0.5
"""Of a drive that a lag must leave, so that different lags see much the same of it."""
_USUAL_SHARE = 0.25  # of a drive, up to which lags are tried
_RIDGE = 1e-8


@dataclass(frozen=True)
class Lag:
    """How late a response is.

    Attributes:
        value: seconds from the signal to its response; negative where the response comes first.
        low, high: its 95 % interval.
        share: of the response's variance that is explained at this lag, beyond what explains it without the signal.
        near: the largest such share at a lag that is expected.
    """

    value: float
    low: float
    high: float
    share: float
    near: float


def lag_of(
    drive: Drive, response: Vector, signal: Vector, known: Vector, *, factors: Vector, expected: tuple[float, float],
    longest: float = LONGEST_LAG_S,
) -> Lag | None:  # fmt: skip
    """Finds the lag of ``response`` behind ``signal``.

    Args:
        drive: whose rows these are.
        response: what the signal causes, ``(N,)``; NaN in rows that do not count.
        signal: terms that come from the signal alone and move with the lag, ``(N, k)``.
        known: what else explains the response, at its own time, ``(N, m)``.
        factors: of the terms at the time of the response, ``(N, k)``.
        expected: lags (s) that a car may have.
        longest: lag that is tried (s), as far as the drive is four times as long, or twice for more than the usual.

    Returns:
        ``None`` where too little was driven.
    """
    step = max(1, round(_STEP_S / drive.T_s))
    rows = _decimated(drive.segment, step)
    share = _USUAL_SHARE if longest <= LONGEST_LAG_S else _SHARE_OF_ROWS
    most = round(min(longest, share * len(rows) * step * drive.T_s) / (step * drive.T_s))
    lags = np.arange(-most, most + 1)
    seconds = np.asarray(lags * (step * drive.T_s), np.float64)
    usable = np.flatnonzero(np.isfinite(response[rows]))
    block = blocks(len(rows))
    terms = known.shape[1] + signal.shape[1] + 1
    grams = np.zeros((len(lags), BLOCKS, terms, terms))
    counts = np.zeros(len(lags))
    scale = np.nanstd(response[rows]) or 1.0
    for number, lag in enumerate(lags.tolist()):
        before = usable - lag
        inside = (before >= 0) & (before < len(rows))
        at, before = usable[inside], before[inside]
        same = drive.segment[rows[at]] == drive.segment[rows[before]]
        at, before = at[same], before[same]
        counts[number] = len(at)
        columns = [known[rows[at]], signal[rows[before]] * factors[rows[at]], response[rows[at], None] / scale]
        _add_grams(grams[number], np.concatenate(columns, axis=1), block[at])
    enough = (counts >= _LEAST_ROWS) & (counts >= _SHARE_OF_ROWS * counts.max(initial=0))
    near = enough & (seconds >= expected[0] - 1e-9) & (seconds <= expected[1] + 1e-9)
    if not near.any():
        return None
    shares = np.where(enough, _shares(grams.sum(axis=1), known.shape[1]), -np.inf)
    best = int(np.argmax(shares))
    near_best = _around(shares > shares[best] - _CONTENDING)
    drawn = _bootstrap(grams[near_best], enough[near_best], known.shape[1], seconds[near_best])
    low, high = np.percentile(drawn, [2.5, 97.5])
    value = _refined(shares, best, seconds)
    half = step * drive.T_s / 2
    return Lag(value, min(float(low), value - half), max(float(high), value + half), float(shares[best]),
               float(shares[near].max()))  # fmt: skip


def _around(which: Mask) -> Mask:
    """Those, and their neighbours."""
    return np.convolve(which, [1, 1, 1], mode="same") > 0


def _decimated(segment: npt.NDArray[np.int32], step: int) -> Indices:
    """Every ``step``-th row of each segment."""
    first = np.flatnonzero(np.diff(segment, prepend=-1))
    since = np.arange(len(segment)) - np.repeat(first, np.diff(np.append(first, len(segment))))
    return np.flatnonzero(since % step == 0)


def _add_grams(out: Vector, columns: Vector, block: Indices) -> None:
    """Adds the products of the columns by block; rows are in the order of blocks."""
    edges = np.searchsorted(block, np.arange(BLOCKS + 1))
    for number in range(BLOCKS):
        part = columns[edges[number] : edges[number + 1]]
        out[number] += part.T @ part


def _shares(grams: Vector, known: int) -> Vector:
    """Share of what ``known`` columns leave of the last one that the columns between explain, ``(...)``."""
    left_by_known = _left(grams, known)
    return np.asarray(1.0 - _left(grams, grams.shape[-1] - 1) / np.maximum(left_by_known, 1e-300))


def _left(grams: Vector, count: int) -> Vector:
    """Sum of squares of the last column that the first ``count`` ones leave."""
    total = grams[..., -1, -1]
    inner = grams[..., :count, :count]
    size = np.sqrt(np.maximum(np.einsum("...ii->...i", inner), 1e-100))
    scaled = inner / (size[..., :, None] * size[..., None, :]) + _RIDGE * np.eye(count)
    across = grams[..., :count, -1] / size
    solved = np.linalg.solve(scaled, across[..., None])[..., 0]
    return np.asarray(np.maximum(total - (across * solved).sum(axis=-1), 0.0))


def _bootstrap(grams: Vector, enough: Mask, known: int, seconds: Vector) -> Vector:
    """Lags of drives that are drawn from the blocks."""
    rng = np.random.default_rng(0)
    drawn = np.empty(_DRAWS)
    for k in range(_DRAWS):
        weight = np.bincount(rng.integers(0, BLOCKS, BLOCKS), minlength=BLOCKS).astype(np.float64)
        shares = np.where(enough, _shares(np.einsum("b,lbij->lij", weight, grams), known), -np.inf)
        drawn[k] = _refined(shares, int(np.argmax(shares)), seconds)
    return drawn


def _refined(shares: Vector, best: int, seconds: Vector) -> float:
    """The top of the parabola through the best lag and its neighbours."""
    if 0 < best < len(shares) - 1 and np.isfinite(shares[best - 1 : best + 2]).all():
        before, at, after = shares[best - 1 : best + 2]
        bent = before - 2 * at + after
        if bent < 0:
            return float(seconds[best] + 0.5 * (before - after) / bent * (seconds[1] - seconds[0]))
    return float(seconds[best])
