"""Patterns in where and when: errors that follow the speed, the inputs, the accelerations, the place, the heading."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from dynssm_ros.arrays import Indices, Mask, Vector
from dynssm_ros.evaluation.regimes import COASTING, round_edges
from dynssm_ros.evaluation.residuals.errors import OneStepErrors
from dynssm_ros.evaluation.residuals.evidence import (
    block_sums,
    chances,
    limited,
    means_of_kinds,
    share_explained,
)
from dynssm_ros.evaluation.residuals.patterns import Pattern, Picture
from dynssm_ros.signals.recording import COLUMN_UNITS
from dynssm_ros.track.lap_position import track_position
from dynssm_ros.vehicle.gears import gear_of

_BINS, _PLACES, _HEADINGS, _TIMES = 10, 24, 8, 8
_SMOOTH_ROWS, _CHANGE_S = 3, 0.2
"""Rows over which states are averaged, the last two rows before the window's end: the noise of the measured state, which is
in the error too, shall not look like a pattern. Time over which the acceleration is taken (s)."""
_RATE_S = 0.1  # over which rates of the inputs are taken
_STEP = 0.25  # of an input's usual range, within _RATE_S, that is a step of it
_SINCE_S = (0.0, 0.1, 0.2, 0.4, 0.8)
_LASTING_S = (0.0, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0)
_STRAIGHT = 0.15  # of the usual lateral acceleration, below which the car goes straight
_NAMED = 0.01  # chance of a bin that is named beside the strongest


@dataclass(frozen=True)
class Situation:
    """What was going on, in kinds.

    Attributes:
        name: the quantity, as in "by speed".
        kind: of each row, ``(N,)``; ``K`` stands for none.
        labels: of the K kinds, as in "between 9 and 15 m/s".
        edges: of the quantity's bins, ``(K + 1,)``; ``None`` for categories.
        unit: of the quantity.
        sign: of each row, by which the error is taken; ``None``: as it is.
    """

    name: str
    kind: Indices = field(repr=False)
    labels: tuple[str, ...]
    edges: Vector | None = None
    unit: str = ""
    sign: Vector | None = field(default=None, repr=False)


def situations(errors: OneStepErrors) -> list[Situation]:
    """The quantities by which errors are sorted, as far as the recording has them."""
    log, T_s = errors.recording, errors.T_s
    rows = max(1, round(_CHANGE_S / T_s))
    smooth = {name: _smoothed(errors, log[name]) for name in ("v_x", "omega")}
    long_ago = _smoothed(errors, log["v_x"], 2 + rows)
    v_x, lateral = smooth["v_x"], smooth["v_x"] * smooth["omega"]
    r, delta = errors.applied.T
    found = [
        _all(errors),
        _bins("time of the drive", log.elapsed[errors.rows + 1], "s", _TIMES),
        _bins("speed", v_x, "m/s", _BINS),
        _bins("throttle", r, "", _BINS),
        _bins("steering", delta, "rad", _BINS),
        _bins("lateral acceleration", lateral, "m/s²", _BINS),
        _bins("longitudinal acceleration", (v_x - long_ago) / (rows * T_s), "m/s²", _BINS),
    ]
    gears = list(_gears(errors))
    found += gears
    back = max(1, round(_RATE_S / T_s))
    for (name, column), unit in zip(errors.inputs.items(), ("1/s", "rad/s"), strict=True):
        change = column[errors.rows] - errors.before(column, back)
        found.append(_bins(f"{name} rate", change / (back * T_s), unit, _BINS))
        since = _since_step(errors, column, back)
        if since is not None:
            found.append(_after(f"a step of the {name}", *since))
    pedal = np.digitize(r, [-COASTING, np.nextafter(COASTING, 1.0)]) if log.info.set_point == "throttle" else None
    bend = bends(lateral)
    speed = found[2]
    if pedal is not None:
        words = ("under braking", "coasting", "under throttle")
        found += [crossed(f"{each.name} and pedal", each, pedal, words) for each in (speed, *gears[:1])]
    found.append(crossed("speed and bend", speed, bend, ("in right bends", "on straights", "in left bends")))
    if log.has_pose:
        turned = np.mod(log["theta"][errors.rows], 2 * np.pi)
        found.append(_bins("heading", np.degrees(turned), "°", _HEADINGS, (0.0, 360.0)))
        if errors.line is not None:
            s = track_position(errors.line, log.select(errors.rows))
            found.append(_bins("place on the lap", s, "m", _PLACES, (0.0, errors.line.length)))
    return [each for each in found if len(each.labels) > 1 or each.name == "offset"]


def bends(lateral: Vector) -> Indices:
    """Where a lateral acceleration is that of a right bend (0), a straight (1), a left bend (2), ``(N,)``."""
    return np.digitize(lateral, np.array([-1, 1]) * _STRAIGHT * max(float(np.percentile(np.abs(lateral), 95)), 1e-9))


def lasting(errors: OneStepErrors, name: str, there: Mask, sign: Vector | None = None) -> Situation:
    """How long something had been going on at each row.

    Args:
        errors: at rows of a recording.
        name: of what goes on, as in "in the bend".
        there: at which rows of the recording it does, ``(M,)``.
        sign: of each row of the recording, by which the error is taken, ``(M,)``.
    """
    starts = np.flatnonzero(there & ~np.concatenate([[False], there[:-1]]))
    kinds = len(_LASTING_S)
    if not len(starts):
        return Situation(f"time {name}", np.zeros(len(errors), np.intp), ("",))
    lasted = _since(errors, starts)[0]
    kind = np.where(there[errors.rows], np.digitize(lasted, _LASTING_S) - 1, kinds)
    labels = [f"{a:g} to {b:g} s" for a, b in pairwise(_LASTING_S)] + [f"{_LASTING_S[-1]:g} s and more"]
    signs = None if sign is None else sign[errors.rows]
    return Situation(f"time {name}", kind, tuple(f"after {each} {name}" for each in labels), sign=signs)


def regimes(
    errors: OneStepErrors, values: Vector, channel: str, sorted_by: list[Situation], *, ahead: bool = False
) -> Iterator[Pattern]:
    """Looks for mean errors ``values`` ``(N,)`` that differ from zero somewhere.

    Where they are the same everywhere, the offset explains as much with one number and is taken. Told is where they are
    surest or, of errors some steps ``ahead``, where most of the squared error is; the latter are no rates.

    Yields:
        A pattern for each quantity.
    """
    y = limited(values)
    y += float(np.median(values))
    unit, T_s = (COLUMN_UNITS[channel], 1.0) if ahead else (per_second(COLUMN_UNITS[channel]), errors.T_s)
    title = f"mean error of {channel} ({unit})"
    for each in sorted_by:
        kinds = len(each.labels)
        sign = 1.0 if each.sign is None else each.sign
        sums = block_sums(sign * y, errors.block, each.kind, kinds + 1)
        chance = chances(sums[:, :kinds])
        whole, apart = means_of_kinds(sign * values, errors.block, each.kind, kinds + 1)
        whole[kinds], apart[each.kind == kinds] = 0.0, 0.0
        share = share_explained(values, sign * apart)
        weights = np.bincount(each.kind, minlength=kinds + 1) + 1e-9
        best = int(np.argmax((weights * whole**2)[:kinds]) if ahead else np.argmin(chance))
        low, high = _neighbours(best, whole, chance, each.edges is None)
        mean = float(np.average(whole[low : high + 1], weights=weights[low : high + 1]))
        told = f"{channel} errs by {mean / T_s:+.2g} {unit} {_range(each, low, high)}"
        shown, spread = whole[:kinds] / T_s, _spread(sums, each.kind, kinds) / T_s
        if each.edges is None:
            x = np.arange(kinds, dtype=float)
            picture = Picture("bars", x, shown, each.name, title, spread, each.labels, (low, high))
        else:
            name, mark = f"{each.name} ({each.unit})" if each.unit else each.name, each.edges[[low, high + 1]].tolist()
            picture = Picture("bins", each.edges, shown, name, title, spread, (), (mark[0], mark[1]))
        yield Pattern(
            channel, "where", each.name.replace(" ", "_"), told, share, min(1.0, kinds * float(chance[best])), kinds,
            {} if ahead else {"error_per_s": round(mean / T_s, 6)}, sign * whole[each.kind], picture,
        )  # fmt: skip


def per_second(unit: str) -> str:
    """The unit of a rate of change."""
    return f"{unit.partition('/')[0]}/s²"


def _range(each: Situation, low: int, high: int) -> str:
    if each.edges is None or high == low:
        return each.labels[low]
    return f"between {each.edges[low]:.4g} and {each.edges[high + 1]:.4g} {each.unit} of {each.name}".replace("  ", " ")


def _neighbours(best: int, mean: Vector, chance: Vector, alone: bool) -> tuple[int, int]:
    """From which bin to which the mean has the sign of the strongest, beyond chance."""
    low = high = best
    if not alone:
        like = (np.sign(mean[: len(chance)]) == np.sign(mean[best])) & (chance < _NAMED)
        while low > 0 and like[low - 1]:
            low -= 1
        while high < len(chance) - 1 and like[high + 1]:
            high += 1
    return low, high


def _spread(sums: Vector, kind: Indices, kinds: int) -> Vector:
    """Standard errors of the means by the scatter of the blocks, ``(kinds,)``."""
    count = np.maximum(np.bincount(kind, minlength=kinds + 1)[:kinds], 1)
    total = sums[:, :kinds]
    there = np.maximum(np.count_nonzero(total, axis=0), 1)
    centred = np.where(total != 0, total - total.sum(axis=0) / there, 0.0)
    return np.asarray(np.sqrt((centred**2).sum(axis=0)) / count)


def _smoothed(errors: OneStepErrors, column: Vector, back: int = 2) -> Vector:
    """Mean of a few rows of a column, of which the last is ``back`` rows before the window's end, ``(N,)``."""
    return np.asarray(np.mean([errors.before(column, back + k) for k in range(_SMOOTH_ROWS)], axis=0))


def _all(errors: OneStepErrors) -> Situation:
    return Situation("offset", np.zeros(len(errors), np.intp), ("throughout",))


def _bins(name: str, x: Vector, unit: str, most: int, ends: tuple[float, float] | None = None) -> Situation:
    low, high = np.percentile(x, [1, 99]) if ends is None else ends
    if not high > low:
        return Situation(name, np.zeros(len(x), np.intp), ("",), None, unit)
    edges = round_edges(float(low), float(high), most) if ends is None else np.linspace(low, high, most + 1)
    kind = np.clip(np.digitize(x, edges) - 1, 0, len(edges) - 2)
    labels = tuple(f"between {a:.4g} and {b:.4g} {unit} of {name}".replace("  ", " ") for a, b in pairwise(edges))
    return Situation(name, kind, labels, edges, unit)


def crossed(name: str, speed: Situation, other: Indices, words: tuple[str, ...]) -> Situation:
    """Each range of speed, or each gear, with each of other kinds."""
    ranges = speed.labels if speed.edges is None else [
        f"between {a:.4g} and {b:.4g} m/s" for a, b in pairwise(speed.edges)
    ]  # fmt: skip
    labels = tuple(f"{word} {part}".strip() for part in ranges for word in words)
    return Situation(name, speed.kind * len(words) + other, labels)


def _since_step(errors: OneStepErrors, column: Vector, back: int) -> tuple[Vector, Vector] | None:
    """Time since the last step of an input (s) and its sign, ``(N,)`` each; ``None`` if it hardly steps."""
    spread = float(np.ptp(np.percentile(column, [5, 95])))
    change = np.zeros_like(column)
    change[back:] = column[back:] - column[:-back]
    stepped = np.abs(change) > _STEP * spread
    if spread <= 0 or not 0 < stepped.mean() < 0.3:
        return None
    starts = np.flatnonzero(stepped & ~np.concatenate([[False], stepped[:-1]]))
    since, at = _since(errors, starts)
    return since, np.sign(change[at])


def _since(errors: OneStepErrors, starts: Indices) -> tuple[Vector, Indices]:
    """Time since the last of the rows ``starts`` in the same segment (s), infinite before, and that row, ``(N,)`` each."""
    last = np.searchsorted(starts, errors.rows, side="right") - 1
    at = starts[np.maximum(last, 0)]
    same = (last >= 0) & (errors.recording.segment[at] == errors.recording.segment[errors.rows])
    return np.where(same, (errors.rows - at) * errors.T_s, np.inf), at


def _gears(errors: OneStepErrors) -> Iterator[Situation]:
    """The gear, and the time since it changed up or down, where the recording tells it."""
    gear = gear_of(errors.recording.columns, errors.recording["v_x"])
    if gear is None:
        return
    numbers, kind = np.unique(gear[errors.rows], return_inverse=True)
    yield Situation("gear", kind.astype(np.intp), tuple(f"in gear {number}" for number in numbers))
    change = np.diff(gear, prepend=gear[:1])
    for way, starts in (("up", np.flatnonzero(change > 0)), ("down", np.flatnonzero(change < 0))):
        if len(starts):
            yield _after(f"a change {way} of the gear", _since(errors, starts)[0])


def _after(name: str, since: Vector, sign: Vector | None = None) -> Situation:
    kind = np.digitize(since, _SINCE_S) - 1
    last = len(_SINCE_S) - 1
    labels = tuple(f"{a:g} to {b:g} s after {name}" for a, b in pairwise(_SINCE_S))
    return Situation(f"time since {name}", np.minimum(kind, last), labels, None, "", sign)
