"""Rollouts: each predicted state is fed back into the window, corrected by what an online layer knows at the start.

The live horizon, the comparison of live paths, the evaluation and the decision on a network in training all step this way.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.runtime.contract import WindowModel, WindowPrediction
from dynssm_ros.runtime.online import Learned, OnlineLayer, Seen
from dynssm_ros.vehicle.kinematics import path

Step = Callable[[Vector], Vector]
"""From windows ``(N, H, 7)`` to the states of the next rows ``(N, 3)`` (m/s, m/s, rad/s)."""


class RolloutCorrection:
    """Corrections of the successive steps of ``N`` rollouts by an online layer.

    The first step is the layer's own; the others follow :meth:`OnlineLayer.in_rollout`.

    Args:
        layer: the model's.
        learned: at the last measured row of each rollout.
    """

    def __init__(self, layer: OnlineLayer, learned: Learned) -> None:
        self.layer = layer
        self.learned = learned
        self.steps = 0
        """Taken so far."""
        self._mean_error: Vector | None = None

    def increments(self, seen: Seen) -> Vector:
        """Increments ``(N, 3)`` (m/s, m/s, rad/s) of the next step, from what the layer sees there."""
        if self._mean_error is None:
            self._mean_error = self.layer.mean_error(seen.features)
            moved = self.layer.increments(seen.features, self.learned.weights)
        else:
            moved = self.layer.in_rollout(seen, self.learned, self._mean_error, self.steps)
        self.steps += 1
        return moved

    def corrected(self, prediction: WindowPrediction, windows: Vector) -> WindowPrediction:
        """A model's prediction of the next step from ``windows`` ``(N, H, 7)``, as the layer has it."""
        assert prediction.seen is not None
        layer, now = self.layer, windows[:, -1, :3]
        increments = self.increments(prediction.seen)
        state = np.where(layer.acts(now[:, :1]), now + increments, prediction.state)
        variance = self.learned.variance * layer.scale**2
        if prediction.variance is not None:
            variance = np.where(now[:, :1] >= layer.least, variance, prediction.variance)
        return prediction._replace(state=state, variance=variance, theta=self.learned.theta)

    def believed(self, trusted: bool) -> RolloutCorrection:
        """A copy that goes on from here, with the layer's paths believed or not."""
        copied = copy.copy(self)
        copied.learned = self.learned._replace(trusted=np.full(len(self.learned.trusted), float(trusted)))
        return copied


def step_of(model: WindowModel, correction: RolloutCorrection | None = None) -> Step:
    """The steps of a model's rollouts, with or without its online layer."""

    def step(windows: Vector) -> Vector:
        predicted = model.predict(windows)
        return predicted.state if correction is None else correction.corrected(predicted, windows).state

    return step


def states_ahead(step: Step, rows: Vector, H: int) -> Iterator[Vector]:
    """Predicted states ``(N, 3)``, step by step.

    Args:
        step: predicts them.
        rows: ``H`` measured rows, then those to be predicted, ``(N, H + steps, 7)``. Their states are overwritten. The
            inputs of a predicted row are read at the step after it.
        H: rows of a window.
    """
    for k in range(H, rows.shape[1]):
        rows[:, k, :3] = step(rows[:, k - H : k])
        yield rows[:, k, :3]


def roll_out(step: Step, rows: Vector, H: int) -> Vector:
    """All states of :func:`states_ahead`, ``(N, steps, 3)``; ``rows`` stay as they are."""
    rows = rows.copy()
    for _ in states_ahead(step, rows, H):
        pass
    return rows[:, H:, :3]


def path_errors(start: Vector, predicted: Vector, measured: Vector, T_s: float) -> Vector:
    """Distances (m) of predicted from measured paths, both from the same pose, ``(N, steps)``.

    Args:
        start: states at the start, ``(N, 1, 3)``.
        predicted: states after it, ``(N, steps, 3)``.
        measured: states after it, ``(N, steps, 3)``.
        T_s: time between states (s).
    """
    driven, there = (path(np.concatenate([start, states], axis=1), T_s) for states in (predicted, measured))
    distances: Vector = np.linalg.norm(driven - there, axis=-1)
    return distances
