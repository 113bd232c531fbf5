"""Lines in the plane, closed or open: centre lines, racing lines. Smooth, by arc length, with left as the positive side."""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

from dynssm_ros.arrays import Vector

Floats = float | Vector

_NEWTON_STEPS = 12
_BEND_POINTS = 1000
_SMOOTHED = 0.01  # of the lap: standard deviation
_SHARPEST = 0.95  # quantile of the curvature


@dataclass(frozen=True, eq=False)
class Line:
    """A smooth line: the cubic spline by arc length through ``points``.

    These are positions in driving order (m), ``(N, 2)``. Of a ``closed`` line the first is not repeated at the end, and arc
    lengths are periodic. An open line goes straight on before its first and behind its last point.
    """

    points: Vector
    closed: bool = True

    def __post_init__(self) -> None:
        points = np.array(self.points, dtype=np.float64)
        points.flags.writeable = False
        object.__setattr__(self, "points", points)

    @cached_property
    def s(self) -> Vector:
        """Arc length of the points (m), shape ``(N,)``, 0 at the first."""
        return self._knots[:-1] if self.closed else self._knots

    @cached_property
    def length(self) -> float:
        """Length of one lap, or from the first to the last point (m)."""
        return float(self._knots[-1])

    @cached_property
    def steps(self) -> Vector:
        """From each point to the next (m): ``(N,)`` of a closed line, ``(N - 1,)`` of an open one."""
        return np.diff(self._knots)

    def wrapped(self, s: Floats) -> Any:
        """Arc length ``s`` (m) within the lap of a closed line; of an open one as it is."""
        return s % self.length if self.closed else s

    def position(self, s: Floats, lateral: Floats = 0.0) -> Vector:
        """Positions (m) at arc length ``s`` (m, periodic), ``lateral`` metres to the left; shape ``(..., 2)``."""
        position, tangent, _ = self._derivatives(s)
        return _as_points(position + lateral * 1j * tangent / np.abs(tangent))

    def heading(self, s: Floats) -> Vector:
        """Direction of driving (rad, counter-clockwise from x, in ``(-pi, pi]``) at ``s`` (m, periodic)."""
        return np.asarray(np.angle(self._derivatives(s)[1]))

    def frame(self, s: Floats) -> tuple[Vector, Vector, Vector]:
        """Positions (m), unit vectors along the line and to its left at ``s`` (m, periodic), each ``(..., 2)``."""
        position, tangent, _ = self._derivatives(s)
        along = tangent / np.abs(tangent)
        return _as_points(position), _as_points(along), _as_points(1j * along)

    def curvature(self, s: Floats) -> Vector:
        """Curvature (1/m, positive to the left) at ``s`` (m, periodic)."""
        _, first, second = self._derivatives(s)
        return np.asarray((first.conjugate() * second).imag / np.abs(first) ** 3)

    def bend(self, s: Floats) -> Vector:
        """How sharply the line bends at ``s`` (m, periodic), smoothed over about a fiftieth of the lap.

        It is the curvature over that which a twentieth of the lap exceeds; from -1 (to the right) to 1 (to the left).
        """
        return np.asarray(np.interp(self.wrapped(np.asarray(s, dtype=np.float64)) / self.length, *self._bends))

    def place(self, s: float) -> dict[str, float]:
        """What effects may know of the place ``s`` (m, counting on over the laps)."""
        return {"s": s, "lap_length": self.length, "bend": float(self.bend(s))}

    def project(self, points: npt.ArrayLike, near: npt.ArrayLike | None = None) -> tuple[Vector, Vector]:
        """Foot of the perpendicular from ``points`` (m, shape ``(..., 2)``).

        Args:
            points: positions.
            near: arc length (m) to search around, where the line passes itself closely; the whole line if not given.

        Returns:
            Arc length, of a closed line in ``[0, length)``, and signed distance (m, positive to the left), each ``(...)``.
        """
        points = np.asarray(points, dtype=np.float64)
        p: Any = _as_complex(points)
        s: Any = self.s[self._tree.query(points)[1]] if near is None else np.asarray(near, dtype=np.float64)
        if p.ndim == s.ndim == 0:  # plain numbers are several times as fast as arrays of one
            p, s = complex(p), float(s)
        longest = self.length / len(self.points)
        for _ in range(_NEWTON_STEPS):
            position, tangent, bend = self._derivatives(s)
            away = p - position
            square = _dot(tangent, tangent)
            slope = np.maximum(square - _dot(away, bend), 0.2 * square)
            move = np.minimum(np.maximum(_dot(away, tangent) / slope, -5 * longest), 5 * longest)
            s = s + move
            if np.abs(move).max(initial=0.0) < 1e-11 * self.length:
                break
        else:
            position, tangent, _ = self._derivatives(s)
            away = p - position
        cross = (tangent.conjugate() * away).imag
        return np.asarray(self.wrapped(s)), np.asarray(cross / np.abs(tangent))

    def counted_on(self, s: float, last: float) -> float:
        """Arc length ``s`` (m) counted on over the laps from ``last`` (m), which is less than half a lap away."""
        if not self.closed:
            return s
        return last + math.remainder(s - last, self.length)

    def scaled(self, factor: float) -> Line:
        """The same shape, ``factor`` times as large."""
        return Line(self.points * factor, self.closed)

    @cached_property
    def _spline(self) -> CubicSpline:
        """Position over arc length; its parameter is refined until it is the spline's own length."""
        through = np.concatenate([self.points, self.points[:1]]) if self.closed else self.points
        pieces = np.hypot(*np.diff(through, axis=0).T)
        nodes, weights = np.polynomial.legendre.leggauss(5)
        for _ in range(4):
            knots = np.concatenate([[0.0], np.cumsum(pieces)])
            spline = CubicSpline(knots, through, bc_type="periodic" if self.closed else "natural")
            inside = knots[:-1, None] + np.diff(knots)[:, None] * (nodes + 1) / 2
            tangent = spline(inside, 1)
            pieces = np.hypot(tangent[..., 0], tangent[..., 1]) @ weights / 2 * np.diff(knots)
        return spline

    @cached_property
    def _pieces(self) -> npt.NDArray[np.complex128]:
        """Coefficients of the spline's pieces as complex numbers, ``(4, N)``."""
        return _as_complex(self._spline.c)

    @cached_property
    def _knots(self) -> Vector:
        """Arc length at which the spline's pieces begin, and the end of the last one (m), ``(N + 1,)``."""
        return np.asarray(self._spline.x)

    @cached_property
    def _listed(self) -> tuple[list[float], list[list[complex]]]:
        """Knots and :attr:`_pieces` as plain numbers, one piece after the other."""
        return self._knots.tolist(), self._pieces.T.tolist()

    def _derivatives(self, s: Floats) -> tuple[Any, Any, Any]:
        """Position and its first two derivatives by arc length at ``s`` (m), each ``(...)``, complex: ``x + iy``.

        Plain numbers for a plain number: a controller asks for few points often, where scipy's own evaluation is
        several times slower.
        """
        at: Any
        if not self.closed:
            return self._derivatives_of_open(np.asarray(s, dtype=np.float64))
        if isinstance(s, float):
            knots, pieces = self._listed
            at = s % self.length
            piece = bisect_right(knots, at, 1, len(pieces)) - 1
            (a, b, c, d), h = pieces[piece], at - knots[piece]
        else:
            at = np.asarray(s, dtype=np.float64) % self.length
            places = self._knots[1:-1].searchsorted(at, "right")
            (a, b, c, d), h = self._pieces[:, places], at - self._knots[places]
        return ((a * h + b) * h + c) * h + d, (3 * a * h + 2 * b) * h + c, 6 * a * h + 2 * b

    def _derivatives_of_open(self, s: Vector) -> tuple[Any, Any, Any]:
        at = np.clip(s, 0.0, self.length)
        places = self._knots[1:-1].searchsorted(at, "right")
        (a, b, c, d), h, over = self._pieces[:, places], at - self._knots[places], s - at
        tangent, bend = (3 * a * h + 2 * b) * h + c, 6 * a * h + 2 * b
        return ((a * h + b) * h + c) * h + d + over * tangent, tangent, np.where(over == 0.0, bend, 0.0)

    @cached_property
    def _bends(self) -> tuple[Vector, Vector]:
        """Places (laps) and :meth:`bend` there."""
        mode: Literal["wrap", "nearest"] = "wrap" if self.closed else "nearest"
        lap = np.arange(_BEND_POINTS) / _BEND_POINTS
        curvature = gaussian_filter1d(self.curvature(lap * self.length), _SMOOTHED * _BEND_POINTS, mode=mode)
        sharpest = float(np.quantile(np.abs(curvature), _SHARPEST))
        bend = np.clip(curvature / max(sharpest, 1e-12), -1.0, 1.0)
        return np.append(lap, 1.0), np.append(bend, bend[0 if self.closed else -1])

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.points)


def _as_complex(points: Vector) -> npt.NDArray[np.complex128]:
    """``x + iy`` of points ``(..., 2)``."""
    return np.asarray(points[..., 0] + 1j * points[..., 1])


def _as_points(z: Any) -> Vector:
    """Points ``(..., 2)`` of ``x + iy``."""
    return np.stack([np.real(z), np.imag(z)], axis=-1)


def _dot(a: Any, b: Any) -> Any:
    """Scalar products of vectors in the plane, given as complex numbers."""
    return (a.conjugate() * b).real
