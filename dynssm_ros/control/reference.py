"""What the controller follows: a closed line and how fast it is driven, by arc length or by time."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt

from dynssm_ros.simulation.lines import ClosedLine, Floats
from dynssm_ros.simulation.racing_line import line_of
from dynssm_ros.simulation.speed_profile import speed_profile, vehicle_limits
from dynssm_ros.simulation.tracks import Track, TrackError
from dynssm_ros.vehicle import Vehicle

Vector = npt.NDArray[np.float64]

COLUMNS = ("s_m", "x_m", "y_m", "v_mps")
MIN_POINTS = 10


@dataclass(frozen=True, eq=False)
class Reference:
    """A closed line with the speed at its points.

    Attributes:
        name: ``centre``, ``racing`` or the file that it came from.
        line: where to drive.
        speed: at the points of the line (m/s), shape ``(N,)``. One of them may be 0 (a standing start).
    """

    name: str
    line: ClosedLine
    speed: Vector

    @property
    def lap_time(self) -> float:
        """Time of a lap at the line's own speed (s)."""
        return float(self._time[-1])

    def speed_at(self, s: Floats) -> Vector:
        """Speed (m/s) at ``s`` (m, periodic)."""
        return np.asarray(np.interp(s, self.line.s, self.speed, period=self.line.length))

    def ahead(self, s: float, times: Vector) -> Vector:
        """Arc lengths (m, in ``[0, length)``) that are reached ``times`` (s) after ``s`` at the line's own speed."""
        start = np.interp(s % self.line.length, self._grid, self._time)
        return np.asarray(np.interp((start + times) % self.lap_time, self._time, self._grid))

    @cached_property
    def _grid(self) -> Vector:
        return np.append(self.line.s, self.line.length)

    @cached_property
    def _time(self) -> Vector:
        """Time at which each point of the grid is reached (s); the speed changes linearly between points."""
        speed = np.append(self.speed, self.speed[0])
        return np.concatenate([[0.0], np.cumsum(2 * np.diff(self._grid) / (speed[1:] + speed[:-1]))])


def load_reference(name_or_path: str, vehicle: Vehicle, track: Track, pace: float = 1.0) -> Reference:
    """The line to follow.

    Args:
        name_or_path: ``centre`` or ``racing``, driven as fast as ``vehicle`` can; or a file ``s_m,x_m,y_m,v_mps``, driven
            at its own speed.
        vehicle: whose limits and size count.
        track: where.
        pace: share of the car's accelerations that the profile asks for; of a file, factor on its speed.

    Raises:
        TrackError: neither of the names nor a file; a file that is no line; a road that is too narrow for the car.
    """
    path = Path(name_or_path)
    if path.is_file():
        return _read(path, pace)
    if name_or_path not in ("centre", "racing"):
        raise TrackError(f"line '{name_or_path}' is neither centre, racing nor a file {','.join(COLUMNS)}")
    line = line_of("centre" if name_or_path == "centre" else "racing", vehicle, track)
    return Reference(name_or_path, line, speed_profile(line, vehicle_limits(vehicle).scaled(pace)))


def _read(path: Path, pace: float) -> Reference:
    """A line from a file; a last row that closes the loop is left out."""
    try:
        table = np.loadtxt(path, delimiter=",", comments="#", ndmin=2)
    except (OSError, ValueError) as error:
        raise TrackError(f"{path}: cannot be read as {','.join(COLUMNS)} ({' '.join(str(error).split())})") from error
    if table.shape[1] != len(COLUMNS) or len(table) < MIN_POINTS or not np.all(np.isfinite(table)):
        raise TrackError(
            f"{path}: {len(table)} rows of {table.shape[1]} values; expected at least {MIN_POINTS} rows of finite "
            f"{','.join(COLUMNS)}"
        )
    points, speed = table[:, 1:3], table[:, 3] * pace
    steps = np.hypot(*np.diff(points, axis=0).T)
    if np.hypot(*(points[-1] - points[0])) < np.min(steps) / 2:
        points, speed, steps = points[:-1], speed[:-1], steps[:-1]
    if np.min(steps) == 0 or np.min(speed) < 0 or np.any((speed + np.roll(speed, 1)) == 0):
        raise TrackError(f"{path}: points or speeds that stand still; expected a line that moves on from row to row")
    return Reference(path.stem, ClosedLine(points), speed)
