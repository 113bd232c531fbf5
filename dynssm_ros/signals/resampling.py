"""Streams with different rates, offsets and jitter onto one uniform grid, by header stamp."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dynssm_ros.arrays import Vector
from dynssm_ros.errors import RecordingError
from dynssm_ros.signals.inputs import lookahead_commands, model_inputs
from dynssm_ros.signals.recording import V_Y_DEVIATION, Recording, RecordingInfo
from dynssm_ros.signals.signal_map import CONTEXT_SIGNALS, POSE_SIGNALS, ROUNDING, STATE_SIGNALS, Commands, Hold

Stamps = npt.NDArray[np.int64]
SLOW = 1.5
"""Periods of the grid between samples, from which on a signal is slower than it."""
_TOGETHER = 0.8  # of the samples in which something changes, in which all signals of a sensor do
_FEWEST_NEW = 20  # such samples, before anything is said
_FEW = 0.05  # of the rows that lie between slower samples, as single ones that were lost


@dataclass(frozen=True)
class Stream:
    """The samples of one signal: strictly increasing stamps (int64 ns) and values in SI units, each ``(N,)``."""

    stamps: Stamps
    values: Vector


def sample(
    stream: Stream, grid: Stamps, max_gap: int, hold: Hold = "first", rounding: int = 0
) -> tuple[Vector, npt.NDArray[np.int32]]:
    """The stream at ``grid`` (int64 ns) inside its stretches: interpolated, or with its last sample held.

    A stretch is a run of samples that are at most ``max_gap`` ns apart; a lone sample is one too. A sample that is held
    holds from ``rounding`` ns before its stamp on.

    Returns:
        The values, and for each the number of the stretch it lies in; -1, and a value of no meaning, where it lies in
            none.
    """
    t = stream.stamps
    origin = t[0]
    if hold == "zero":
        values = stream.values[np.maximum(np.searchsorted(t, grid + rounding, side="right") - 1, 0)]
    else:
        values = np.interp((grid - origin).astype(np.float64), (t - origin).astype(np.float64), stream.values)
    number = np.concatenate([[0], np.cumsum(np.diff(t) > max_gap)]).astype(np.int32)
    after = np.minimum(np.searchsorted(t, grid, side="left"), len(t) - 1)
    before = np.maximum(np.searchsorted(t, grid, side="right") - 1, 0)
    inside = (grid >= t[0]) & (grid <= t[-1]) & (number[before] == number[after])
    return values, np.where(inside, number[after], np.int32(-1))


def without_repeats(streams: Mapping[str, Stream]) -> tuple[dict[str, Stream], list[str]]:
    """The streams without samples of velocities or poses that only repeat the one before, where most do, and a note on it.

    Tables that were written at a fixed rate, and nodes that publish on a timer, hold slower sensors so: all signals of a
    sensor change together. What stays the same for longer than usual, as of a car that stands, is kept.
    """
    found, notes = dict(streams), []
    for group in (STATE_SIGNALS, POSE_SIGNALS):
        names = [name for name in group if name in streams]
        stamps = streams[names[0]].stamps if names else np.empty(0, np.int64)
        if len(names) < 2 or len(stamps) < 3 or any(len(streams[name].stamps) != len(stamps) for name in names):
            continue
        living = [values for name in names if np.ptp(values := streams[name].values) > 0]
        if not living:
            continue
        new = np.stack([np.diff(values, prepend=np.nan) != 0 for values in living])
        some, all_ = new.any(axis=0), new.all(axis=0)
        at = np.flatnonzero(some)
        usual = float(np.median(np.diff(at))) if len(at) > _FEWEST_NEW else 1.0
        if usual < SLOW or all_.sum() < _TOGETHER * some.sum():
            continue
        since = np.arange(len(stamps)) - np.maximum.accumulate(np.where(some, np.arange(len(stamps)), 0))
        kept = some | (since >= 2 * usual)
        found |= {name: Stream(stamps[kept], streams[name].values[kept]) for name in names}
        notes.append(f"{', '.join(names)}: {int((~kept).sum())} samples that repeat the one before left out")
    return found, notes


def uniform_grid(anchor: Stamps, period: float, max_gap: int) -> Stamps:
    """The instants ``anchor[0] + k * period`` (ns) that lie inside the stretches of ``anchor``.

    Laid stretch by stretch: a first message with an unset stamp must not make a grid of 50 years.
    """
    cuts = np.flatnonzero(np.diff(anchor) > max_gap)
    first = (anchor[np.concatenate([[0], cuts + 1])] - anchor[0]) / period
    last = (anchor[np.concatenate([cuts, [len(anchor) - 1]])] - anchor[0]) / period
    steps = [np.arange(np.ceil(a - ROUNDING), np.floor(b + ROUNDING) + 1) for a, b in zip(first, last, strict=True)]
    grid: Stamps = anchor[0] + np.round(np.concatenate(steps) * period).astype(np.int64)
    return grid


def unwrapped(angle: Vector) -> Vector:
    """An angle (rad) without jumps by whole turns, ``(N,)``.

    One in degrees that nobody said is in degrees stays one, so that it can be told: its turns are of 360.
    """
    if len(angle) < 2:
        return angle
    low, high = np.percentile(angle, [0.5, 99.5])
    is_in_degrees = high - low > 2 * np.pi and float(np.abs(np.diff(angle)).max()) > np.pi
    return np.unwrap(angle, period=360.0 if is_in_degrees else 2 * np.pi)


def resample(
    streams: Mapping[str, Stream], rate: float, max_gap: float, commands: Commands, info: RecordingInfo
) -> Recording:
    """Brings all signals onto a grid of ``rate`` Hz that starts at the first ``v_x`` stamp.

    Rows that some signal does not cover are left out; gear and engine speed go on over their gaps. Where rows are missing or
    a signal has a gap, a new segment begins. Angles are unwrapped before they are interpolated. Brakes are merged and
    commands become increments here.

    Args:
        streams: by signal name.
        rate: of the grid (Hz).
        max_gap: longest time between samples that is bridged (s).
        commands: source of ``u_t``.
        info: metadata to carry along; its sampling time must be ``1 / rate``. Signals that it names as ``held`` keep
            their last sample until the next, the others are interpolated.

    Raises:
        RecordingError: the streams never overlap.
    """
    bridged, period = round(max_gap * 1e9), 1e9 / rate
    grid = uniform_grid(streams["v_x"].stamps, period, bridged)
    sampled: dict[str, Vector] = {}
    stretches: list[npt.NDArray[np.int32]] = []
    for name, stream in streams.items():
        smooth = Stream(stream.stamps, unwrapped(stream.values)) if name == "theta" else stream
        hold: Hold = "zero" if name in info.held else "first"
        sampled[name], stretch = sample(smooth, grid, bridged, hold, round(ROUNDING * period))
        stretches += [stretch] if name not in CONTEXT_SIGNALS else []
    numbers = np.stack(stretches)
    rows = np.flatnonzero((numbers >= 0).all(axis=0))
    if len(rows) == 0:
        spans = "; ".join(f"{n} {s.stamps[0] / 1e9:.3f}..{s.stamps[-1] / 1e9:.3f} s" for n, s in streams.items())
        raise RecordingError(
            f"{', '.join(info.source)}: no instant is covered by all signals within {max_gap:g} s: {spans}"
        )
    apart = (np.diff(grid[rows]) > 1.5 * period) | (np.diff(numbers[:, rows], axis=1) != 0).any(axis=0)
    segment = np.concatenate([[0], np.cumsum(apart)]).astype(np.int32)
    info = _with_interpolated(info, streams, grid[rows], period)
    sampled = {name: values[rows] for name, values in sampled.items()}
    inputs = model_inputs(sampled)
    columns = {name: sampled[name] for name in STATE_SIGNALS} | inputs._asdict()
    columns |= {name: sampled[name] for name in (*POSE_SIGNALS, V_Y_DEVIATION, *CONTEXT_SIGNALS) if name in sampled}
    if commands == "lookahead":
        columns["r_cmd"] = lookahead_commands(inputs.r_fb, segment)
        columns["delta_cmd"] = lookahead_commands(inputs.delta_fb, segment)
    return Recording(info, grid[rows], segment, columns)


def _with_interpolated(
    info: RecordingInfo, streams: Mapping[str, Stream], rows: Stamps, period: float
) -> RecordingInfo:
    """The metadata with the share of the ``rows`` (ns) that lie between slower samples, and a note on them."""
    shares: dict[str, float] = {}
    told: dict[str, list[str]] = {}  # signals by what is told of them
    for name, stream in streams.items():
        if name in info.held or len(stream.stamps) < 2:
            continue
        after = np.clip(np.searchsorted(stream.stamps, rows - round(ROUNDING * period)), 1, len(stream.stamps) - 1)
        between = np.diff(stream.stamps)[after - 1]
        slow = (between > SLOW * period) & (np.abs(stream.stamps[after] - rows) > ROUNDING * period)
        if slow.mean() > _FEW:
            shares[name] = round(float(slow.mean()), 3)
            usual, apart = (float(np.median(each)) / 1e9 for each in (np.diff(stream.stamps), between[slow]))
            where, mended = f"between samples at {1 / apart:.3g} Hz", f"--rate {1 / apart:.3g}"
            if usual <= SLOW * period / 1e9:  # the signal is fast enough, but has holes
                where, mended = (
                    f"in holes of {apart:.2g} s between samples",
                    "a shorter max_gap of the map leaves them out",
                )
            what = f"{100 * shares[name]:.0f} % of the rows lie {where}, so that errors on them come out too small ({mended})"
            told.setdefault(what, []).append(name)
    notes = tuple(f"{', '.join(names)}: {what}" for what, names in told.items())
    return info.model_copy(update={"interpolated": shares, "notes": (*info.notes, *notes)})
