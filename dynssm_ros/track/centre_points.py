"""Points of a centre line as people have them: what cannot be driven is left out, smoothed, or refused in one line.

Points nearer to the one before than a tenth of the usual spacing repeat it; dense ones are thinned. Points behind the start
of the lap overlap it. Coordinates that are rounded as coarsely as the line would bend by it are smoothed within the rounding.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import BSpline, splprep

from dynssm_ros.arrays import Vector
from dynssm_ros.errors import UserError

REPEATS = 0.1  # of the usual spacing, nearer than which a point repeats the one before: a spline bends around both
DENSE = 0.05  # of the road's half width, nearer than which a point tells nothing: no road bends more tightly than that
_OVERLAP = 0.1  # of the points, at most, that a lap may have been recorded for too long
_BENT = 0.05  # of the curvature whose radius is the road's half width, that rounding may add
_BACK = 0.0  # cosine of a turn from point to point, from which on the line turns back: 90 degrees
_OPEN, _OPEN_LONGEST = (
    4.0,
    1.5,
)  # times the usual and the longest spacing (or the road's width), beyond which it is open
_SMOOTHED = 0.4
"""Mean square distance of the smoothed line from the points, in that of the rounding. With 0.4 to 1 the sharpest curvature of
the track ``club``, to 0.01 and 0.001 m, is alike (3.5 to 4.7 1/m, 3.3 without rounding); with 1 corners are cut by up to 1.3
times the rounding, with 0.4 by less than it."""
_DIGITS = 6  # after the point; coordinates that are written finer are not rounded
_FEWEST = 10  # points, below which a spline is not smoothed


class TrackError(UserError):
    """A track file is missing or malformed, or what it describes is not a track."""


class CentrePoints(NamedTuple):
    """What is left of the rows of a track."""

    table: Vector
    """``x, y``, distances to the right and to the left border (m), ``(N, 4)``."""
    notes: tuple[str, ...]
    """What was mended, in words; that it is an open road."""
    closed: bool = True
    """Whether its end is at its start."""


def mended(table: Vector) -> CentrePoints:
    """The rows of a track ``(M, 4)`` in driving order without repeats, overlap and rounding.

    Raises:
        TrackError: it turns back.
    """
    if len(table) < _FEWEST or not (table[:, 2:] > 0).all():
        return CentrePoints(table, ())
    notes: list[str] = []
    spacing, dense = _usual(_distances(table)[:-1]), DENSE * float(np.median(table[:, 2:]))
    nearest, of_what = REPEATS * spacing, f"{REPEATS:g} of the usual spacing"
    if spacing < dense:
        spacing, nearest, of_what = dense, dense, f"{DENSE:g} of the road's half width"
    kept = _without_repeats(table, nearest)
    if len(kept) < _FEWEST:
        return CentrePoints(table, ())
    if len(kept) < len(table):
        notes.append(
            f"{len(table) - len(kept)} points nearer than {nearest:.3g} m to the one before left out ({of_what})"
        )
    lap = _without_overlap(kept, spacing)
    if len(lap) < len(kept):
        notes.append(f"the last {len(kept) - len(lap)} points, which run along the start again, left out")
    closed = _is_closed(lap, spacing)
    if not closed:
        notes.append(f"an open road: its end is {_distances(lap)[-1]:.3g} m from its start; it is driven once")
    _check_turns(lap, closed)
    smooth, words = _without_rounding(lap, spacing, closed)
    return CentrePoints(smooth, (*notes, *words), closed)


def _distances(table: Vector) -> Vector:
    """From each point to the next, the last of them to the first (m)."""
    return np.asarray(np.hypot(*(np.roll(table[:, :2], -1, axis=0) - table[:, :2]).T))


def _usual(distances: Vector) -> float:
    """Their median without those of points that are the same; 0 if all are."""
    apart = distances[distances > 0]
    return float(np.median(apart)) if len(apart) else 0.0


def _without_repeats(table: Vector, nearest: float) -> Vector:
    kept = [0]
    for k in range(1, len(table)):
        if np.hypot(*(table[k, :2] - table[kept[-1], :2])) > nearest:
            kept.append(k)
    while len(kept) > 1 and np.hypot(*(table[kept[-1], :2] - table[0, :2])) <= nearest:
        kept.pop()
    return table[kept]


def _without_overlap(table: Vector, spacing: float) -> Vector:
    """Without the last points that lie ahead of the first one, beside the line there."""
    ahead = table[1, :2] - table[0, :2]
    ahead = ahead / np.hypot(*ahead)
    most = max(1, round(_OVERLAP * len(table)))
    reach, last = most * spacing, len(table)
    while len(table) - last < most:
        along, across = _in_frame(table[last - 1, :2] - table[0, :2], ahead)
        if not (0 < along < reach and abs(across) < max(table[0, 2:].max(), spacing)):
            break
        last -= 1
    return table[:last] if len(table) - last < most else table


def _in_frame(away: Vector, ahead: Vector) -> tuple[float, float]:
    return float(away @ ahead), float(ahead[0] * away[1] - ahead[1] * away[0])


def _is_closed(table: Vector, spacing: float) -> bool:
    distance, width = _distances(table), float(table[[0, -1], 2:].sum(axis=1).max())
    return bool(distance[-1] <= max(_OPEN * spacing, _OPEN_LONGEST * distance[:-1].max(), width))


def _check_turns(table: Vector, closed: bool) -> None:
    step = np.roll(table[:, :2], -1, axis=0) - table[:, :2]
    step = step / np.hypot(*step.T)[:, None]
    cosine = np.sum(step * np.roll(step, 1, axis=0), axis=1)
    if not closed:
        cosine[[0, -1]] = 1.0
    back = np.flatnonzero(cosine < _BACK)
    if len(back):
        k = int(back[0])
        raise TrackError(
            f"its line turns by {np.degrees(np.arccos(np.clip(cosine[k], -1, 1))):.0f} degrees from one point to the next "
            f"at x = {table[k, 0]:.4g} m, y = {table[k, 1]:.4g} m; expected points in driving order, without noise"
        )


def _without_rounding(table: Vector, spacing: float, closed: bool) -> tuple[Vector, tuple[str, ...]]:
    """Smoothed within what rounding moves points by: of variance ``step^2 / 12`` in x and in y."""
    step = _rounded_to(table[:, :2])
    half_width = float(np.median(table[:, 2:]))
    if step == 0.0 or step / spacing**2 < _BENT / half_width:
        return table, ()
    through = np.concatenate([table[:, :2], table[:1, :2]]) if closed else table[:, :2]
    fitted: Any = splprep(through.T, s=_SMOOTHED * len(through) * step**2 / 6, per=closed)
    (knots, coefficients, degree), at = fitted
    points: Vector = BSpline(knots, np.stack(coefficients, axis=1), degree)(at[: len(table)])
    moved = float(np.hypot(*(points - table[:, :2]).T).max())
    note = f"x and y are rounded to {step:g} m: smoothed, points moved by up to {moved:.2g} m"
    return np.concatenate([points, table[:, 2:]], axis=1), (note,)


def _rounded_to(points: Vector) -> float:
    """The step of a power of ten (m) in which all coordinates are; 0 where that is finer than 1e-6 m."""
    for digits in range(_DIGITS):
        scaled = points * 10.0**digits
        if np.all(np.abs(scaled - np.round(scaled)) < np.maximum(1e-6, 4 * np.spacing(np.abs(scaled)))):
            return float(10.0**-digits)
    return 0.0
