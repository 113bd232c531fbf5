"""How fast a line can be driven: the forward-backward profile under a car's acceleration limits."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from dynssm_ros.arrays import Indices, Vector
from dynssm_ros.track.lines import Line
from dynssm_ros.vehicle.limits import Limits


def speed_profile(line: Line, limits: Limits, share: float | Vector = 1.0, *, reached: bool = True) -> Vector:
    """Fastest speed (m/s) at the points of ``line`` by cornering, brakes and drive, shape ``(N,)``.

    Lateral and longitudinal acceleration share the grip: they stay on the ellipse of their limits.

    Args:
        line: to drive.
        limits: of the car.
        share: of its accelerations that are used, for all points or ``(N,)``.
        reached: by the drive. Else the greatest speed from which the car can go on along the line.
    """
    share = np.broadcast_to(np.asarray(share, dtype=np.float64), line.s.shape)
    curvature = np.abs(line.curvature(line.s)) / share
    v = limits.cornering_speed(curvature)
    ds = np.diff(line.s, append=line.length)
    # from the slowest corner around once, the end meets the start; then the same in reverse for the brakes
    start, count = (int(np.argmin(v)), len(v) + 1) if line.closed else (0, len(v))
    order = np.asarray((start + np.arange(count)) % len(v), dtype=np.intp)
    if reached:
        v = _forward(v, order, share * ds, curvature, limits, limits.drive)
    return _forward(v, order[::-1], share * np.roll(ds, 1), curvature, limits, limits.brake)


def _forward(v: Vector, order: Indices, ds: Vector, curvature: Vector, limits: Limits, available: Vector) -> Vector:
    """Caps ``v`` by what ``available`` acceleration (over ``limits.speed``) reaches, point after point in ``order``.

    With a share of the car's accelerations ``curvature`` (1/m) is over that share, and ``ds`` (m) times it.
    """
    v = v.copy()
    for here, there in pairwise(order):
        used = curvature[here] * v[here] ** 2 / np.interp(v[here], limits.speed, limits.lateral)
        free = np.sqrt(max(0.0, 1.0 - used * used)) * np.interp(v[here], limits.speed, available)
        v[there] = min(v[there], np.sqrt(v[here] ** 2 + 2 * free * ds[here]))
    return v
