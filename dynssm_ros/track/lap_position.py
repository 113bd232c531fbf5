"""Position on the lap: the driven path as a closed line, where on it a recording is, and measures along it."""

from __future__ import annotations

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.signals.recording import Recording
from dynssm_ros.track.lines import Line
from dynssm_ros.vehicle.effects import CONTEXT_UNITS
from dynssm_ros.vehicle.kinematics import time_of_day

_POINTS = 200  # of the path over the diagonal of the driven area
_NEAR = 0.03  # of that diagonal: passing a place at most this far away is coming back to it
_AT_ONCE = 16384  # rows that are projected together
_STARTS = 200  # places at which a lap is tried to begin
_ALIGNED = 0.5  # cosine between the directions in which a place is passed


def first_lap(recording: Recording) -> Line | None:
    """The path of the first full lap, closed smoothly; ``None`` without positions or if no lap is completed.

    A lap begins anywhere, also on an out-lap, and ends where the car passes the same place in the same direction again.
    """
    if not recording.has_pose:
        return None
    positions = np.stack([recording["x"], recording["y"]], axis=1)
    starts = np.flatnonzero(np.diff(recording.segment)) + 1
    laps = (_lap(part) for part in np.split(positions, starts))
    return next((lap for lap in laps if lap is not None), None)


def track_position(line: Line, recording: Recording) -> Vector:
    """Arc length along ``line`` of each row (m), in ``[0, length)``, shape ``(N,)``."""
    positions = np.stack([recording["x"], recording["y"]], axis=1)
    blocks = np.split(positions, range(_AT_ONCE, len(positions), _AT_ONCE))
    return np.concatenate([line.project(block)[0] for block in blocks])


def lap_context(recording: Recording, line: Line | None) -> dict[str, Vector]:
    """What effects may read of each row, ``(N,)``: the signals of ``CONTEXT_UNITS`` that ``recording`` has, and the place.

    ``t`` (s) counts from the first row, ``clock`` (s) from midnight UTC, ``s`` (m, in ``[0, lap_length)``) along ``line``.
    """
    known = {name: recording[name] for name in CONTEXT_UNITS if name in recording.columns}
    clock = time_of_day(recording.time)
    context = {"t": (recording.time - recording.time[0]) / 1e9, "clock": clock} | known
    if line is None or "s" in context:
        return context
    s = track_position(line, recording)
    return context | {"s": s, "lap_length": np.full(len(recording), line.length), "bend": line.bend(s)}


def lap_number(recording: Recording, line: Line | None) -> Vector | None:
    """How many times each row's drive has passed the start of ``line``; ``None`` without one."""
    if line is None:
        return None
    s = track_position(line, recording)
    passed = np.concatenate([[0], np.cumsum(np.diff(s) < -0.5 * line.length)])
    back = np.concatenate([[0], np.cumsum(np.diff(s) > 0.5 * line.length)])
    return np.asarray(passed - back, dtype=np.float64)


def rms_along(position: Vector, errors: Vector, length: float, bins: int) -> Vector:
    """Root mean square of ``errors`` ``(N, C)`` in ``bins`` equal stretches of the lap of ``length`` (m), ``(bins,
    C)``; NaN where nothing was driven.

    ``position`` is that on the track of each row (m), in ``[0, length)``, ``(N,)``.
    """
    index = np.minimum((position / length * bins).astype(np.intp), bins - 1)
    count = np.bincount(index, minlength=bins)[:, None]
    squares = np.stack([np.bincount(index, column**2, bins) for column in errors.T], axis=1)
    return np.sqrt(np.divide(squares, count, out=np.full_like(squares, np.nan), where=count > 0))


def _lap(positions: Vector) -> Line | None:
    """The first closed lap of one gap-free drive, positions ``(N, 2)``."""
    driven = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(positions, axis=0).T))])
    extent = float(np.hypot(*np.ptp(positions, axis=0)))
    if not driven[-1] > extent:
        return None
    grid = np.arange(0.0, driven[-1], extent / _POINTS)
    path = np.stack([np.interp(grid, driven, coordinate) for coordinate in positions.T], axis=1)
    direction = np.gradient(path, axis=0)
    direction /= np.maximum(np.hypot(*direction.T), 1e-12)[:, None]
    for start in range(0, len(path), max(1, len(path) // _STARTS)):
        ahead = slice(start + _POINTS // 2, None)  # half a diagonal of driving is the least that can be a lap
        distance = np.hypot(*(path[ahead] - path[start]).T)
        back = np.flatnonzero((distance < _NEAR * extent) & (direction[ahead] @ direction[start] > _ALIGNED))
        if len(back):
            passing = back[: np.flatnonzero(np.diff(back, append=len(path) + 1) > 1)[0] + 1]
            end = start + _POINTS // 2 + int(passing[np.argmin(distance[passing])])
            ramp = np.linspace(0.0, 1.0, end - start, endpoint=False)[:, None]
            return Line(path[start:end] - ramp * (path[end] - path[start]))
    return None
