"""Cutting the parts of a plan out of recordings."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.ndimage import uniform_filter1d

from benchmarks.paper.plan import Part, Quantity, Range
from dynssm_ros.arrays import Vector
from dynssm_ros.signals.recording import Recording

SMOOTHING = 1.0  # s; regimes are defined by means over this, so that they come in stretches


def cut(recording: Recording, part: Part) -> Recording:
    """The rows of ``part``; what it cuts apart becomes segments, so that no window reaches across."""
    keep = np.ones(len(recording), dtype=np.bool_)
    for limits in part.where:
        keep &= _within(quantity(recording, limits.quantity), limits)
    return recording.select(keep)


def quantity(recording: Recording, name: Quantity) -> Vector:
    """What a :class:`Range` limits, shape ``(N,)``."""
    if name == "time":
        seconds: Vector = (recording.time - recording.time[0]) / 1e9
        return seconds
    if name == "speed":
        return smooth(recording, recording["v_x"])
    if name == "yaw_rate":
        return smooth(recording, recording["omega"])
    return np.abs(smooth(recording, recording["v_x"] * recording["omega"]))


def smooth(recording: Recording, values: Vector) -> Vector:
    """Centred means over a second, never across a gap; ends are continued by their last value."""
    size = max(1, round(SMOOTHING / recording.T_s))
    starts = np.flatnonzero(np.diff(recording.segment)) + 1
    return np.concatenate([uniform_filter1d(part, size, mode="nearest") for part in np.split(values, starts)])


def _within(values: Vector, limits: Range) -> npt.NDArray[np.bool_]:
    inside = np.ones(len(values), dtype=np.bool_)
    if limits.at_least is not None:
        inside &= values >= limits.at_least
    if limits.below is not None:
        inside &= values < limits.below
    if limits.outside is not None:
        inside &= (values < limits.outside[0]) | (values >= limits.outside[1])
    return inside
