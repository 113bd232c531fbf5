"""Streams with different rates, offsets and jitter onto one uniform grid, by header stamp."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dynssm_ros.errors import RecordingError
from dynssm_ros.signals.inputs import lookahead_commands, model_inputs
from dynssm_ros.signals.recording import Recording, RecordingInfo
from dynssm_ros.signals.signal_map import POSE_SIGNALS, STATE_SIGNALS, Commands

Vector = npt.NDArray[np.float64]
Stamps = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Stream:
    """The samples of one signal: strictly increasing stamps (int64 ns) and values in SI units, each ``(N,)``."""

    stamps: Stamps
    values: Vector


def interpolate(stream: Stream, grid: Stamps, max_gap: int) -> tuple[Vector, npt.NDArray[np.bool_]]:
    """Linear interpolation at ``grid`` (int64 ns), and where it is bridged by samples at most ``max_gap`` ns apart.

    A grid instant on a sample is covered by that sample alone.
    """
    t = stream.stamps
    origin = t[0]
    values = np.interp((grid - origin).astype(np.float64), (t - origin).astype(np.float64), stream.values)
    right = np.searchsorted(t, grid, side="left")
    inside = (grid >= t[0]) & (grid <= t[-1])
    right = np.clip(right, 0, len(t) - 1)
    left = np.clip(right - 1, 0, len(t) - 1)
    covered = inside & ((t[right] == grid) | (t[right] - t[left] <= max_gap))
    return values, covered


def resample(
    streams: Mapping[str, Stream], rate: float, max_gap: float, commands: Commands, info: RecordingInfo
) -> Recording:
    """Brings all signals onto a grid of ``rate`` Hz that starts at the first ``v_x`` stamp.

    Rows that some signal does not cover are left out; where rows are missing, a new segment begins. Angles are
    unwrapped before they are interpolated. Brakes are merged and commands become increments here.

    Args:
        streams: by signal name.
        rate: of the grid (Hz).
        max_gap: longest time between samples that is bridged (s).
        commands: source of ``u_t``.
        info: metadata to carry along; its sampling time must be ``1 / rate``.

    Raises:
        RecordingError: the streams never overlap.
    """
    anchor = streams["v_x"].stamps
    period = 1e9 / rate
    count = int((anchor[-1] - anchor[0]) / period + 1e-6) + 1
    grid = anchor[0] + np.round(np.arange(count) * period).astype(np.int64)
    covered = np.ones(count, dtype=bool)
    sampled: dict[str, Vector] = {}
    for name, stream in streams.items():
        smooth = Stream(stream.stamps, np.unwrap(stream.values)) if name == "theta" else stream
        sampled[name], here = interpolate(smooth, grid, round(max_gap * 1e9))
        covered &= here
    if not covered.any():
        spans = "; ".join(f"{n} {s.stamps[0] / 1e9:.3f}..{s.stamps[-1] / 1e9:.3f} s" for n, s in streams.items())
        raise RecordingError(f"no instant is covered by all signals within {max_gap:g} s: {spans}")
    rows = np.flatnonzero(covered)
    segment = np.concatenate([[0], np.cumsum(np.diff(rows) > 1)]).astype(np.int32)
    sampled = {name: values[rows] for name, values in sampled.items()}
    inputs = model_inputs(sampled)
    columns = {name: sampled[name] for name in STATE_SIGNALS} | inputs._asdict()
    columns |= {name: sampled[name] for name in POSE_SIGNALS if name in sampled}
    if commands == "lookahead":
        columns["r_cmd"] = lookahead_commands(inputs.r_fb, segment)
        columns["delta_cmd"] = lookahead_commands(inputs.delta_fb, segment)
    return Recording(info, grid[rows], segment, columns)
