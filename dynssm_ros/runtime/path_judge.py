"""Whether the online layer's paths are to be believed: it and the plainest correction predict side by side, and are compared.

Beyond one step the layer feeds on its own predictions. That filters noise, and follows lags that the physics lacks, but on a
car that has changed it can lead astray. So two rollouts are always under way from the same row: one by the layer, one by
the physics less its mean error at the start. Each measured row takes them a step further. At the end of the horizon both
paths are compared with the measured one. Where the plain one has been better lately, paths are predicted by it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from dynssm_ros.arrays import Indices, Vector
from dynssm_ros.runtime.online import Learned, OnlineLayer, Seen
from dynssm_ros.vehicle import State
from dynssm_ros.vehicle.kinematics import PATH_HORIZON_S, SCALAR, Pose, advance_pose

_REMEMBERED = 20  # paths that the comparison is of
_MARGIN = 0.1  # the plain path must be better by a tenth
_LARGEST = 2.0  # a single path's logarithm counts as at most that
_NEAR, _FAR = 1e-12, 1e6  # m, and m/s: states beyond it count as that large
_START = Pose(0.0, 0.0, 0.0)

See = Callable[[Vector], Seen]
"""From windows ``(N, H, 7)`` to what the layer sees of them."""


class PathJudge:
    """Compares paths over ``PATH_HORIZON_S``, one pair at a time."""

    def __init__(self, layer: OnlineLayer) -> None:
        self.layer = layer
        self.steps = max(1, round(PATH_HORIZON_S / layer.T_s))
        self.reset()

    def reset(self) -> None:
        """Forgets all paths."""
        self.advantage = 0.0
        """Mean logarithm of the plain path's over the layer's distance from the measured path."""
        self.paths = 0
        self.interrupt()

    def interrupt(self) -> None:
        """Drops the paths under way: the next row does not follow on the last one."""
        self._pair: _Pair | None = None

    @property
    def trusted(self) -> bool:
        """Whether paths are predicted by the layer."""
        return self.advantage > -_MARGIN

    def step(self, window: Vector, seen: Seen, learned: Learned, see: See) -> None:
        """Takes the next measured row.

        Args:
            window: that ends with it, ``(H, 7)``.
            seen: what the layer sees of it, ``N = 1``.
            learned: what the layer has learned up to there, ``N = 1``.
            see: the model's graph.
        """
        pair = self._pair
        if pair is not None:
            pair.advance(window, self._moved(pair, see), self.layer.T_s)
            if pair.done == self.steps:
                self._compare(pair)
                pair = None
        if pair is None:
            both = np.zeros(2, dtype=np.intp)
            known = learned.at(both)._replace(trusted=np.array([1.0, 0.0]))
            start = Seen(*(part[both] for part in seen))
            self._pair = _Pair(np.tile(window, (2, 1, 1)), start, known, self.layer.mean_error(start.features))

    def _moved(self, pair: _Pair, see: See) -> Vector:
        """Increments ``(2, 3)`` of the layer's and the plain path."""
        if pair.done == 0:
            return self.layer.increments(pair.start.features, pair.learned.weights)
        return self.layer.in_rollout(see(pair.windows), pair.learned, pair.mean_error, pair.done)

    def _compare(self, pair: _Pair) -> None:
        own, plain = (max(float(distance), _NEAR) for distance in pair.distances)
        self.paths += 1
        one = min(max(math.log(plain / own), -_LARGEST), _LARGEST)
        self.advantage += (one - self.advantage) / min(self.paths, _REMEMBERED)


@dataclass
class _Pair:
    """Two rollouts under way."""

    windows: Vector
    """``(2, H, 7)``, the layer's and the plain one."""
    start: Seen
    """Of the row that they start from, twice."""
    learned: Learned
    """At that row: the layer's paths are believed in the first, and not in the second."""
    mean_error: Vector
    done: int = 0
    distances: Vector = field(default_factory=lambda: np.zeros(2))
    """Sums over the steps (m)."""
    poses: tuple[Pose, Pose] = (_START, _START)
    measured: Pose = _START

    def advance(self, window: Vector, moved: Vector, T_s: float) -> None:
        """Takes increments ``(2, 3)`` to the last row of the measured ``window``."""
        before = self.windows[:, -1, :3]
        rows = np.tile(window[-1], (2, 1))
        rows[:, :3] = np.clip(np.nan_to_num(before + moved, nan=_FAR), -_FAR, _FAR)
        self.windows = np.concatenate([self.windows[:, 1:], rows[:, None]], axis=1)
        first, second = (
            advance_pose(SCALAR, pose, State(*a), State(*b), T_s)
            for pose, a, b in zip(self.poses, before.tolist(), rows[:, :3].tolist(), strict=True)
        )
        self.poses = first, second
        there = State(*window[-2, :3].tolist()), State(*window[-1, :3].tolist())
        self.measured = advance_pose(SCALAR, self.measured, *there, T_s)
        self.distances += [math.hypot(p.x - self.measured.x, p.y - self.measured.y) for p in self.poses]
        self.done += 1


def trusted_along(
    judge: PathJudge,
    windows: Vector,
    ends: Indices,
    learned: Learned,
    seen: Seen,
    see: See,
    last: int | None = None,
) -> Vector:
    """Whether paths were to be predicted by the layer, at each of the rows ``ends`` that a recording was driven through.

    Args:
        judge: has judged up to there.
        windows: that end at the rows, ``(N, H, 7)``.
        ends: rows, ascending, ``(N,)``.
        learned: what was known there.
        seen: what the layer saw there.
        see: the model's graph.
        last: row that was judged last; ``None`` if none was.
    """
    out = np.ones(len(ends))
    for k, row in enumerate(ends.tolist()):
        if last != row - 1:
            judge.interrupt()
        at, last = np.array([k]), row
        judge.step(windows[k], Seen(seen.features[at], seen.physics[at]), learned.at(at), see)
        out[k] = judge.trusted
    return out
