"""Predictions corrected by the online layer, one step ahead and in a rollout."""

from __future__ import annotations

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.runtime.contract import WindowPrediction
from dynssm_ros.runtime.online import Learned, OnlineLayer


def corrected(
    prediction: WindowPrediction,
    windows: Vector,
    layer: OnlineLayer,
    learned: Learned,
    mean_error: Vector | None = None,
    step: int = 0,
) -> WindowPrediction:
    """A model's prediction with what its online layer had learned at each window.

    Args:
        prediction: of the model itself.
        windows: that it is from, ``(N, H, 7)``.
        layer: the model's.
        learned: at the last measured row of each window.
        mean_error: in a rollout, after its first step: the physics' mean error at the start, ``(N, 3)``.
        step: steps of the rollout so far.
    """
    seen, now = prediction.seen, windows[:, -1, :3]
    assert seen is not None
    if mean_error is None:
        increments = layer.increments(seen.features, learned.weights)
    else:
        increments = layer.in_rollout(seen, learned, mean_error, step)
    fast = (now[:, :1] >= layer.minimum_speed) | (layer.minimum_speed == 0.0)
    state = np.where(fast, now + increments, prediction.state)
    return prediction._replace(state=state, variance=learned.variance * layer.scale**2, theta=learned.theta)
