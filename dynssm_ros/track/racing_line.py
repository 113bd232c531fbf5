"""The racing line: least curvature between the borders of a track, with a tension that keeps it from swelling.

The integral of the squared curvature and the length are minimised over lateral offsets by Gauss-Newton: on the line of
each round, offsets ``e`` along its normals make the integrand ``(kappa + e'' + kappa^2 e / 2)^2`` (to first order, with
the change of length), and the borders bound ``e``: a quadratic program in a box with a banded matrix, cyclic for a closed
track. Each round starts from the line before, not from the centre line, whose normals cross in corners tighter than the
road is wide.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.sparse.linalg import spsolve

from dynssm_ros.arrays import Vector
from dynssm_ros.track.centre_points import TrackError
from dynssm_ros.track.lines import Line
from dynssm_ros.track.tracks import Track
from dynssm_ros.vehicle import Vehicle

LineKind = Literal["centre", "racing"]

CAR_WIDTH = 0.65  # of the wheelbase; 1.94 m for an Indy car of 1.93 m
SAFETY = 0.08  # of the narrowest road, kept free besides the car on either side
MIN_POINTS, MAX_POINTS = 500, 2000
TENSION = 0.5  # gives the fastest laps, or nearly so, on ovals, road courses and 1:43 tracks
_ROUNDS = 40
_REACH = 1.0  # of radius and width, as in 1 / (1/radius + 1/width): how far the first round may move a point ...
_CALMING = 0.8  # ... and by which factor less each further one, so that no two lines alternate
_CONVERGED = 1e-4  # of the width: move of a round
_SLACK = 0.01  # of the margin, on top, for what the linear borders leave over


def border_margin(vehicle: Vehicle, track: Track) -> float:
    """What to keep between the line and the borders (m): half the car, and room for the driver's error."""
    car = vehicle.constants
    narrowest = float(np.min(track.width_left + track.width_right))
    return CAR_WIDTH * car.wheelbase / 2 + SAFETY * narrowest


def line_of(kind: LineKind, vehicle: Vehicle, track: Track) -> Line:
    """The centre line, or the racing line with room for the car.

    Raises:
        TrackError: the road is too narrow for the car.
    """
    return track.centre if kind == "centre" else racing_line(track, border_margin(vehicle, track))


def racing_line(track: Track, margin: float, tension: float = TENSION) -> Line:
    """The line of least integral of ``kappa^2 + lambda^2`` inside the borders; its points are evenly spaced.

    Args:
        track: where.
        margin: distance to keep from the borders (m).
        tension: ``lambda``, what length costs, in root mean squares of the centre line's curvature. At 0 wide bends
            swell, because a longer way round has less curvature; the larger, the shorter the line.

    Raises:
        TrackError: the road is not twice as wide as the margin everywhere, or so winding that no line was found.
    """
    width = track.width_left + track.width_right
    tight = int(np.argmin(width))
    if not 0 <= 2 * margin * (1 + _SLACK) < width[tight]:
        raise TrackError(
            f"track {track.name} is {width[tight]:.3g} m wide at s = {track.centre.s[tight]:.4g} m; expected more than "
            f"twice the margin of {margin:.3g} m that a racing line keeps"
        )
    count = int(np.clip(2 * len(track.centre.points), MIN_POINTS, MAX_POINTS))
    weight = tension**2 * curvature_integral(track.centre) / track.length
    line = best = _resampled(track.centre, count)
    least = np.inf
    for k in range(_ROUNDS):
        offsets = _offsets(line, track, margin * (1 + _SLACK), weight, _REACH * _CALMING**k)
        line = _resampled(Line(line.position(line.s, offsets), line.closed), count)
        cost = curvature_integral(line) + weight * line.length
        if cost < least and np.min(track.clearance(line.points)) >= margin:
            best, least = line, cost
        if np.max(np.abs(offsets)) < _CONVERGED * np.min(width):
            break
    if least == np.inf:
        raise TrackError(
            f"track {track.name}: no racing line keeps {margin:.3g} m from the borders; expected a wider road"
        )
    return best


def curvature_integral(line: Line) -> float:
    """Integral of the squared curvature over one lap (1/m)."""
    s = np.linspace(0.0, line.length, 8 * len(line.points), endpoint=False)
    return float(np.mean(line.curvature(s) ** 2) * line.length)


def _resampled(line: Line, count: int) -> Line:
    return Line(line.position(np.linspace(0.0, line.length, count, endpoint=not line.closed)), line.closed)


def _offsets(line: Line, track: Track, margin: float, weight: float, reach: float) -> Vector:
    """Best offsets (m) along the normals of ``line``, linearised there; shape ``(N,)``."""
    N, h = len(line.points), line.length / len(line.steps)
    heading = line.heading(line.s)
    normal = np.stack([-np.sin(heading), np.cos(heading)], axis=1)
    same: Any = sparse.diags_array(np.ones(N), format="csr")
    ahead = (same[np.roll(np.arange(N), -1)] - same)[: len(line.steps)] / h  # first differences
    tension = ahead.T @ ahead
    second = (
        -tension if line.closed else -sparse.diags_array(np.r_[0.0, np.ones(N - 2), 0.0]) @ tension
    )  # ends are free
    kappa = np.sum((second @ line.points) * normal, axis=1)  # by these differences; the spline's would ring with them
    J = second + sparse.diags_array(kappa**2 / 2)
    H = sparse.csc_array(J.T @ J + weight / 2 * tension)
    g = np.asarray(J.T @ kappa - weight / 2 * kappa)

    s, lateral = track.project(line.points)
    right, left = track.widths(s)
    along = np.maximum(np.cos(heading - track.centre.heading(s)), 0.3)  # how far an offset leads across the track
    step = reach / (np.abs(kappa) + 1 / (left + right))
    # a point that is outside must come back, however far that is
    upper = np.minimum((left - margin - lateral) / along, step)
    lower = np.maximum((margin - right - lateral) / along, -step)
    lower, upper = np.minimum(lower, upper - 1e-6 * h), np.maximum(upper, lower + 1e-6 * h)
    return box_qp(H, g, lower, upper)


def box_qp(H: sparse.csc_array, g: Vector, lower: Vector, upper: Vector, rounds: int = 60) -> Vector:
    """Minimises ``x' H x / 2 + g' x`` for ``lower < upper`` as bounds, all ``(N,)``, by a primal-dual interior-point
    method.

    ``H`` is symmetric, positive semidefinite and sparse; Newton's method takes ``rounds`` at most.
    """
    x = (lower + upper) / 2
    scale = float(np.max(np.abs(g))) + float(np.max(H.diagonal())) * 1e-6 * float(np.max(upper - lower))
    at_lower = at_upper = np.full(len(g), scale)  # multipliers
    for _ in range(rounds):
        below, above = x - lower, upper - x
        gap = float(np.mean(at_lower * below + at_upper * above)) / 2
        residual = H @ x + g
        if gap < 1e-10 * scale * float(np.mean(upper - lower)):
            break
        mu = 0.1 * gap
        dx = spsolve(
            H + sparse.diags_array(at_lower / below + at_upper / above, format="csc"),
            mu / below - mu / above - residual,
        )
        d_lower = mu / below - at_lower - at_lower / below * dx
        d_upper = mu / above - at_upper + at_upper / above * dx
        move = _step_inside((below, dx), (above, -dx), (at_lower, d_lower), (at_upper, d_upper))
        x = x + move * dx
        at_lower, at_upper = at_lower + move * d_lower, at_upper + move * d_upper
    return np.asarray(np.clip(x, lower, upper))


def _step_inside(*pairs: tuple[Vector, npt.NDArray[np.float64]]) -> float:
    """The largest step, at most 1, that keeps every ``value + step * change`` well above 0."""
    value, change = (np.concatenate(each) for each in zip(*pairs, strict=True))
    falling = change < 0
    return min(1.0, 0.95 * float(np.min(-value[falling] / change[falling], initial=np.inf)))
