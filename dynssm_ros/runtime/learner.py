"""What a predictor learns online: each step of T_s once, whatever the rate of its odometry."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.runtime.contract import WindowPrediction, seen_by
from dynssm_ros.runtime.online import CHANNELS, Learned, OnlineLayer, OnlineState, Seen
from dynssm_ros.runtime.onnx_model import OnnxModel
from dynssm_ros.runtime.path_judge import PathJudge
from dynssm_ros.runtime.rollout import corrected
from dynssm_ros.signals.history import Refusal

Cut = Callable[[int], Vector | Refusal]
"""From a stamp (ns) to the window ``(H, 7)`` that ends there, or why there is none."""


class OnlineLearner:
    """The online layer of a model along a drive: what it has learned, and whether its paths are believed.

    The grid is that of the odometry where its rate is 1 / T_s. Else rows between the messages are cut from the history.
    Gaps and rows slower than the minimum speed teach nothing; after them the grid starts anew.

    Args:
        model: predicts the windows.
        layer: the model's.
        judges: whether paths are judged, on which rollouts hang.
    """

    def __init__(self, model: OnnxModel, layer: OnlineLayer, judges: bool = True) -> None:
        self.model = model
        self.layer = layer
        self.state: OnlineState = layer.start()
        self.judge = PathJudge(layer)
        self._judges = judges
        self._period = round(layer.T_s * 1e9)
        self._row: _Row | None = None
        self._known: Learned | None = None
        self._mean_error: Vector | None = None
        self._unjudged: tuple[Vector, Seen, Learned] | None = None

    def continued_with(self, model: OnnxModel) -> OnlineLearner:
        """The learner of ``model``, which has the same prior: what was learned is kept, and the grid starts anew."""
        self.judge_paths()
        self.model, self._row = model, None
        return self

    def reset(self) -> None:
        """Forgets the drive."""
        self.state.reset()
        self.judge.reset()
        self._row = self._unjudged = None

    def corrected(self, stamp: int, window: Vector, predicted: WindowPrediction, cut: Cut) -> WindowPrediction:
        """Learns up to the row at ``stamp`` (ns), and corrects what the model predicts from it.

        Args:
            stamp: of the window's last row.
            window: ``(H, 7)``.
            predicted: by the model, from ``window``.
            cut: gives the windows of other rows. They may use the memory of ``window``.
        """
        assert predicted.seen is not None
        self._learn(stamp, window, predicted, _beside(window, cut))
        self._known = self.learned(predicted.seen)
        self._mean_error = self.layer.mean_error(predicted.seen.features)
        return corrected(predicted, window[None], self.layer, self._known)

    def in_rollout(self, window: Vector, predicted: WindowPrediction, step: int) -> WindowPrediction:
        """Corrects what the model predicts ``step`` steps into a rollout from the row that was corrected last."""
        assert self._known is not None
        self.judge_paths()
        known = self._known._replace(trusted=np.array([float(self.judge.trusted)]))
        return corrected(predicted, window[None], self.layer, known, self._mean_error, step)

    def judge_paths(self) -> None:
        """Takes the paths that are under way to the row that was learned last.

        Only rollouts hang on it, and it runs the model. So it is done when a rollout or the next row asks for it, or
        before, once the prediction is out.
        """
        if self._unjudged is not None:
            self.judge.step(*self._unjudged, lambda windows: seen_by(self.model, windows))
            self._unjudged = None

    def _learn(self, stamp: int, window: Vector, predicted: WindowPrediction, cut: Cut) -> None:
        slack = self._period // 100
        row, self._row = self._row, None
        while row is not None and row.stamp + self._period <= stamp + slack:
            due = row.stamp + self._period
            if due >= stamp - slack:
                row = self._learned_row(row, stamp, window, predicted, cut)
                break
            earlier = cut(due)
            if isinstance(earlier, Refusal):
                row = None
            else:
                row = self._learned_row(row, due, earlier, self.model.predict(earlier[None]), cut)
        self._row = row or self._first_row(stamp, window, predicted)

    def _learned_row(
        self, before: _Row, stamp: int, window: Vector, predicted: WindowPrediction, cut: Cut
    ) -> _Row | None:
        """Learns the step that ends with ``window``; returns its last row, ``None`` if the car was too slow there."""
        row = self._row_of(stamp, window, predicted)
        if row is not None:
            before = self._completed(before, window[-2], cut)
            self.state.update(before.seen, before.values, window[-1, :3] - window[-2, :3])
            self._to_be_judged(window, predicted)
        return row

    def _completed(self, row: _Row, now: Vector, cut: Cut) -> _Row:
        """``row`` with inputs that came after its odometry; till then the last ones before were held.

        Args:
            row: as it was when its odometry came.
            now: about the same row, as it is known now, ``(7,)``.
            cut: as of :meth:`corrected`.
        """
        if np.array_equal(now[CHANNELS:], row.values[CHANNELS:]):
            return row
        window = cut(row.stamp)
        if isinstance(window, Refusal) or np.array_equal(window[-1], row.values):
            return row
        return self._row_of(row.stamp, window, self.model.predict(window[None])) or row

    def _first_row(self, stamp: int, window: Vector, predicted: WindowPrediction) -> _Row | None:
        """The first row of a grid, ``None`` if the car is too slow."""
        self.state.interrupt()
        self.judge_paths()
        self.judge.interrupt()
        row = self._row_of(stamp, window, predicted)
        if row is not None:
            self._to_be_judged(window, predicted)
        return row

    def _to_be_judged(self, window: Vector, predicted: WindowPrediction) -> None:
        """Keeps a row for :meth:`judge_paths`."""
        if not self._judges:
            return
        assert predicted.seen is not None
        self.judge_paths()
        self._unjudged = window.copy(), predicted.seen, self.learned(predicted.seen)

    def _row_of(self, stamp: int, window: Vector, predicted: WindowPrediction) -> _Row | None:
        """The last row of ``window``; ``None`` if the car was slower than the layer's minimum speed within it."""
        if not window[:, 0].min() >= self.layer.minimum_speed:
            return None
        assert predicted.seen is not None
        return _Row(stamp, Seen(predicted.seen.features[0], predicted.seen.physics[0]), window[-1].copy())

    def learned(self, seen: Seen) -> Learned:
        """What is known now, for a prediction from one window."""
        state = self.state
        return Learned(
            state.mean[None],
            state.variance(seen.features[0])[None],
            state.limit[None],
            state.coefficients.theta[None],
            np.array([float(self.judge.trusted)]),
        )


def _beside(window: Vector, cut: Cut) -> Cut:
    """``cut`` that leaves ``window`` as it is."""

    def beside(stamp: int) -> Vector | Refusal:
        kept = window.copy()
        found = cut(stamp)
        if not isinstance(found, Refusal):
            found = found.copy()
        window[...] = kept
        return found

    return beside


class _Row(NamedTuple):
    """A row that the layer has yet to see the next one of."""

    stamp: int
    seen: Seen
    values: Vector
