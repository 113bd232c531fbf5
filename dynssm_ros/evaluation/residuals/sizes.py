"""Patterns in size: rare large errors, and signals that move in steps, repeat or stand at their end."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy import optimize, stats

from dynssm_ros.arrays import Indices, Mask, Vector
from dynssm_ros.evaluation.regimes import round_edges
from dynssm_ros.evaluation.residuals.errors import DRIVEN_SIGNALS, OneStepErrors
from dynssm_ros.evaluation.residuals.evidence import limited, robust_std
from dynssm_ros.evaluation.residuals.patterns import Pattern, Picture
from dynssm_ros.evaluation.residuals.periods import LONGEST_PERIOD_S
from dynssm_ros.signals.recording import COLUMN_UNITS, Recording
from dynssm_ros.signals.signal_map import STATE_SIGNALS

WORST = 0.01
"""Share of the rows whose share of the squared error is told: 8 % of normal errors, whose squares are so distributed."""
_SPIKE = 5.0  # local standard deviations from which on an error is a spike
_BY_CHANCE = 2.0 * float(stats.norm.sf(4.3))
"""Chance of one in a row: that of 4.3 deviations, since the local deviation is known to some 10 % only."""
_SURE, _FEWEST_SPIKES = 1e-6, 6  # chance below which speeds of large errors are told; spikes that may have a period
_APART_S = 0.1  # spikes nearer to each other are one event
_CLUSTERED = 2.0  # times more large errors than on average, from which on a speed is named
_SPEEDS, _WIDEST = 30, 4  # bins of speed in which large errors are counted; most that are named as one range
_LEVELS, _HELD, _ON_STEPS = 400, 0.2, 0.98
"""Most values of a signal in steps; share of its rows that keep the value before; share of levels that are whole steps."""
_REPEATED = 0.02  # share of rows
_END_ROWS, _AT_END = (
    5,
    0.003,
)  # rows in a row at the end of the range, and their share, from which on a signal is clipped


def statistics(values: Vector) -> dict[str, float]:
    """Of errors ``(N,)``: root mean square, mean, kurtosis beyond the normal's, share in the worst 1 % of the rows."""
    square = values**2
    worst = np.sort(square)[-max(1, round(WORST * len(square))) :]
    total = max(float(square.sum()), 1e-300)
    return {
        "rmse": float(np.sqrt(square.mean())),
        "mean": float(values.mean()),
        "kurtosis": float(stats.kurtosis(values)) if values.std() > 0 else 0.0,
        "share_in_worst_percent": float(worst.sum()) / total,
    }


def spikes(errors: OneStepErrors, values: Vector, c: int, slopes: Vector | None) -> Iterator[Pattern]:
    """Looks for rare errors that are far larger than those around them, and for the speeds and the period at which they come.

    Args:
        errors: of the model.
        values: its errors in channel ``c``, less the patterns found before, ``(N,)``.
        c: number of the channel.
        slopes: how the predicted state depends on the last row's signals, ``(N, 3, 5)``, if it is known.
    """
    channel, deviation = STATE_SIGNALS[c], _deviation(errors, values, c, slopes)
    far = np.abs(values - np.median(values)) > _SPIKE * deviation
    at = errors.seconds[far]
    events = int(np.count_nonzero(np.diff(at, prepend=-np.inf) > _APART_S))
    p = float(stats.poisson.sf(events - 1, len(values) * _BY_CHANCE)) if events else 1.0
    share = float(np.sum(values[far] ** 2) / max(np.sum(values**2), 1e-300))
    rows, unit = float(np.mean(far)), COLUMN_UNITS[channel]
    worst = np.abs(values) >= np.sort(np.abs(values))[-max(1, round(WORST * len(values)))]
    speeds = speeds_of(errors, worst) if p < _SURE else ()
    where = f", most at {_listed(speeds)} m/s" if speeds else ""
    lasted = errors.seconds[-1] - errors.seconds[0]
    told = (
        f"{events} spikes of {channel} in {lasted:.0f} s: {100 * rows:.2g} % of the rows hold "
        f"{100 * share:.0f} % of the squared error{where}"
    )
    size = {"events": events, "rows": round(rows, 6), "speeds": [list(each) for each in speeds]}
    edges, kind = _by_speed(errors)
    by_speed = 100 * np.bincount(kind[far], values[far] ** 2, len(edges) - 1) / max(float(np.sum(values**2)), 1e-300)
    drawn = Picture("bins", edges, by_speed, "speed (m/s)", f"% of the squared error\nof {channel} in spikes ({unit})")
    yield Pattern(channel, "size", "spikes", told, share, p, 1, size, None, drawn)
    yield from _spike_period(errors, values, channel, np.flatnonzero(far))


def _listed(speeds: tuple[tuple[float, float], ...]) -> str:
    return ", ".join(f"{low:g} to {high:g}" for low, high in speeds)


def _deviation(errors: OneStepErrors, values: Vector, c: int, slopes: Vector | None) -> Vector:
    """Robust standard deviation around each row, at least half of that of all, ``(N,)``.

    Within a few seconds it is that of the noise of the sensors: an error is the noise of the measured state less that of the
    state before, times how the prediction depends on it, which differs much where tyres slide.
    """
    noise = np.ones(len(values))
    if slopes is not None:
        squares = np.column_stack([np.ones(len(values)), slopes[:, c, : len(STATE_SIGNALS)] ** 2])
        size = squares.mean(axis=0)
        weights = optimize.nnls((squares / size)[:: max(1, len(values) // 5000)],
                                limited(values)[:: max(1, len(values) // 5000)] ** 2)[0]  # fmt: skip
        noise = np.sqrt(np.maximum(squares / size @ weights, 1e-300))
    even = values / noise
    edges = np.flatnonzero(np.diff(errors.block)) + 1
    starts, ends = np.append(0, edges), np.append(edges, len(values))
    blocks = len(starts)
    local = np.array([robust_std(even[starts[max(b - 1, 0)] : ends[min(b + 1, blocks - 1)]]) for b in range(blocks)])
    deviation: Vector = np.maximum(local, 0.5 * robust_std(even))[errors.block] * noise
    return deviation


def _by_speed(errors: OneStepErrors) -> tuple[Vector, Indices]:
    v_x = errors.driven[:, 0]
    edges = round_edges(float(v_x.min()), float(v_x.max()), _SPEEDS)
    return edges, np.clip(np.digitize(v_x, edges) - 1, 0, len(edges) - 2)


def speeds_of(errors: OneStepErrors, large: Mask) -> tuple[tuple[float, float], ...]:
    """Ranges of speed in which large errors come more often than elsewhere; none if the strongest may be chance.

    The strongest is named first, then those that do not overlap with what is named.
    """
    edges, kind = _by_speed(errors)
    kinds = len(edges) - 1
    at = np.flatnonzero(large)
    events = at[np.diff(errors.seconds[at], prepend=-np.inf) > _APART_S]
    count = np.bincount(kind[events], minlength=kinds)
    usual = np.bincount(kind, minlength=kinds) / len(kind)
    ranges = [(low, low + width) for width in range(1, _WIDEST + 1) for low in range(kinds - width + 1)]
    within, expected = (np.array([x[low:high].sum() for low, high in ranges]) for x in (count, usual))
    chance = np.where(
        within > _CLUSTERED * expected * len(events), stats.binom.sf(within - 1, len(events), expected), 1.0
    )
    named, bins = np.zeros(kinds, bool), np.arange(kinds)
    if chance.min() * len(ranges) < 0.01:
        for k in np.argsort(chance)[: np.count_nonzero(chance < 0.01)].tolist():
            inside = (bins >= ranges[k][0]) & (bins < ranges[k][1])
            named |= inside & (not named[inside].any())
    ends = np.flatnonzero(np.diff(np.pad(named, 1).astype(np.int8)))
    return tuple((float(edges[low]), float(edges[high])) for low, high in zip(ends[::2], ends[1::2], strict=True))


def _spike_period(errors: OneStepErrors, values: Vector, channel: str, at: Indices) -> Iterator[Pattern]:
    """Looks for the fixed period at one step of which the spikes ``at`` gather, by the count at that step."""
    longest = int(LONGEST_PERIOD_S / errors.T_s)
    if len(at) < _FEWEST_SPIKES:
        return
    best = (1.0, 2, 0)
    for rows in range(2, longest + 1):
        count = np.bincount(errors.number[at] % rows, minlength=rows)
        phase = int(np.argmax(count))
        best = min(best, (float(stats.binom.sf(count[phase] - 1, len(at), 1.0 / rows)), rows, phase))
    p, rows, phase = best
    members = errors.number % rows == phase
    square, unit, period = values**2, COLUMN_UNITS[channel], rows * errors.T_s
    share = (float(square[members].sum()) - float(square[~members].sum()) / (rows - 1)) / max(
        float(square.sum()), 1e-300
    )
    gathered = int(np.count_nonzero(members[at]))
    told = f"{gathered} of {len(at)} spikes of {channel} come at one step of every {period:.4g} s"
    of_phase = np.bincount(errors.number % rows, square, rows) / np.maximum(
        np.bincount(errors.number % rows, minlength=rows), 1
    )
    steps = np.arange(rows, dtype=np.float64) * errors.T_s
    shown = Picture("comb", steps, np.sqrt(of_phase), "time in the period (s)", f"RMS of {channel} ({unit})")
    trials = longest * (longest + 1) // 2
    yield Pattern(channel, "time", "period_of_spikes", told, share, min(1.0, trials * p), 1,
                  {"period_s": round(period, 9), "phase_s": round(phase * errors.T_s, 9)}, None, shown)  # fmt: skip


def signal_faults(errors: OneStepErrors, slopes: Vector | None) -> Iterator[Pattern]:
    """Signals in steps, samples that repeat, and states at the end of their range.

    Args:
        errors: of the model.
        slopes: how the predicted state depends on the last row's signals, ``(N, 3, 5)``; without them steps are not judged.
    """
    effect = {}
    if slopes is not None:
        mean_square = np.maximum((errors.values**2).mean(axis=0), 1e-300)
        effect = dict(zip(DRIVEN_SIGNALS, ((slopes**2).mean(axis=0) / mean_square[:, None]).T, strict=True))
    log = errors.recording
    for name in DRIVEN_SIGNALS:
        step = quantum(log[name])
        if step > 0 and name in effect:
            for c, channel in enumerate(STATE_SIGNALS):
                share = min(1.0, float(effect[name][c]) * step**2 / 12.0)
                told = (
                    f"{name} moves in steps of {step:.3g} {COLUMN_UNITS[name]}: its rounding makes {_percent(share)} "
                    f"of the squared error of {channel}"
                )
                levels = np.unique(log[name])
                shown = Picture(
                    "levels", np.arange(min(len(levels), 60.0)), levels[:60], "level", f"{name} ({COLUMN_UNITS[name]})"
                )
                yield Pattern(
                    channel, "size", "quantised", told, share, 0.0, 1, {"signal": name, "step": step}, None, shown
                )
    for c, channel in enumerate(STATE_SIGNALS):
        square = errors.values[:, c] ** 2
        total = max(float(square.sum()), 1e-300)
        for kind, where, told in (
            ("repeated", _repeated(log, channel), "repeats the sample before"),
            ("clipped", _at_end(log, channel), "stands at the end of its range"),
        ):
            members = where[errors.rows + 1]
            if members.any():
                share = max(0.0, float(square[members].sum()) / total - float(members.mean()))
                words = (
                    f"{channel} {told} in {100 * members.mean():.2g} % of the rows, which hold {_percent(share)} more "
                    "of its squared error"
                )
                yield Pattern(channel, "size", kind, words, share, 0.0, 1, {"rows": float(members.mean())})


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %"


def quantum(values: Vector) -> float:
    """The step in which a signal ``(N,)`` moves, 0 if it moves freely or hardly."""
    same = np.diff(values) == 0
    held = np.unique(values[1:][same])
    if same.mean() < _HELD or not 4 <= len(held) <= _LEVELS:
        return 0.0
    gaps = np.diff(held)
    gaps = gaps[gaps > 1e-9 * max(float(np.abs(held).max()), 1e-9)]
    step = float(gaps.min()) if len(gaps) else 0.0
    if step <= 0:
        return 0.0
    multiples = (held - held[0]) / step
    step *= float(multiples[-1] / max(round(multiples[-1]), 1))
    off = np.abs((held - held[0]) / step - np.rint((held - held[0]) / step))
    return step if np.mean(off < 0.05) >= _ON_STEPS else 0.0


def _repeated(log: Recording, channel: str) -> Mask:
    """Rows of a moving car in which a state is exactly that of the row before, if there are many, ``(M,)``."""
    others = [log[name] for name in STATE_SIGNALS if name != channel]
    moving = np.any([np.diff(other, prepend=np.nan) != 0 for other in others], axis=0)
    same = (np.diff(log[channel], prepend=np.nan) == 0) & moving & (np.abs(log["v_x"]) > 1e-3)
    return same if same.mean() > _REPEATED else np.zeros(len(log), bool)


def _at_end(log: Recording, channel: str) -> Mask:
    """Rows in which a state stays exactly at its largest or least value, if these are many, ``(M,)``."""
    values, out = log[channel], np.zeros(len(log), bool)
    for end in (values.max(), values.min()):
        at = values == end
        run = np.convolve(at, np.ones(_END_ROWS), mode="same") >= _END_ROWS - 0.5
        if end != 0 and run.mean() > _AT_END / 2:
            out |= at
    return out
