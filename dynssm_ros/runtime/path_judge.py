"""Whether the online layer's paths are believed: it and the plainest correction predict side by side, and are compared.

Beyond one step the layer feeds on its own predictions. That filters noise and follows lags that the physics lacks, but on a
car that has changed it can lead astray. So two rollouts are always under way from the same row: one by the layer, one by
the physics less its mean error at the start. Each measured row takes them a step further. At the end of the horizon both
paths are compared with the measured one. Where the plain one has been better lately, paths are predicted by it.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from dynssm_ros.arrays import Indices, Vector
from dynssm_ros.runtime.comparison import RunningComparison
from dynssm_ros.runtime.features import LayerFeatures
from dynssm_ros.runtime.online import Learned, OnlineLayer, Seen
from dynssm_ros.runtime.rollout import LayerRollout, RolloutCorrection, Step, path_errors, states_ahead
from dynssm_ros.vehicle import State
from dynssm_ros.vehicle.kinematics import PATH_HORIZON_S, SCALAR, Pose, advance_pose

_MARGIN = 0.1  # the plain path must be better by a tenth
_FAR = 1e6  # m/s: states beyond it count as that large
_START = Pose(0.0, 0.0, 0.0)

See = Callable[[Vector], Seen]
"""From windows ``(N, H, 7)`` to what the layer sees of them."""


def path_steps(layer: OnlineLayer) -> int:
    """Steps of the paths that are compared."""
    return max(1, round(PATH_HORIZON_S / layer.T_s))


class PathJudge:
    """Compares paths over ``PATH_HORIZON_S``, one pair at a time.

    Args:
        layer: the model's.
        see: the model's graph.
        features: what the layer sees, if nothing but physics and layer predicts.
    """

    def __init__(self, layer: OnlineLayer, see: See, features: LayerFeatures | None = None) -> None:
        self._layer = layer
        self._see = see
        self._rollout = None if features is None else LayerRollout(features, layer, _FAR)
        self.steps = path_steps(layer)
        self.reset()

    def reset(self) -> None:
        """Forgets all paths."""
        self.comparison = RunningComparison(1)
        """Of the layer's path, with the plain one as the reference."""
        self._last: int | None = None
        self.interrupt()

    def interrupt(self) -> None:
        """Drops the paths under way: the next row does not follow on the last one."""
        self._pair: _Pair | None = None

    @property
    def trusted(self) -> bool:
        """Whether paths are predicted by the layer."""
        return bool(self.comparison.advantage[0] > -_MARGIN)

    def step(self, window: Vector, seen: Seen, learned: Learned) -> None:
        """Takes the next measured row.

        Args:
            window: that ends with it, ``(H, 7)``.
            seen: what the layer sees of it, ``N = 1``.
            learned: what the layer has learned up to there, ``N = 1``.
        """
        if self._pair is not None:
            own, plain = self._pair.advance(window)
            if self._pair.steps < self.steps:
                return
            self.comparison.add(plain, [own])
        self._pair = _Pair(self._layer, self._see, window, seen, learned)

    def along(self, windows: Vector, ends: Indices, learned: Learned, seen: Seen) -> Vector:
        """Whether paths were to be predicted by the layer, at rows that a recording was driven through, ``(N,)``.

        Args:
            windows: that end at the rows, ``(N, H, 7)``.
            ends: rows, ascending and after those of the last call, ``(N,)``.
            learned: what was known there.
            seen: what the layer saw there.
        """
        trusted, k = np.ones(len(ends)), 0
        while k < len(ends):
            if self._last != ends[k] - 1:
                self.interrupt()
            at, self._last = np.array([k]), int(ends[k])
            self.step(windows[k], seen.at(at), learned.at(at))
            trusted[k] = self.trusted
            begun = self._pair is not None and self._pair.steps == 0
            pairs = (_unbroken(ends[k:]) - 1) // self.steps if begun else 0
            if pairs == 0:
                k += 1
                continue
            self.interrupt()
            starts = k + self.steps * np.arange(pairs)
            for start, (own, plain) in zip(starts, self._distances(windows, starts, learned, seen), strict=True):
                trusted[start : start + self.steps] = self.trusted
                self.comparison.add(plain, [own])
            k = int(starts[-1]) + self.steps
            self._last = int(ends[k]) - 1
        return trusted

    def _distances(self, windows: Vector, starts: Indices, learned: Learned, seen: Seen) -> list[list[float]]:
        """Sums of both paths' distances from the measured one (m), for pairs from ``starts`` on, all at once."""
        both, H, count = np.repeat(starts, 2), windows.shape[1], len(starts)
        ahead = windows[starts[:, None] + np.arange(1, self.steps + 1), -1]  # measured, (P, steps, 7)
        rows = np.repeat(np.concatenate([windows[starts], ahead], axis=1), 2, axis=0)
        known = learned.at(both)._replace(trusted=np.tile([1.0, 0.0], count))
        if self._rollout is None or not self._rollout.roll_out(rows, H, known):
            step = _pair_steps(self._layer, self._see, seen.at(both), known)
            for _ in states_ahead(step, rows, H):
                pass
        predicted, start = rows[:, H:, :3], rows[:, H - 1 : H, :3]
        distances = path_errors(start, predicted, np.repeat(ahead[..., :3], 2, axis=0), self._layer.T_s)
        sums: list[list[float]] = distances.sum(axis=1).reshape(count, 2).tolist()
        return sums


def _unbroken(ends: Indices) -> int:
    """Rows until the first gap."""
    gaps = np.flatnonzero(np.diff(ends) != 1)
    return int(gaps[0]) + 1 if len(gaps) else len(ends)


def _pair_steps(layer: OnlineLayer, see: See, start: Seen, learned: Learned) -> Step:
    """The steps of pairs of rollouts, each by the layer and by the physics less its mean error, as ``trusted`` says.

    Args:
        layer: the model's.
        see: the model's graph.
        start: what the layer sees of the first windows, each twice, ``N = 2 P``.
        learned: what is known there, likewise.
    """
    correction = RolloutCorrection(layer, learned)

    def step(windows: Vector) -> Vector:
        moved = correction.increments(see(windows) if correction.steps else start)
        return np.clip(np.nan_to_num(windows[:, -1, :3] + moved, nan=_FAR), -_FAR, _FAR)

    return step


class _Pair:
    """Two rollouts under way from the same row, by the layer and by the physics less its mean error."""

    def __init__(self, layer: OnlineLayer, see: See, window: Vector, seen: Seen, learned: Learned) -> None:
        both = np.zeros(2, dtype=np.intp)
        known = learned.at(both)._replace(trusted=np.array([1.0, 0.0]))
        step = _pair_steps(layer, see, seen.at(both), known)
        self._T_s = layer.T_s
        self._H = len(window)
        self._rows = np.zeros((2, self._H + path_steps(layer), window.shape[1]))
        self._rows[:, : self._H] = window
        self._states = states_ahead(step, self._rows, self._H)
        self.steps = 0
        self._poses = [_START] * 3  # the layer's, the plain and the measured one
        self._distances = [0.0, 0.0]

    def advance(self, window: Vector) -> tuple[float, float]:
        """Follows the measured ``window`` ``(H, 7)``; returns the sums of both paths' distances from the measured one (m)."""
        next(self._states)
        last = self._H + self.steps
        self._rows[:, last, 3:] = window[-1, 3:]
        self.steps += 1
        moves = np.concatenate([self._rows[:, last - 1 : last + 1, :3], window[None, -2:, :3]]).tolist()
        self._poses = [
            advance_pose(SCALAR, pose, State(*before), State(*after), self._T_s)
            for pose, (before, after) in zip(self._poses, moves, strict=True)
        ]
        own, plain, there = self._poses
        self._distances[0] += math.hypot(own.x - there.x, own.y - there.y)
        self._distances[1] += math.hypot(plain.x - there.x, plain.y - there.y)
        return self._distances[0], self._distances[1]
