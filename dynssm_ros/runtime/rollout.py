"""Rollouts: each predicted state is fed back into the window, corrected by what an online layer knows at the start.

The live horizon, the comparison of live paths, the evaluation and the decision on a network in training all step this way.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from dynssm_ros import compiled
from dynssm_ros.arrays import Vector
from dynssm_ros.compiled import address
from dynssm_ros.runtime.contract import WindowModel, WindowPrediction
from dynssm_ros.runtime.features import LayerFeatures
from dynssm_ros.runtime.online import CHANNELS, MEAN_ERROR, Learned, OnlineLayer, Seen
from dynssm_ros.vehicle.kinematics import PATH_HORIZON_S, path

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
        self._start: Vector | None = None  # features of the first step
        self._mean_error: Vector | None = None

    def increments(self, seen: Seen) -> Vector:
        """Increments ``(N, 3)`` (m/s, m/s, rad/s) of the next step, from what the layer sees there."""
        if self._start is None:
            self._start = seen.features
            moved = self.layer.increments(seen.features, self.learned.weights)
        else:
            if self._mean_error is None:
                self._mean_error = self.layer.mean_error(self._start)
            moved = self.layer.in_rollout(seen, self.learned, self._mean_error, self.steps)
        self.steps += 1
        return moved

    def corrected(self, prediction: WindowPrediction, windows: Vector) -> WindowPrediction:
        """A model's prediction of the next step from ``windows`` ``(N, H, 7)``, as the layer has it."""
        assert prediction.seen is not None
        layer, now = self.layer, windows[:, -1, :3]
        state, variance = now + self.increments(prediction.seen), self.learned.variance * layer.scale**2
        acts = layer.acts(now[:, :1])
        if not acts.all():
            state = np.where(acts, state, prediction.state)
            if prediction.variance is not None:
                variance = np.where(now[:, :1] >= layer.least, variance, prediction.variance)
        return WindowPrediction(state, self.learned.theta, prediction.physics, variance, prediction.seen)


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


class LayerRollout:
    """Rollouts of a model that is its physics and its online layer, by the compiled loop.

    Args:
        features: what the layer sees.
        layer: the model's.
        farthest: to which the absolute of states is limited, and NaN set (m/s, rad/s); ``None``: states are as they come, and
            the physics' alone where the layer does not act.
    """

    def __init__(self, features: LayerFeatures, layer: OnlineLayer, farthest: float | None = None) -> None:
        self._features, self._layer, self._farthest = features, layer, farthest
        self._structures: dict[tuple[int, int], compiled.RolloutStructure | None] = {}

    def roll_out(self, rows: Vector, H: int, learned: Learned) -> bool:
        """Predicts the states of ``rows`` ``(N, H + steps, 7)`` after the first ``H``, in place.

        ``learned`` is what was known at the start. Returns whether that could be done; else nothing has changed.
        """
        library = compiled.LIBRARY
        structure = None if library is None else self._structure(H, rows.shape[1] - H)
        if library is None or structure is None:
            return False
        assert rows.flags.c_contiguous
        known = [np.ascontiguousarray(each) for each in (learned.weights, learned.limit, learned.trusted)]
        library.dynssm_rollout(structure.address, address(rows), len(rows), *map(address, known))
        return True

    def _structure(self, H: int, steps: int) -> compiled.RolloutStructure | None:
        if (H, steps) in self._structures:
            return self._structures[H, steps]
        layer, layout, structure = self._layer, self._features.layout, None
        features = None if layout.network else self._features.structure(H)
        if features is not None:
            n, structure = len(layout.names), compiled.RolloutStructure()
            structure.fill(
                features=features, steps=steps, mean_error=layout.names.index(MEAN_ERROR),
                judged=self._farthest is not None, far=self._farthest or 0.0, minimum_speed=layer.minimum_speed,
                least=layer.least, fading=layer.T_s / PATH_HORIZON_S,
                moved=np.zeros((compiled.LANES, layout.errors + steps, CHANNELS)), now=np.zeros((CHANNELS, n)),
                constant=np.zeros((compiled.LANES, CHANNELS)),
            )  # fmt: skip
        self._structures[H, steps] = structure
        return structure


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
