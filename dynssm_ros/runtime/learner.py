"""What an online layer learns from a drive, row after row, each one T_s after the last."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.runtime.contract import WindowPrediction, seen_by
from dynssm_ros.runtime.online import CHANNELS, Learned, OnlineLayer, OnlineState, Seen
from dynssm_ros.runtime.onnx_model import OnnxModel
from dynssm_ros.runtime.path_judge import PathJudge
from dynssm_ros.runtime.rollout import RolloutCorrection

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
        self.model = model
        self.layer = layer
        self.state: OnlineState = layer.start()
        self._judge = PathJudge(layer, self._see)
        self._judges = judges
        self._last: _Row | None = None
        self._unjudged: tuple[Vector, Seen, Learned] | None = None
        self._known: tuple[Seen, Learned] | None = None
        self._correction: RolloutCorrection | None = None

    def continued_with(self, model: OnnxModel) -> OnlineLearner:
        """The learner of ``model``, which has the same prior: what was learned is kept."""
        self.judge_paths()
        self.model, self._last = model, None
        return self

    def reset(self) -> None:
        """Forgets the drive."""
        self.state.reset()
        self._judge.reset()
        self._last = self._unjudged = self._known = None

    def interrupt(self) -> None:
        """The next row is not one T_s after the last one."""
        self._last = None

    def learn(self, window: Vector, predicted: WindowPrediction, recut: Recut | None = None) -> bool:
        """Learns the step from the last row to the next.

        Args:
            window: that ends with the next row, ``(H, 7)``.
            predicted: by the model, from ``window``.
            recut: gives the last row with inputs that came after its odometry; till then the last ones were held.

        Returns:
            Whether the row after it can be learned: the car was not too slow.
        """
        assert predicted.seen is not None
        last, self._last, self._known = self._last, None, None
        fast = self._is_fast(window)
        if last is None or not fast:
            self.state.interrupt()
            self.judge_paths()
            self._judge.interrupt()
        else:
            last = self._completed(last, window[-2], recut)
            self.state.update(last.seen, last.values, window[-1, :CHANNELS] - window[-2, :CHANNELS])
        if fast:
            self._last = _Row.of(window, predicted)
            if self._judges:
                self.judge_paths()
                known = self.learned(predicted.seen)
                self._known = predicted.seen, known
                self._unjudged = window, predicted.seen, known
        return fast

    def corrected(self, window: Vector, predicted: WindowPrediction) -> WindowPrediction:
        """What the model predicts from ``window`` ``(H, 7)``, corrected by what was learned; rollouts go on from there."""
        assert predicted.seen is not None
        seen, known = predicted.seen, self._known  # nothing was learned since
        learned = self.learned(seen) if known is None or known[0] is not seen else known[1]
        self._correction = RolloutCorrection(self.layer, learned)
        return self._correction.corrected(predicted, window[None])

    def rollout(self) -> RolloutCorrection:
        """Corrects the steps after the prediction that was :meth:`corrected` last."""
        assert self._correction is not None
        self.judge_paths()
        return self._correction.believed(self._judge.trusted)

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

    def _completed(self, row: _Row, now: Vector, recut: Recut | None) -> _Row:
        """``row`` with its inputs as they are known now, ``now`` ``(7,)`` being about the same row."""
        if recut is None or now[CHANNELS:].tolist() == row.values[CHANNELS:].tolist():
            return row
        window = recut()
        if window is None or np.array_equal(window[-1], row.values) or not self._is_fast(window):
            return row
        return _Row.of(window, self.model.predict(window[None]))


class _Row(NamedTuple):
    """A row that the layer has yet to see the next one of."""

    seen: Seen
    """Features ``(3, n)`` and physics ``(3,)``."""
    values: Vector

    @classmethod
    def of(cls, window: Vector, predicted: WindowPrediction) -> _Row:
        """The last row of a window."""
        assert predicted.seen is not None
        return cls(Seen(predicted.seen.features[0], predicted.seen.physics[0]), window[-1])
