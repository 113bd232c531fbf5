"""The one predictor: the live node, the offline replay and the benchmark all call it.

Messages go in as decoded samples; whenever odometry came in, the window is sampled back from its stamp and the model
predicts one sampling time ahead. Bad data never yields a prediction but a :class:`~dynssm_ros.signals.history.Refusal`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.errors import ArtifactError
from dynssm_ros.runtime.models import OnnxModel, WindowPrediction, corrected
from dynssm_ros.runtime.online import Learned, OnlineState, Seen
from dynssm_ros.runtime.path_judge import PathJudge
from dynssm_ros.signals.history import History, Refusal
from dynssm_ros.signals.signal_map import SignalMap
from dynssm_ros.vehicle import State
from dynssm_ros.vehicle.kinematics import SCALAR, Pose, advance_pose


@dataclass(frozen=True)
class Prediction:
    """The predicted instant.

    Attributes:
        stamp: input stamp + T_s (ns).
        state: predicted ``v_x, v_y, omega``, shape ``(3,)``.
        pose: propagated ``x, y, theta`` in the odometry frame; ``None`` if the pose is not mapped.
        theta: adapted coefficients in the order of ``COEFFICIENTS``, shape ``(17,)``; ``None`` if the model has none.
        theta_std: their standard deviations, shape ``(17,)``; ``None`` if nothing follows the coefficients.
        variance: stated one-step error variances of the state, shape ``(3,)``; ``None`` if the model states none.
        residual_share: part of the increment that the residual adds to the physics, in [0, 1]; 0 without physics.
    """

    stamp: int
    state: Vector
    pose: Pose | None
    theta: Vector | None
    theta_std: Vector | None
    variance: Vector | None
    residual_share: float


class Predictor:
    """A model with the history it needs, for one car.

    Args:
        model: the trained model.
        signal_map: where its inputs come from.
        max_age: how old the newest sample of a signal may be when odometry arrives (s).
        online: whether the model's online layer learns and corrects, if it has one.

    Raises:
        ArtifactError: the model was trained with commands that do not exist live.
        ConfigurationError: the model needs command topics and the signal map has none.
    """

    def __init__(self, model: OnnxModel, signal_map: SignalMap, max_age: float = 0.2, online: bool = True) -> None:
        self.signal_map = live_signal_map(model, signal_map)
        self.history = History(self.signal_map, model.T_s, model.H, max_age)
        self.online: OnlineState | None = None
        """What the online layer has learned so far; ``None`` without one."""
        self.judge: PathJudge | None = None
        """Whether its paths are believed."""
        self._learns = online
        self.model = model
        self._set_model(model)

    def check_swap(self, model: OnnxModel) -> None:
        """Checks that ``model`` can take the place of the present one.

        Raises:
            ArtifactError: it needs other commands.
        """
        if model.commands != self.model.commands:
            raise ArtifactError(
                f"{model.artifact.path}: trained with commands '{model.commands}', but the node runs with "
                f"'{self.model.commands}'; restart it with this model"
            )

    def swap(self, model: OnnxModel) -> None:
        """Exchanges the model between two predictions; the samples received so far are kept.

        What was learned online is kept by a model with the same prior, and forgotten by another.
        """
        self.check_swap(model)
        self.history.resize(model.T_s, model.H)
        self._set_model(model)

    def save_online(self, path: Path) -> None:
        """Writes what was learned online, so that another stint can start with it; nothing without an online layer."""
        if self.online is not None:
            self.online.save(path, self.model.prior)

    def load_online(self, path: Path) -> None:
        """Goes on from what :meth:`save_online` wrote.

        Raises:
            ArtifactError: unreadable, or learned by another model; the model has no online layer.
        """
        if self.online is None:
            raise ArtifactError(f"{path}: model {self.model.name} has no online layer, or it is switched off")
        self.online.load(path, self.model.prior)

    def _set_model(self, model: OnnxModel) -> None:
        if model.online is None or not self._learns:
            self.online = self.judge = None
        elif self.online is None or self.model.prior != model.prior:
            self.online = model.online.start()
            self.judge = PathJudge(model.online)
        self._row: _Row | None = None
        self.model = model
        self._scale = model.artifact.card.normalisation.increment_scale
        self._period = round(model.T_s * 1e9)

    def observe(self, stamp: int, values: dict[str, float]) -> Refusal | None:
        """Takes the samples of one message; see :meth:`History.add`."""
        return self.history.add(stamp, values)

    def predict(self, stamp: int, values: dict[str, float]) -> Prediction | Refusal:
        """Takes the odometry sample ``values`` at ``stamp`` (ns) and predicts the instant ``stamp + T_s``."""
        refusal = self.history.add(stamp, values)
        if refusal is not None:
            if refusal is Refusal.JUMPED_BACK and self.online is not None and self.judge is not None:
                self.online.reset()
                self.judge.reset()
                self._row = None
            return refusal
        if not _finite(values.values()):  # the pose, which is no part of the window
            return Refusal.NOT_FINITE
        window = self.history.window(stamp)
        if isinstance(window, Refusal):
            return window
        predicted = self.model.predict(window[None])
        if self.online is not None:
            assert predicted.seen is not None
            self._learn(stamp, window, predicted)
            known = self._known(predicted.seen.features)
            self._rollout = known, self.online.layer.mean_error(predicted.seen.features)
            predicted = corrected(predicted, window[None], self.online.layer, known)
        state, theta, physics, variance = predicted[:4]
        now, following = window[-1, :3].tolist(), state[0].tolist()  # a few floats are faster than a small array
        if not (_finite(following) and _finite_row(theta) and _finite_row(variance)):
            return Refusal.BAD_PREDICTION
        return Prediction(
            stamp + self._period,
            state[0],
            propagate_pose(values, now, following, self.model.T_s),
            None if theta is None else theta[0],
            None if self.online is None else self.online.coefficients.std,
            None if variance is None else variance[0],
            0.0 if physics is None else self._residual_share(now, following, physics[0].tolist()),
        )

    def horizon(self, prediction: Prediction, steps: int) -> list[Pose]:
        """Poses of a rollout with the last command held: the predicted one and ``steps - 1`` more.

        Call it right after :meth:`predict`; it continues the window of that prediction. The actuators reach the held
        command within one step, so that from then on feedback is the command and the increment is zero.
        """
        if prediction.pose is None:
            return []
        window = self.history.current.copy()
        poses, state = [prediction.pose], prediction.state
        for done in range(1, steps):
            row = window[-1].copy()
            row[:3], row[3:5], row[5:7] = state, row[3:5] + row[5:7], 0.0
            window = np.concatenate([window[1:], row[None]])
            predicted = self.model.predict(window[None])
            if self.online is not None:
                known, mean_error = self._rollout
                predicted = corrected(predicted, window[None], self.online.layer, known, mean_error, done)
            following = predicted.state[0]
            pose = advance_pose(SCALAR, poses[-1], State(*state.tolist()), State(*following.tolist()), self.model.T_s)
            if not _finite(pose):
                break
            poses.append(pose)
            state = following
        return poses

    def _learn(self, stamp: int, window: Vector, predicted: WindowPrediction) -> None:
        """Takes the steps of T_s that were completed by ``stamp``, each from a row to the next on the layer's own grid.

        The grid is that of the odometry where its rate is 1 / T_s. Else rows between the messages are cut from the
        history. Gaps and rows slower than the minimum speed teach nothing; after them the grid starts anew.
        """
        assert self.online is not None
        slack = self._period // 100
        row, self._row = self._row, None
        kept: Vector | None = None
        while row is not None and row.stamp + self._period <= stamp + slack:
            due = row.stamp + self._period
            if due >= stamp - slack:
                row = self._learned_row(row, stamp, window if kept is None else kept, predicted)
                break
            kept = window.copy() if kept is None else kept
            earlier = self.history.window(due)  # in the place of `window`
            row = (
                None
                if isinstance(earlier, Refusal)
                else self._learned_row(row, due, earlier, self.model.predict(earlier[None]))
            )
        if kept is not None:
            window[...] = kept
        if row is None:
            self.online.interrupt()
            assert self.judge is not None
            self.judge.interrupt()
            row = _row_of(stamp, window, predicted, self.online.layer.minimum_speed)
            if row is not None:
                self._judge(window, predicted)
        self._row = row

    def _judge(self, window: Vector, predicted: WindowPrediction) -> None:
        """Takes the paths that are under way a row further."""
        assert self.judge is not None
        assert predicted.seen is not None
        self.judge.step(window, predicted.seen, self._known(predicted.seen.features), self.model.see)

    def _learned_row(self, before: _Row, stamp: int, window: Vector, predicted: WindowPrediction) -> _Row | None:
        """Learns the step that ends with ``window``; returns its last row, ``None`` if the car was too slow there."""
        assert self.online is not None
        row = _row_of(stamp, window, predicted, self.online.layer.minimum_speed)
        if row is not None:
            self.online.update(before.seen, before.values, window[-1, :3] - window[-2, :3])
            self._judge(window, predicted)
        return row

    def _known(self, features: Vector) -> Learned:
        """What was learned online, for a prediction from features ``(1, 3, n)``."""
        online, judge = self.online, self.judge
        assert online is not None
        assert judge is not None
        return Learned(
            online.mean[None],
            online.variance(features[0])[None],
            online.limit[None],
            online.coefficients.theta[None],
            np.array([float(judge.trusted)]),
        )

    def _residual_share(self, now: list[float], following: list[float], physics: list[float]) -> float:
        residual = sum(abs(a - b) / s for a, b, s in zip(following, physics, self._scale, strict=True))
        explained = sum(abs(a - b) / s for a, b, s in zip(physics, now, self._scale, strict=True))
        return residual / (residual + explained) if residual > 0 else 0.0


class _Row(NamedTuple):
    """A row that the online layer has yet to see the next one of."""

    stamp: int
    seen: Seen
    values: Vector


def _row_of(stamp: int, window: Vector, predicted: WindowPrediction, minimum_speed: float) -> _Row | None:
    """The last row of ``window``; ``None`` if the car was slower than ``minimum_speed`` (m/s) within it."""
    assert predicted.seen is not None
    if not window[:, 0].min() >= minimum_speed:
        return None
    return _Row(stamp, Seen(predicted.seen.features[0], predicted.seen.physics[0]), window[-1].copy())


def live_signal_map(model: OnnxModel, signal_map: SignalMap) -> SignalMap:
    """The signal map with the commands that the model was trained with.

    Raises:
        ArtifactError: the model was trained with ``lookahead``, which does not exist live.
        ConfigurationError: it needs command topics and the map has none.
    """
    if model.commands == "lookahead":
        raise ArtifactError(
            f"{model.artifact.path}: trained with commands 'lookahead', which look into the future and do not exist "
            "live; train with --commands none or topics"
        )
    return signal_map.with_commands(model.commands)


def _finite(values: Iterable[float]) -> bool:
    return all(map(math.isfinite, values))


def _finite_row(part: Vector | None) -> bool:
    return part is None or _finite(part[0].tolist())


def propagate_pose(
    values: Mapping[str, float], now: Iterable[float], following: Iterable[float], T_s: float
) -> Pose | None:
    """The pose one step on; ``None`` without a pose."""
    try:
        pose = Pose(values["x"], values["y"], values["theta"])
    except KeyError:
        return None
    return advance_pose(SCALAR, pose, State(*now), State(*following), T_s)
