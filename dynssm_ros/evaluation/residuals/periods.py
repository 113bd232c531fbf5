"""Patterns in time: errors that come back after a fixed time or a fixed way, and drift."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from dynssm_ros.arrays import Indices, Vector
from dynssm_ros.evaluation.residuals.errors import OneStepErrors
from dynssm_ros.evaluation.residuals.evidence import (
    block_sums,
    chances,
    limited,
    means_of_kinds,
    regression,
    share_explained,
)
from dynssm_ros.evaluation.residuals.patterns import Pattern, Picture
from dynssm_ros.signals.recording import COLUMN_UNITS

LONGEST_PERIOD_S = 2.0
"""Longest period that is looked for (s): what comes back later does so with bends and laps."""
_BEST, _AS_GOOD = 3, 0.95
"""Periods that are tested of those tried; share of the best from which on a shorter one is taken."""
_CONTINUUM = 101  # frequencies whose median is the spectrum around a line
_DRIVEN_ABOVE_S, _DRIVEN = 0.3, 12.0
"""Periods from which on, and how many times above its surroundings, a line of an input makes it the driving's."""
_HARMONICS = 3
_BESIDE = (3, 4)
"""Rows beside a lag whose correlation is that of errors that change slowly."""
_WHEEL = (0.3, 1.6)
"""Circumferences of wheels over the wheelbase: 0.6 to 0.8 of road and race cars, 1.3 of 1:43 models."""


def periods(errors: OneStepErrors, values: Vector, channel: str) -> Iterator[Pattern]:
    """Looks for periods in the errors ``values`` ``(N,)`` of a channel.

    Yields:
        The best period by the clock, of the mean and of the size of the errors; the best sine; the best by the way driven, if
        the wheelbase is known.
    """
    y = limited(values)
    yield from _clock(errors, values, y, channel)
    yield from _echo(errors, values, y, channel)
    grid = errors.number - errors.number[0]
    line = _line(y, grid.astype(np.float64), 2.0, LONGEST_PERIOD_S / errors.T_s)
    if line is not None:
        period, p = line
        if period * errors.T_s < _DRIVEN_ABOVE_S or not _is_driven(errors, grid, period):
            told = f"comes back every {period * errors.T_s:.4g} s"
            size = {"period_s": period * errors.T_s}
            yield sine(errors, values, grid / period, channel, p=p, kind="period", told=told, size=size)
    wheelbase = errors.wheelbase
    if wheelbase is not None:
        way = _way(errors)
        line = _line(y, way / (0.05 * wheelbase), _WHEEL[0] / 0.05, _WHEEL[1] / 0.05)
        if line is not None:
            length = line[0] * 0.05 * wheelbase
            told = f"comes back every {length:.3g} m of the way, as wheels turn"
            size = {"period_m": length}
            yield sine(errors, values, way / length, channel, p=line[1], kind="wheel_synchronous", told=told, size=size)


def _clock(errors: OneStepErrors, values: Vector, y: Vector, channel: str) -> Iterator[Pattern]:
    """Errors, or their size, that are different at one step of so many."""
    longest = int(LONGEST_PERIOD_S / errors.T_s)
    trials = longest * (longest + 1) // 2
    size = np.abs(y)
    size = size - size.mean()
    for kind, tested in (("period", y), ("period_of_size", size)):
        square = tested**2
        best = []
        for rows in range(2, longest + 1):
            phase = errors.number % rows
            root = np.sqrt(np.bincount(phase, square, rows))
            z = np.bincount(phase, tested, rows) / np.maximum(root, 1e-300)
            z = z if kind == "period" else np.maximum(z, 0.0)
            best.append((float(np.abs(z).max()), rows))
        strongest = sorted(best, reverse=True)[:_BEST]
        combs = [_comb(errors, values, tested, channel, kind, rows, trials) for _, rows in strongest]
        most = max(comb.share for comb in combs)
        enough = most - (1.0 - _AS_GOOD) * abs(most)  # shares by chance are negative
        yield min((comb for comb in combs if comb.share >= enough), key=lambda comb: comb.size["period_s"])


def _comb(
    errors: OneStepErrors, values: Vector, tested: Vector, channel: str, kind: str, rows: int, trials: int
) -> Pattern:  # fmt: skip
    phase, T_s = errors.number % rows, errors.T_s
    sums = block_sums(tested, errors.block, phase, rows)
    chance = chances(sums)
    if kind == "period_of_size":
        chance = np.where(sums.sum(axis=0) > 0, chance, 1.0)
    p = min(1.0, trials * float(chance.min()))
    strong = np.flatnonzero(chance < 0.05 / rows)
    peak = int(np.argmin(chance))
    members = np.isin(phase, strong)
    kinds = np.where(members, phase, rows)
    whole, apart = means_of_kinds(values, errors.block, kinds, rows + 1)
    whole[rows], apart[~members] = 0.0, 0.0
    terms, share = len(strong), share_explained(values, apart)
    every, every_apart = means_of_kinds(values, errors.block, phase, rows)
    if share_explained(values, every_apart) > share:
        whole, kinds, terms, share = every, phase, rows, share_explained(values, every_apart)
    square = np.bincount(phase, values**2, rows) / np.maximum(np.bincount(phase, minlength=rows), 1)
    unit, period = COLUMN_UNITS[channel], rows * T_s
    at = (peak * T_s) % period
    usual = float(np.sqrt(np.median(square)))
    if kind == "period":
        fitted = whole[kinds]
        told = f"{channel} errs by {whole[peak]:+.2g} {unit} every {period:.4g} s, {at:.3g} s after"
    else:
        excess = np.where(np.arange(rows) == peak, square - np.median(square), 0.0)
        share, fitted = float(np.sum(excess[phase]) / max(np.sum(values**2), 1e-300)), None
        told = (
            f"errors of {channel} are {np.sqrt(square[peak]) / max(usual, 1e-300):.2g} times larger every {period:.4g} s, "
            f"{at:.3g} s after"
        )
    steps = np.arange(rows, dtype=np.float64) * T_s
    told += " the full second" if abs(1.0 / period - round(1.0 / period)) < 1e-6 else " the first"
    return Pattern(
        channel, "time", kind, told, share, p, terms if kind == "period" else 1,
        {"period_s": round(period, 9), "phase_s": round(at, 9)}, fitted,
        Picture("comb", steps, np.sqrt(square), f"time in the period of {period:.4g} s (s)", f"RMS of {channel} ({unit})",
                None, (), (at - T_s / 2, at + T_s / 2)),
    )  # fmt: skip


def _echo(errors: OneStepErrors, values: Vector, y: Vector, channel: str) -> Iterator[Pattern]:
    """Errors that are like those a fixed time before, more than like those a little earlier or later than that."""
    grid = errors.number - errors.number[0]
    pad = int(LONGEST_PERIOD_S / errors.T_s) + _BESIDE[-1]
    dense, there = np.zeros((2, grid[-1] + 1 + pad))
    dense[grid + pad], there[grid + pad] = y, 1.0
    lags = np.arange(2 * _BESIDE[-1], int(LONGEST_PERIOD_S / errors.T_s) + 1)
    sums = np.empty((int(errors.block[-1]) + 1, len(lags)))
    for k, lag in enumerate(lags.tolist()):
        at = grid + pad - lag
        beside = [at + sign * each for each in _BESIDE for sign in (-1, 1)]
        whole = there[at] * np.prod([there[each] for each in beside], axis=0)
        contrast = dense[at] - np.mean([dense[each] for each in beside], axis=0)
        sums[:, k] = np.bincount(errors.block, y * contrast * whole)
    chance = np.where(sums.sum(axis=0) > 0, chances(sums), 1.0)
    if not len(lags):
        return
    best = int(np.argmin(chance))
    raw = np.zeros(len(dense))
    raw[grid + pad] = values
    before = raw[grid + pad - lags[best]]
    fitted, apart = regression(values, before[:, None], errors.block)
    correlation = float(np.corrcoef(values[before != 0], before[before != 0])[0, 1]) if np.any(before) else 0.0
    period = float(lags[best] * errors.T_s)
    told = f"errors of {channel} come back after {period:.4g} s (autocorrelation {correlation:.2f})"
    shown = autocorrelation(values, errors.run, int(lags[-1]))[2:]
    after = (2.0 + np.arange(len(shown), dtype=np.float64)) * errors.T_s
    mark = (period - errors.T_s / 2, period + errors.T_s / 2)
    yield Pattern(
        channel, "time", "echo", told, share_explained(values, apart), min(1.0, len(lags) * float(chance[best])), 2,
        {"period_s": round(period, 9), "autocorrelation": round(correlation, 4)}, fitted,
        Picture("lags", after, shown, "time after (s)", f"autocorrelation\nof {channel}", None, (), mark),
    )  # fmt: skip


def _line(y: Vector, place: Vector, shortest: float, longest: float) -> tuple[float, float] | None:
    """The period, in units of ``place`` ``(N,)``, whose line stands highest above the spectrum, and its chance."""
    at = np.rint(place).astype(np.intp)
    at = at - at.min()
    count = int(2 ** np.ceil(np.log2(max(at.max() + 1, 2))))
    power = np.abs(np.fft.rfft(np.bincount(at, y, count))) ** 2
    frequency = np.arange(len(power)) / count
    inside = np.flatnonzero((frequency >= 1.0 / longest) & (frequency <= 1.0 / shortest))
    if len(inside) < 2 * _CONTINUUM:
        return None
    ratio = _above(power, inside)
    best = int(np.argmax(ratio))
    return 1.0 / float(frequency[inside[best]]), min(1.0, len(inside) * float(np.exp(-ratio[best])))


def _above(power: Vector, inside: Indices) -> Vector:
    """Power at ``inside`` over that around it, by medians of neighbours."""
    half = _CONTINUUM // 2
    whole = len(power) // half
    medians = np.median(power[: whole * half].reshape(whole, half), axis=1)
    centres = half * (np.arange(whole) + 0.5)
    around = np.interp(inside, centres, medians) / np.log(2.0)
    return np.asarray(power[inside] / np.maximum(around, 1e-300))


def _is_driven(errors: OneStepErrors, grid: Indices, period: float) -> bool:
    """Whether throttle or steering have a line there too: then it comes of the driving."""
    count = int(2 ** np.ceil(np.log2(grid.max() + 1)))
    near = np.arange(-2, 3) + round(count / period)
    for column in errors.applied.T:
        change = np.diff(column, prepend=column[:1])
        power = np.abs(np.fft.rfft(np.bincount(grid, change, count))) ** 2
        if _above(power, np.clip(near, 0, len(power) - 1)).max() > _DRIVEN:
            return True
    return False


def sine(
    errors: OneStepErrors, values: Vector, turns: Vector, channel: str, *, p: float, kind: str, told: str,
    size: dict[str, float],
) -> Pattern:  # fmt: skip
    """Errors that are the same at the same part of a period; ``turns`` counts periods, ``(N,)``."""
    order = np.arange(1, _HARMONICS + 1)
    angle = 2 * np.pi * turns[:, None] * order
    fitted, apart = regression(values, np.concatenate([np.cos(angle), np.sin(angle)], axis=1), errors.block)
    phase = (turns % 1.0 * 24).astype(np.intp)
    mean, _ = means_of_kinds(values, errors.block, phase, 24)
    unit = COLUMN_UNITS[channel]
    words = f"an error of {channel} of ±{np.ptp(fitted) / 2:.2g} {unit} {told}"
    return Pattern(
        channel, "time", kind, words, share_explained(values, apart), p, 2 * _HARMONICS, size, fitted,
        Picture("comb", np.arange(24) / 24, mean, "share of the period", f"mean error of {channel} ({unit})"),
    )  # fmt: skip


def _way(errors: OneStepErrors) -> Vector:
    """Way driven until each row, gaps at the speed after them (m), shape ``(N,)``."""
    step = errors.driven[:, 0] * errors.T_s * np.diff(errors.number, prepend=errors.number[:1])
    return np.cumsum(step)


def autocorrelation(values: Vector, run: Indices, lags: int) -> Vector:
    """Correlation of errors ``(N,)`` with those so many rows before, within runs of rows, for lags 0 to ``lags``."""
    y = values - values.mean()
    total = float(y @ y) / max(len(y), 1)
    out = np.ones(lags + 1)
    for lag in range(1, min(lags, len(y) - 1) + 1):
        same = run[lag:] == run[:-lag]
        out[lag] = float(np.sum((y[lag:] * y[:-lag])[same])) / max(1, int(np.count_nonzero(same))) / max(total, 1e-300)
    return out
