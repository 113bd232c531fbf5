"""What an online layer learns from a drive, row after row, each one T_s after the last."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.runtime.contract import WindowPrediction, seen_by
from dynssm_ros.runtime.layer_step import LayerStep
from dynssm_ros.runtime.online import CHANNELS, Learned, OnlineLayer, OnlineState, Seen
from dynssm_ros.runtime.onnx_model import OnnxModel
from dynssm_ros.runtime.path_judge import PathJudge
from dynssm_ros.runtime.rollout import RolloutCorrection

_Row = tuple[Seen, Vector]
"""What the layer sees of a row, ``N = 1``, and its values ``(7,)``; the next one is yet to come."""
Recut = Callable[[], Vector | None]
"""The window ``(H, 7)`` of the last row as it is known now; ``None`` if it cannot be had any more."""


class OnlineLearner:
    """The online layer of a model along a drive: what it has learned, and whether its paths are believed.

    Rows at which the layer does not act teach nothing: slower than the minimum speed, or standing and backwards unless
    that was trained on.

    Args:
        model: predicts the windows.
        layer: the model's.
        judges: whether paths are judged, on which rollouts hang.
    """

    def __init__(self, model: OnnxModel, layer: OnlineLayer, judges: bool = True) -> None:
        self.layer = layer
        self.state: OnlineState = layer.start()
        self._judge = PathJudge(layer, self._see)
        self._judges = judges
        self._last: _Row | None = None
        self._unjudged: tuple[Vector, Seen, Learned] | None = None
        self._known: tuple[Seen, Learned] | None = None
        self._set_model(model)

    def continued_with(self, model: OnnxModel) -> OnlineLearner:
        """The learner of ``model``, which has the same prior: what was learned is kept."""
        self.judge_paths()
        self._last = None
        self._set_model(model)
        return self

    def _set_model(self, model: OnnxModel) -> None:
        self.model, features = model, model.layer_features
        self._compiled: LayerStep | None = None
        if features is not None:
            self._compiled = LayerStep(features, self.layer, np.array(model.card.covariance), model.H)

    def reset(self) -> None:
        """Forgets the drive."""
        self.state.reset()
        self._judge.reset()
        self._last = self._unjudged = self._known = None

    def interrupt(self) -> None:
        """The next row is not one T_s after the last one."""
        self._last = None

    def predict(
        self, window: Vector, recut: Recut | None = None, *, learns: bool = True
    ) -> tuple[WindowPrediction, bool]:
        """Learns the step from the last row to the next, and predicts the one after it; rollouts go on from there.

        Args:
            window: that ends with the next row, ``(H, 7)``.
            recut: gives the last row with inputs that came after its odometry; till then the last ones were held.
            learns: whether the next row is one T_s after the last one. Else it is only predicted from.

        Returns:
            What the model predicts, corrected by what was learned, and whether the row after it can be learned: the car
            was not too slow.
        """
        fast, last = learns and self._is_fast(window), None
        if learns:
            last = self._followed(window, fast, recut)
        said, known = self._step(window, last)
        assert said.seen is not None
        self._known = said.seen, known
        if fast:
            self._last = said.seen, window[-1]
            if self._judges:
                self._unjudged = window, said.seen, known
        return said, fast

    def _followed(self, window: Vector, fast: bool, recut: Recut | None) -> _Row | None:
        """The row that the last one of ``window`` follows on, if there is one."""
        self.judge_paths()
        last, self._last = self._last, None
        if last is None or not fast:
            self.state.interrupt()
            self._judge.interrupt()
            return None
        return self._completed(last, window[-2], recut)

    def _step(self, window: Vector, last: _Row | None) -> tuple[WindowPrediction, Learned]:
        """What is predicted from ``window``, and what is known there, after the step from ``last`` was learned."""
        if self._compiled is not None and self._compiled.is_possible:
            return self._compiled(self.state, window, last, self._judge.trusted)
        predicted = self.model.predict(window[None])
        assert predicted.seen is not None
        if last is not None:
            seen, row = last
            self.state.update(
                Seen(seen.features[0], seen.physics[0]), row, window[-1, :CHANNELS] - window[-2, :CHANNELS]
            )
        known = self.learned(predicted.seen)
        return RolloutCorrection(self.layer, known).corrected(predicted, window[None]), known

    def rollout(self) -> RolloutCorrection:
        """Corrects the steps after the one that was predicted last."""
        assert self._known is not None
        self.judge_paths()
        seen, known = self._known
        correction = RolloutCorrection(self.layer, known._replace(trusted=np.array([float(self._judge.trusted)])))
        correction.increments(seen)  # of the step that was predicted
        return correction

    def afresh(self) -> RolloutCorrection:
        """Corrects a rollout that begins anew, by what is known now."""
        self.judge_paths()
        nothing = np.zeros_like(self.state.mean)  # on features hangs the stated variance alone
        return RolloutCorrection(self.layer, self.state.learned(nothing, self._judge.trusted))

    def finish(self) -> None:
        """Does what can wait until the prediction is out; the next row does it else."""
        self.state.coefficients.finish()
        self.judge_paths()

    def judge_paths(self) -> None:
        """Takes the paths that are under way to the row that was learned last.

        Only rollouts hang on it, and it runs the model. So it is done when a rollout or the next row asks for it, or
        before, once the prediction is out.
        """
        if self._unjudged is not None:
            self._judge.step(*self._unjudged)
            self._unjudged = None

    def learned(self, seen: Seen) -> Learned:
        """What is known now, for a prediction from one window."""
        return self.state.learned(seen.features[0], self._judge.trusted)

    def _see(self, windows: Vector) -> Seen:
        return seen_by(self.model, windows)

    def _is_fast(self, window: Vector) -> bool:
        """Whether the layer acts throughout."""
        return bool(self.layer.acts(window[:, 0]).all())

    def _completed(self, last: _Row, now: Vector, recut: Recut | None) -> _Row:
        """``last`` with its inputs as they are known now, ``now`` ``(7,)`` being about the same row."""
        if recut is None or now[CHANNELS:].tolist() == last[1][CHANNELS:].tolist():
            return last
        window = recut()
        if window is None or np.array_equal(window[-1], last[1]) or not self._is_fast(window):
            return last
        return seen_by(self.model, window[None]), window[-1]
