"""Patterns of the errors at the horizon of a diagnosis: what single steps hide in noise stands out half a second ahead.

A force of 0.3 m/s² is a hundredth of the squared error of a step of 20 ms, and most of that after half a second. Errors of
simulations from measured rows are sorted by what was going on half the way, as those of single steps are, and by how long it
had been going on. Beside these are looked for a swing that is not of the driving, for what changes with time, and for an
answer to inputs that the car does not have: the error goes with how the input changes.

A pattern counts by what it takes off blocks of time to which it was not fitted, nor to those beside them: errors of a missing
force last for seconds.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from dynssm_ros.arrays import Indices, Vector
from dynssm_ros.evaluation.regimes import COASTING
from dynssm_ros.evaluation.residuals.errors import OneStepErrors
from dynssm_ros.evaluation.residuals.evidence import limited, sums_of_blocks
from dynssm_ros.evaluation.residuals.patterns import Pattern, Picture
from dynssm_ros.evaluation.residuals.periods import sine
from dynssm_ros.evaluation.residuals.regimes import (
    Situation,
    bends,
    crossed,
    lasting,
    regimes,
    situations,
)
from dynssm_ros.identification import tuning
from dynssm_ros.identification.problem.car import CarEstimate
from dynssm_ros.identification.problem.windows import SimulationWindows
from dynssm_ros.signals.recording import COLUMN_UNITS, Recording
from dynssm_ros.signals.signal_map import STATE_SIGNALS
from dynssm_ros.track.lines import Line

_APART_S = 0.08  # between simulations: errors that start closer together are nearly the same
_SMOOTH_S = 0.2  # over which the lateral acceleration is averaged, so that its noise ends no bend
_MOST = 3  # patterns of a channel
_AS_GOOD = 0.9  # of the largest share, from which on the pattern with the fewest fitted numbers is taken
_STANDARD_ERRORS, _OF_BLOCKS = 2.0, 0.6  # of what a pattern takes off; share of the blocks in which it takes any
_PERIODS_S = (1.0, 12.0)  # of swings: longer ones are few in a drive of minutes
_OVERSAMPLED = 4  # frequencies tried for each that a drive tells apart
_FINER = 41  # between those beside the best, that are tried then
_AROUND = 12  # of those that it tells apart, to each side: the surroundings of a line
_BY_CHANCE = 1e-4  # that the highest line of a spectrum is as high
_DRIVEN = (
    4.0  # times as far above its surroundings as any line of the driving: an answer to that would be as far at most
)
_FAR = 4.0  # standard deviations, from which on a change of an input counts no more


def patterns_ahead(
    windows: SimulationWindows, car: CarEstimate, log: Recording, line: Line | None
) -> tuple[Pattern, ...]:
    """Patterns of the errors of a car at the end of the simulations, the largest share first.

    Args:
        windows: simulations of the fit.
        car: that is looked at.
        log: the recording whose rows are simulated.
        line: closed line along which the place on the lap is counted; ``None`` without one.
    """
    errors = errors_ahead(windows, car, log, line)
    sorted_by = [*situations(errors), *_beside(errors)]
    found = [each for c in range(len(STATE_SIGNALS)) for each in _largest_first(errors, c, sorted_by)]
    return tuple(sorted(found, key=lambda each: -each.share))


def errors_ahead(windows: SimulationWindows, car: CarEstimate, log: Recording, line: Line | None) -> OneStepErrors:
    """Errors at the end of simulations that overlap, at the rows half the way."""
    apart, first = max(1, round(_APART_S / windows.data.T_s)), windows.starts
    follow = np.isin(first + windows.steps, first)  # what lies between is of the fit too
    between = first[follow][:, None] + np.arange(0, windows.steps, apart)
    starts = np.unique(np.concatenate([first, between.ravel()]))
    ends = replace(windows, starts=starts).errors(car)[:, -1]
    vehicle = car.vehicle
    return OneStepErrors(vehicle.name, log, starts + windows.steps // 2, ends, line, vehicle.constants.wheelbase)


def _beside(errors: OneStepErrors) -> Iterator[Situation]:
    """By pedal and bend, and by how long the car had been in a bend, on the throttle, on the brakes."""
    log = errors.recording
    width = max(1, round(_SMOOTH_S / log.T_s))
    lateral = np.convolve(log["v_x"] * log["omega"], np.full(width, 1.0 / width), mode="same")
    bend, words = bends(lateral), ("in right bends", "on straights", "in left bends")
    yield lasting(errors, "in the bend", bend != 1, np.sign(lateral))
    if log.info.set_point == "throttle":
        r = errors.inputs["throttle"]
        yield lasting(errors, "under throttle", r > COASTING)
        yield lasting(errors, "under braking", r < -COASTING)
        pedal = np.digitize(r, [-COASTING, np.nextafter(COASTING, 1.0)])[errors.rows]
        pedals = Situation("pedal", pedal, ("under braking", "coasting", "under throttle"))
        yield crossed("pedal and bend", pedals, bend[errors.rows], words)


def _largest_first(errors: OneStepErrors, c: int, sorted_by: list[Situation]) -> list[Pattern]:
    """Patterns of a channel that are taken off one after the other."""
    values = limited(errors.values[:, c])
    total, found = float(np.sum(values**2)), list[Pattern]()
    for _ in range(_MOST):
        left = float(np.sum(values**2)) / total
        looked = [replace(each, share=left * each.share) for each in _tried(errors, values, c, sorted_by)]
        sure = [each for each in looked if each.share >= LEAST_SHARE]
        if not sure:
            break
        most = max(each.share for each in sure)
        best = min((each for each in sure if each.share >= _AS_GOOD * most), key=lambda each: each.terms)
        assert best.fitted is not None
        found.append(best)
        values = values - best.fitted
    return found


LEAST_SHARE = 1.0 - (1.0 - tuning.NOTICEABLE_SHARE) ** 2
"""Of a channel's squared error, from which on a pattern is told: a noticeable part of the error."""


def _tried(errors: OneStepErrors, values: Vector, c: int, sorted_by: list[Situation]) -> Iterator[Pattern]:
    """Patterns that hold on blocks to which they were not fitted."""
    channel = STATE_SIGNALS[c]
    told = regimes(errors, values, channel, sorted_by, ahead=True)
    for each, pattern in zip(sorted_by, told, strict=True):
        kinds = np.arange(len(each.labels))
        columns = (each.kind[:, None] == kinds) * (1.0 if each.sign is None else each.sign[:, None])
        yield from _held(errors, values, pattern, columns)
    yield from _drifts(errors, values, channel)
    yield from _swings(errors, values, channel)
    yield from _answers(errors, values, channel)


def _held(errors: OneStepErrors, values: Vector, pattern: Pattern, columns: Vector) -> Iterator[Pattern]:
    """The pattern with what ``columns`` ``(N, k)`` take off, if it does so surely and in most blocks."""
    block = errors.block
    whole, apart = _fit(values, columns, block)
    gain = sums_of_blocks(values**2 - (values - apart) ** 2, block)
    gain = gain[gain != 0.0]
    share = float(gain.sum() / np.sum(values**2))
    sure = gain.sum() > _STANDARD_ERRORS * np.sqrt((gain**2).sum())
    if sure and np.mean(gain > 0.0) >= _OF_BLOCKS:
        yield replace(pattern, share=share, fitted=whole)


def _fit(values: Vector, columns: Vector, block: Indices) -> tuple[Vector, Vector]:
    """Least squares on ``columns`` ``(N, k)``, with as much weight on 0 as half a block has.

    Returns:
        What is fitted to all, and to all blocks but those around, each ``(N,)``.
    """
    count = int(block[-1]) + 1
    gram = np.zeros((count, columns.shape[1], columns.shape[1]))
    moment = np.zeros((count, columns.shape[1]))
    np.add.at(gram, block, columns[:, :, None] * columns[:, None])
    np.add.at(moment, block, columns * values[:, None])
    usual = gram.sum(axis=0)
    least = np.diag(np.maximum(np.diag(usual), 1e-300)) / count / 2
    apart = np.empty_like(values)
    for b in range(count):
        near = slice(max(b - 1, 0), b + 2)
        weights = np.linalg.solve(usual - gram[near].sum(axis=0) + least, moment.sum(axis=0) - moment[near].sum(axis=0))
        apart[block == b] = columns[block == b] @ weights
    return columns @ np.linalg.solve(usual + least, moment.sum(axis=0)), apart


def _drifts(errors: OneStepErrors, values: Vector, channel: str) -> Iterator[Pattern]:
    """Errors that go with a signal, at the end of the drive otherwise than at its start."""
    t = errors.recording.elapsed[errors.rows]
    if np.ptp(t) <= 0.0:
        return
    late = 2.0 * (t - t.min()) / np.ptp(t) - 1.0
    v_x, omega = errors.driven[:, 0], errors.driven[:, 2]
    throttle = errors.applied[:, 0]
    signals = {"": np.ones_like(late), "with lateral acceleration ": v_x * omega, "with throttle ": throttle}
    parts = np.clip((late + 1.0) / 2.0 * 4, 0, 3).astype(np.intp)
    edges = t.min() + np.ptp(t) * np.linspace(0.0, 1.0, 5)
    for name, signal in signals.items():
        size = float(np.sqrt(np.mean(signal**2)))
        if size <= 0.0:
            continue
        drift = (signal / size * late)[:, None]
        weight = float((drift[:, 0] @ values) / (drift[:, 0] @ drift[:, 0]))
        unit = COLUMN_UNITS[channel]
        goes, by = f" that goes {name.strip()}" if name else "", f"{weight:+.2g} {unit}"
        words = f"an error of {channel}{goes} grows with time, by {by} from the middle of the drive to its end"
        means = np.array([np.mean((signal / size * values)[parts == k]) for k in range(4)])
        picture = Picture("bins", edges, means, "time of the drive (s)", f"error of {channel} {name}({unit})")
        kind = f"drift_{name.replace(' ', '_')}".rstrip("_")
        pattern = Pattern(channel, "where", kind, words, 0.0, 1.0, 1, {}, None, picture)
        yield from _held(errors, values, pattern, drift)


def _swings(errors: OneStepErrors, values: Vector, channel: str) -> Iterator[Pattern]:
    """A line of the errors that is far above those around and not one of the driving."""
    seconds = _highest(errors, values)
    if seconds is None:
        return
    size = {"period_s": round(seconds, 3)}
    found = sine(errors, values, errors.seconds / seconds, channel, p=1.0, kind="period", told="", size=size)
    assert found.fitted is not None
    far = f"±{np.ptp(found.fitted) / 2:.2g} {COLUMN_UNITS[channel]}"
    words = f"an error of {channel} of {far} comes back every {seconds:.3g} s"
    angle = 2 * np.pi * errors.seconds / seconds
    columns = np.column_stack([np.cos(angle), np.sin(angle)])
    yield from _held(errors, values, replace(found, words=words, terms=2), columns)


def _answers(errors: OneStepErrors, values: Vector, channel: str) -> Iterator[Pattern]:
    """Errors that go with how steering or throttle change: the car answers with a swing or a lag that is not simulated."""
    log, unit = errors.recording, COLUMN_UNITS[channel]
    width = max(1, round(_SMOOTH_S / log.T_s))

    def change(signal: Vector) -> Vector:
        return np.convolve(np.gradient(signal, log.T_s), np.full(width, 1.0 / width), mode="same")

    inputs = {"steering": errors.inputs["steering"] * log["v_x"] ** 2}  # that the tyres would answer with a like force
    if log.info.set_point == "throttle":
        inputs["throttle"] = errors.inputs["throttle"]
    for name, signal in inputs.items():
        first = change(np.convolve(signal, np.full(width, 1.0 / width), mode="same"))
        columns = np.stack([first, change(first)], axis=1)[errors.rows]
        spread = columns.std(axis=0)
        if (spread <= 0.0).any():
            continue
        columns = np.clip(columns / spread, -_FAR, _FAR)
        weights = np.linalg.lstsq(columns, values, rcond=None)[0]
        most = int(np.argmax(np.abs(weights)))
        way = ("speed", "acceleration")[most]
        words = (
            f"an error of {channel} goes with the {way} of the {name}, {weights[most]:+.2g} {unit} at its usual size"
        )
        edges = np.quantile(columns[:, most], np.linspace(0.0, 1.0, 7))
        part = np.clip(np.searchsorted(edges, columns[:, most], side="right") - 1, 0, 5)
        means = np.array([np.mean(values[part == k]) if (part == k).any() else 0.0 for k in range(6)])
        picture = Picture(
            "bins", edges, means, f"{way} of the {name} (standard deviations)", f"error of {channel} ({unit})"
        )
        pattern = Pattern(channel, "delay", f"answer_to_{name}", words, 0.0, 1.0, 2, {}, None, picture)
        yield from _held(errors, values, pattern, columns)


def _highest(errors: OneStepErrors, y: Vector) -> float | None:
    """Period of the line that is highest above those around (s)."""
    t = errors.seconds - errors.seconds[0]
    whole = float(t[-1]) * _OVERSAMPLED
    f = np.arange(np.ceil(whole / _PERIODS_S[1]), whole / _PERIODS_S[0]) / whole
    if len(f) < 2 * _AROUND * _OVERSAMPLED:
        return None
    wave = np.exp(-2j * np.pi * f[:, None] * t)
    above = _above(wave @ (y - y.mean()))
    best = int(np.argmax(above))
    if len(f) * np.exp(-above[best]) > _BY_CHANCE:
        return None
    driven = (*errors.applied.T, errors.driven[:, 0], errors.driven[:, 2])
    near = slice(max(best - _OVERSAMPLED, 0), best + _OVERSAMPLED + 1)
    if any(_DRIVEN * _above(wave @ (x - x.mean()))[near].max() > above[best] for x in driven):
        return None
    finer = f[best] + np.linspace(-1.0, 1.0, _FINER) / whole
    return float(1.0 / finer[np.argmax(np.abs(np.exp(-2j * np.pi * finer[:, None] * t) @ y))])


def _above(line: Vector) -> Vector:
    """Power of each frequency over the mean of noise like that around it."""
    power = np.abs(line) ** 2
    width = _AROUND * _OVERSAMPLED
    around = [np.median(power[max(k - width, 0) : k + width + 1]) for k in range(len(power))]
    return np.asarray(power * np.log(2.0) / np.maximum(around, 1e-300))
