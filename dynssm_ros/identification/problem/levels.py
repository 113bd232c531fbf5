"""At which level a cause may act: in all recordings of a car, in those of one road or of one session, or in one alone.

Recordings whose paths cover each other in the same direction are of one road. Those that follow each other within a few hours
are of one session: sensors, tyres and weather are then likely the same.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from dynssm_ros.arrays import Vector
from dynssm_ros.identification import tuning
from dynssm_ros.signals.recording import Recording

Group = tuple[int, ...]
"""Numbers of recordings; none: all."""
Level = Literal["car", "road", "session", "recording", "suspects"]


@dataclass(frozen=True)
class Levels:
    """Which recordings belong together, and which may differ from the others.

    Attributes:
        road: number of the road of each recording.
        session: number of the session of each recording.
        groups: recordings that may have something that the others have not.
        suspects: the one of these groups that was asked for, if one was.
    """

    road: tuple[int, ...] = (0,)
    session: tuple[int, ...] = (0,)
    groups: tuple[Group, ...] = ()
    suspects: Group = ()

    @classmethod
    def of(cls, recordings: Sequence[Recording], suspects: Group = ()) -> Levels:
        """By path and time stamps of each recording; only ``suspects`` may differ, if there are any."""
        road, session = (_clusters(recordings, each) for each in (_of_one_road, _of_one_session))
        if suspects:
            return cls(road, session, (suspects,), suspects)
        shared = [_members(numbers, k) for numbers in (session, road) for k in sorted(set(numbers))]
        groups = dict.fromkeys([(k,) for k in range(len(recordings))] + shared)
        return cls(road, session, tuple(group for group in groups if len(group) < len(recordings)))

    def level(self, group: Group) -> Level:
        """What a group is."""
        if not group:
            return "car"
        if group == self.suspects:
            return "suspects"
        if len(group) == 1:
            return "recording"
        return "session" if group == _members(self.session, self.session[group[0]]) else "road"

    def has_one_road(self, group: Group) -> bool:
        """Whether the recordings of a group share one road, so that what acts at a place may act in all of them."""
        return len({self.road[k] for k in group or range(len(self.road))}) == 1


ONE_RECORDING = Levels()


def _members(numbers: Sequence[int], number: int) -> Group:
    return tuple(k for k, own in enumerate(numbers) if own == number)


def _clusters(recordings: Sequence[Recording], together: Callable[[Recording, Recording], bool]) -> tuple[int, ...]:
    """Numbers of clusters of recordings of which each has another one that it belongs together with."""
    belong = np.eye(len(recordings))
    for one, other in combinations(range(len(recordings)), 2):
        belong[one, other] = together(recordings[one], recordings[other])
    return tuple(connected_components(belong, directed=False)[1].tolist())


def _of_one_session(one: Recording, other: Recording) -> bool:
    apart = max(int(one.time[0]) - int(other.time[-1]), int(other.time[0]) - int(one.time[-1]))
    return bool(apart < tuning.SESSION_PAUSE_H * 3600e9)


def _of_one_road(one: Recording, other: Recording) -> bool:
    """Whether two paths cover each other, in the same direction; without positions nothing tells roads apart."""
    if not (one.has_pose and other.has_pose):
        return True
    path, another = _path(one), _path(other)
    return min(_covered(path, another), _covered(another, path)) >= tuning.NEARLY_ALL


def _path(recording: Recording) -> tuple[Vector, Vector]:
    """Some positions (m) and headings as unit vectors, each ``(n, 2)``."""
    x, y, theta = (recording[name][:: max(1, len(recording) // tuning.PATH_POINTS)] for name in ("x", "y", "theta"))
    return np.stack([x, y], axis=1), np.stack([np.cos(theta), np.sin(theta)], axis=1)


def _covered(path: tuple[Vector, Vector], by: tuple[Vector, Vector]) -> float:
    """Share of the points of a path that another one passes, in the same direction."""
    (positions, along), (others, along_others) = path, by
    reach = tuning.BESIDE * float(np.hypot(*np.ptp(positions, axis=0)))
    near = cKDTree(others).query_ball_point(positions, reach)
    beside = (along_others[np.asarray(k, dtype=np.intp)] for k in near)
    passed = [np.max(each @ own, initial=-1.0) > tuning.ALIGNED for each, own in zip(beside, along, strict=True)]
    return float(np.mean(passed))
