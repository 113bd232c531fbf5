"""Race tracks: a centre line with widths, from the racetrack-database CSV format or built in by name."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from dynssm_ros.arrays import Vector
from dynssm_ros.track.centre_points import TrackError, mended
from dynssm_ros.track.layouts import LAYOUTS, closed_loop
from dynssm_ros.track.lines import Floats, Line

CSV_COLUMNS = ("x_m", "y_m", "w_tr_right_m", "w_tr_left_m")
LARGEST = 1e9  # m, of a coordinate or width
MIN_POINTS = 10
_WIDEST = 100.0  # m, from the centre line to a border; runways have 40
_SLENDER = 1.0, 20_000.0  # length of a road over its width; the published tracks have 28 to 423, the Nordschleife 2,600
_BETWEEN = re.compile(r"\s*[,;\t]\s*|\s+")  # cells of a row
MAX_FOLDED = 0.25  # share of the lap; 0.04 on the published ETHZ track


@dataclass(frozen=True, eq=False)
class Track:
    """A ribbon of road, closed or open as its centre line is.

    Attributes:
        name: for messages and results.
        centre: the centre line in driving order, ``N`` points.
        width_right: distance from the centre line to the right border at its points (m), ``(N,)``.
        width_left: likewise to the left border.
        notes: what was mended of its points, in words.

    Raises:
        TrackError: too few points, repeated points, widths that are not positive, borders that cross.
    """

    name: str
    centre: Line
    width_right: Vector
    width_left: Vector
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for side in ("width_right", "width_left"):
            width = np.array(getattr(self, side), dtype=np.float64)
            width.flags.writeable = False
            object.__setattr__(self, side, width)
        _check_points(self)
        _check_borders(self)

    @property
    def length(self) -> float:
        """Length of one lap, or from start to end, along the centre line (m)."""
        return self.centre.length

    def require_closed(self) -> Track:
        """The track, if it is a lap.

        Raises:
            TrackError: it is an open road.
        """
        if not self.centre.closed:
            raise TrackError(f"track {self.name}: an open road of {self.length:.4g} m; expected a closed lap")
        return self

    @cached_property
    def left_border(self) -> Vector:
        """Points of the left border (m), shape ``(N, 2)``."""
        return self.centre.position(self.centre.s, self.width_left)

    @cached_property
    def right_border(self) -> Vector:
        """Points of the right border (m), shape ``(N, 2)``."""
        return self.centre.position(self.centre.s, -self.width_right)

    def widths(self, s: Floats) -> tuple[Vector, Vector]:
        """Distances from the centre line to the right and to the left border (m) at ``s`` (m, periodic)."""
        at, (places, right, left) = self.centre.wrapped(np.asarray(s, dtype=np.float64)), self._lap
        return np.interp(at, places, right), np.interp(at, places, left)

    @cached_property
    def _lap(self) -> tuple[Vector, Vector, Vector]:
        """Places of the centre line's points (m) and widths there, the first point once more at the end of a lap."""
        if not self.centre.closed:
            return self.centre.s, self.width_right, self.width_left
        right, left = (np.append(width, width[0]) for width in (self.width_right, self.width_left))
        return np.append(self.centre.s, self.length), right, left

    def project(self, points: npt.ArrayLike, near: npt.ArrayLike | None = None) -> tuple[Vector, Vector]:
        """Track position ``s`` (m) and lateral offset (m, positive left) of ``points``; see ``Line.project``."""
        return self.centre.project(points, near)

    def clearance(self, points: npt.ArrayLike) -> Vector:
        """Distance from ``points`` (m, shape ``(..., 2)``) to the nearer border (m), negative outside; ``(...)``."""
        return self.room(*self.project(points))

    def room(self, s: Floats, lateral: Floats) -> Vector:
        """The same for places that are known as ``s`` and ``lateral`` (m, positive left)."""
        right, left = self.widths(s)
        return np.minimum(left - lateral, right + lateral)

    def scaled(self, factor: float) -> Track:
        """The same track, ``factor`` times as large in both length and width."""
        if not factor > 0:
            raise TrackError(f"track {self.name}: scale {factor:g}; expected a positive number")
        return replace(
            self,
            centre=self.centre.scaled(factor),
            width_right=self.width_right * factor,
            width_left=self.width_left * factor,
        )


def load_track(name_or_path: str | Path) -> Track:
    """A built-in track by name, or one from a file of the racetrack-database format.

    Raises:
        TrackError: neither a file nor a built-in name, or the file is no track.
    """
    path = Path(name_or_path)
    if os.path.isfile(path):
        return read_track(path)
    if str(name_or_path) in LAYOUTS:
        layout = LAYOUTS[str(name_or_path)]()
        centre = Line(closed_loop(layout.segments, layout.spacing))
        half = np.full(len(centre.points), layout.width / 2)
        return Track(str(name_or_path), centre, half, half)
    raise TrackError(f"track '{name_or_path}' is neither a file nor a built-in name ({', '.join(sorted(LAYOUTS))})")


def read_track(path: str | Path) -> Track:
    """Reads ``x_m,y_m,w_tr_right_m,w_tr_left_m`` rows of a closed track or an open road.

    Points that repeat or overlap are left out, and coordinates that are rounded are smoothed; see :func:`mended`.

    Raises:
        TrackError: unreadable, other columns, a value that is not a number, or no track.
    """
    path = Path(path)
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise TrackError(f"{path}: cannot be read ({error})") from error
    rows: list[list[float]] = []
    for number, line in enumerate(lines, 1):
        cells = _BETWEEN.split(line.strip("# \t"))
        commented = line.startswith("#")
        if (commented and re.search("[,;\t]", line)) or (not commented and not rows and cells[0].isidentifier()):
            if tuple(cells) != CSV_COLUMNS:
                raise TrackError(f"{path}: columns {','.join(cells)}; expected {','.join(CSV_COLUMNS)}")
        elif line.strip() and not commented:
            rows.append(_numbers(cells, f"{path}: line {number}"))
    table = np.array(rows).reshape(-1, len(CSV_COLUMNS))
    try:
        table, notes, closed = mended(table)
        return Track(path.stem, Line(table[:, :2], closed), table[:, 2], table[:, 3], notes)
    except TrackError as error:
        raise TrackError(f"{path}: {error}") from error


def _numbers(cells: list[str], where: str) -> list[float]:
    if len(cells) != len(CSV_COLUMNS):
        raise TrackError(f"{where}: {len(cells)} values; expected {len(CSV_COLUMNS)} ({','.join(CSV_COLUMNS)})")
    try:
        values = [float(cell) for cell in cells]
    except ValueError as error:
        raise TrackError(f"{where}: '{','.join(cells)}'; expected four numbers") from error
    if not np.all(np.abs(values) <= LARGEST):
        raise TrackError(f"{where}: '{','.join(cells)}'; expected finite numbers of at most {LARGEST:g} m")
    return values


def _check_points(track: Track) -> None:
    points = track.centre.points
    if len(points) < MIN_POINTS:
        raise TrackError(f"track {track.name}: {len(points)} points; expected at least {MIN_POINTS}")
    repeated = np.flatnonzero(np.all(points == np.roll(points, -1, axis=0), axis=1))
    if len(repeated):
        k = repeated[0]
        raise TrackError(f"track {track.name}: points {k} and {(k + 1) % len(points)} are the same")
    for side in ("width_right", "width_left"):
        width = getattr(track, side)
        if len(width) != len(points):
            raise TrackError(f"track {track.name}: {len(width)} values of {side} for {len(points)} points")
        narrow = np.flatnonzero(~(width > 0))
        if len(narrow):
            k = narrow[0]
            raise TrackError(f"track {track.name}: {side} at point {k} is {width[k]:g} m; expected more than 0")
        if (widest := float(width.max())) > _WIDEST:
            raise TrackError(
                f"track {track.name}: {side} is up to {widest:g} m: in mm or cm? expected at most {_WIDEST:g} m"
            )
    width = float(np.median(track.width_right + track.width_left))
    least, most = _SLENDER[0] * width, _SLENDER[1] * width
    if not least <= track.length <= most:
        mistake = "degrees, or km" if track.length < least else "mm or cm"
        raise TrackError(
            f"track {track.name}: its line is {track.length:.3g} m long where it is {width:.3g} m wide: x_m, y_m in "
            f"{mistake}? expected {least:.3g} to {most:.3g} m"
        )


def _check_borders(track: Track) -> None:
    """The road must not overlap itself. Inside a corner tighter than its half width a border folds; that is allowed."""
    s, length, N = track.centre.s, track.length, len(track.centre.steps)
    curvature = track.centre.curvature(s)
    for side, reach in (("left", curvature * track.width_left), ("right", -curvature * track.width_right)):
        if np.mean(reach > 1) > MAX_FOLDED:
            raise TrackError(
                f"track {track.name}: borders cross: the {side} border runs backwards along {np.mean(reach > 1):.0%} of "
                "the lap; expected a half width below the radius of the corners"
            )
    borders = (track.left_border, track.right_border)
    start = np.concatenate([border[:N] for border in borders])
    end = np.concatenate([np.roll(border, -1, axis=0)[:N] for border in borders])
    i, j = _crossings(start, end)
    apart = np.abs(s[i % N] - s[j % N])
    apart = np.minimum(apart, length - apart) if track.centre.closed else apart
    full_width = track.width_left[i % N] + track.width_right[i % N]
    bad = np.flatnonzero((i // N != j // N) | (apart > 1.5 * full_width))
    if len(bad):
        k, m = i[bad[0]], j[bad[0]]
        raise TrackError(
            f"track {track.name}: borders cross near x = {start[k, 0]:.4g} m, y = {start[k, 1]:.4g} m "
            f"(points {k % N} and {m % N}); expected a road that does not overlap itself"
        )


def _crossings(start: Vector, end: Vector) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Pairs of segments ``start[k] - end[k]`` (shapes ``(M, 2)``) that properly cross."""
    longest = float(np.max(np.hypot(*(end - start).T)))
    pairs = cKDTree((start + end) / 2).query_pairs(longest, output_type="ndarray")
    i, j = pairs[:, 0], pairs[:, 1]

    def side(a: Vector, b: Vector, p: Vector) -> Vector:
        return np.asarray(
            (b[:, 0] - a[:, 0]) * (p[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (p[:, 0] - a[:, 0]), dtype=np.float64
        )

    a, b, c, d = start[i], end[i], start[j], end[j]
    crossing = (side(a, b, c) * side(a, b, d) < 0) & (side(c, d, a) * side(c, d, b) < 0)
    return i[crossing], j[crossing]
