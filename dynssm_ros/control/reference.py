"""What the controller follows: a line and how fast it is driven, by arc length or by time."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt

from dynssm_ros.arrays import Vector
from dynssm_ros.track.centre_points import TrackError
from dynssm_ros.track.lines import Floats, Line
from dynssm_ros.track.racing_line import line_of
from dynssm_ros.track.speed_profile import speed_profile
from dynssm_ros.track.tracks import Track
from dynssm_ros.vehicle import Vehicle
from dynssm_ros.vehicle.limits import Limits, vehicle_limits

COLUMNS = ("s_m", "x_m", "y_m", "v_mps")
MIN_POINTS = 10
_RUN_UP = 0.1  # share of the lap before a line's first point from which a drive begins with that point


@dataclass(frozen=True, eq=False)
class Reference:
    """A line with the speed at its points.

    A line whose first speed is 0 is that of one lap from a standing start. Such a line, and an open one, end at the speed of
    their last point, and what follows is driven at that. Places on a closed line (m) count on over the laps.
    """

    name: str  # centre, racing or the file that it came from
    line: Line
    speed: Vector  # at the points of the line (m/s), (N,)
    limits: Limits | None = None  # of the car that follows it; None: it can do anything
    share: float | None = None  # of the limits' accelerations that the speed asks for, if it is the same everywhere
    terminal_speed: Vector | None = None  # greatest at the points from which the car can go on (m/s), (N,); None: speed

    @classmethod
    def within(cls, name: str, line: Line, limits: Limits, share: float | Vector) -> Reference:
        """A line as fast as a car within ``limits`` drives it with a ``share`` of its accelerations, of all points or
        ``(N,)``.
        """
        speed, terminal_speed = (speed_profile(line, limits, share, reached=reached) for reached in (True, False))
        return cls(name, line, speed, limits, None if isinstance(share, np.ndarray) else share, terminal_speed)

    @property
    def standing(self) -> bool:
        """Whether it starts from standstill."""
        return bool(self.speed[0] == 0)

    @property
    def once(self) -> bool:
        """Whether it is for one passage, from its first point to its end."""
        return self.standing or not self.line.closed

    @property
    def lap_time(self) -> float:
        """Time of a lap at the line's own speed (s)."""
        return float(self._time[-1])

    @cached_property
    def full_throttle_time(self) -> float:
        """Time of a lap (s) at the line's own speed as far as full throttle reaches that.

        The car is taken to corner and to brake as well as the line asks, so no car of these limits is faster on it.
        """
        if self.limits is None:
            return self.lap_time
        speed, steps = self._grid_speed.copy(), np.diff(self._grid)
        for _ in range(1 if self.once else 2):  # around once more to meet the speed at the start
            for k, step in enumerate(steps):
                gain = float(np.interp(speed[k], self.limits.speed, self.limits.drive))
                speed[k + 1] = min(speed[k + 1], float(np.sqrt(speed[k] ** 2 + 2 * gain * step)))
            if not self.once:
                speed[0] = speed[-1]
        return float(np.sum(2 * steps / (speed[1:] + speed[:-1])))

    def project(self, points: npt.ArrayLike, near: Floats | None = None) -> Vector:
        """Places of ``points`` (m, shape ``(..., 2)``) on the line, ``(...)``, searched around and counted on from
        ``near`` (m).

        Without ``near`` they are on the first lap, just before its start rather than at its end.
        """
        s, length = self.line.project(points, near)[0], self.line.length
        if not self.line.closed:
            return s
        around = length * (0.5 - _RUN_UP) if near is None else near
        return np.asarray(s + length * np.round((around - s) / length))

    def speed_at(self, s: Floats) -> Vector:
        """Speed (m/s) at ``s`` (m)."""
        return self._at(s, self._grid_speed)

    def terminal_speed_at(self, s: Floats) -> Vector:
        """Greatest speed (m/s) at ``s`` (m) from which the car can go on."""
        return self._at(s, self._grid_terminal_speed)

    def _at(self, s: Floats, values: Vector) -> Vector:
        """``values`` of the grid at ``s`` (m)."""
        return np.asarray(np.interp(s if self.once else s % self.line.length, self._grid, values))

    def within_reach(self, s: float, times: Vector, v: float, scheduled: float | None = None) -> Vector:
        """Places (m) that a car with speed ``v`` (m/s) at ``s`` (m) is to reach after ``times`` (s).

        They are those of :meth:`ahead` from where it is or is ``scheduled`` to be now (m), but none beyond what full
        throttle reaches: a car that is asked for more, as at a standing start, would take every short cut.
        """
        places = self.ahead(s if scheduled is None else scheduled, times)
        if self.limits is None:
            return places
        gain = float(np.interp(v, self.limits.speed, self.limits.drive))
        return np.minimum(places, s + v * times + gain / 2 * times**2)

    def ahead(self, s: float, times: Vector) -> Vector:
        """Places (m) that are reached ``times`` (s) after ``s`` (m) at the line's own speed."""
        length = self.line.length
        laps = 0.0 if self.once else np.floor(s / length)
        at = np.interp(s - laps * length, self._grid, self._time) + times
        over, rest = (0.0, at) if self.once else np.divmod(at, self.lap_time)
        beyond = np.maximum(rest - self.lap_time, 0.0) * self._grid_speed[-1]
        return np.asarray((laps + over) * length + np.interp(rest, self._time, self._grid) + beyond)

    @cached_property
    def _grid(self) -> Vector:
        return np.append(self.line.s, self.line.length) if self.line.closed else self.line.s

    @cached_property
    def _grid_speed(self) -> Vector:
        if not self.line.closed:
            return self.speed
        return np.append(self.speed, self.speed[-1 if self.standing else 0])

    @cached_property
    def _grid_terminal_speed(self) -> Vector:
        if self.terminal_speed is None:
            return self._grid_speed
        if not self.line.closed:
            return self.terminal_speed
        return np.append(self.terminal_speed, self.terminal_speed[0])

    @cached_property
    def _time(self) -> Vector:
        """Time at which each point of the grid is reached (s); the speed changes linearly in time between points."""
        speed = self._grid_speed
        return np.concatenate([[0.0], np.cumsum(2 * np.diff(self._grid) / (speed[1:] + speed[:-1]))])


def load_reference(name_or_path: str, vehicle: Vehicle, track: Track, speed_scale: float = 1.0) -> Reference:
    """The line to follow.

    Args:
        name_or_path: ``centre`` or ``racing``, driven as fast as ``vehicle`` can; or a file ``s_m,x_m,y_m,v_mps``, driven
            at its own speed.
        vehicle: whose limits and size count.
        track: where.
        speed_scale: share of the car's accelerations that the profile asks for; of a file, factor on its speed.

    Raises:
        TrackError: neither of the names nor a file; a file that is no line; a road that is too narrow for the car.
    """
    path, limits = Path(name_or_path), vehicle_limits(vehicle)
    if os.path.isfile(path):
        return _read(path, speed_scale, limits, track.centre.closed)
    if name_or_path not in ("centre", "racing"):
        raise TrackError(f"line '{name_or_path}' is neither centre, racing nor a file {','.join(COLUMNS)}")
    line = line_of("centre" if name_or_path == "centre" else "racing", vehicle, track)
    return Reference.within(name_or_path, line, limits, speed_scale)


def _read(path: Path, speed_scale: float, limits: Limits, closed: bool) -> Reference:
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
    points, speed = table[:, 1:3], table[:, 3] * speed_scale
    steps = np.hypot(*np.diff(points, axis=0).T)
    if closed and np.hypot(*(points[-1] - points[0])) < np.min(steps) / 2:
        points, speed, steps = points[:-1], speed[:-1], steps[:-1]
    if np.min(steps) == 0 or np.min(speed) < 0 or np.any((speed + np.roll(speed, 1)) == 0):
        raise TrackError(f"{path}: points or speeds that stand still; expected a line that moves on from row to row")
    return Reference(path.stem, Line(points, closed), speed, limits)
