"""The one predictor: the live node, the offline replay and the benchmark all call it.

Messages go in as decoded samples; whenever odometry came in, the window is sampled back from its stamp and the model
predicts one sampling time ahead. Bad data never yields a prediction but a :class:`~dynssm_ros.signals.history.Refusal`.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.errors import ArtifactError, ConfigurationError
from dynssm_ros.runtime.contract import WindowPrediction
from dynssm_ros.runtime.health import Level
from dynssm_ros.runtime.hindsight import Hindsight
from dynssm_ros.runtime.learner import OnlineLearner
from dynssm_ros.runtime.online import OnlineState, expert_weights
from dynssm_ros.runtime.onnx_model import OnnxModel
from dynssm_ros.runtime.plausibility import Plausibility
from dynssm_ros.runtime.rollout import Step, states_ahead, step_of
from dynssm_ros.runtime.trial import require_same_use
from dynssm_ros.signals.decoding import Frames
from dynssm_ros.signals.history import History, Refusal
from dynssm_ros.signals.inputs import WINDOW_COLUMNS
from dynssm_ros.signals.signal_map import CONTEXT_SIGNALS, SignalMap
from dynssm_ros.vehicle import State, Vehicle
from dynssm_ros.vehicle.kinematics import SCALAR, Pose, advance_pose

_RECENT_S = 10.0  # of driving, that a model to be swapped in is tried on
_KEPT_ROWS = 2000  # as long at 200 Hz


class Prediction(NamedTuple):
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


class CandidateRollout(NamedTuple):
    """What was predicted for inputs that somebody asked about.

    Attributes:
        stamp: of the odometry that it begins at (ns).
        states: after each step of T_s.
        poses: likewise, in the odometry frame; empty if the pose is not mapped.
    """

    stamp: int
    states: list[State]
    poses: list[Pose]


class Predictor:
    """A model with the history it needs, for one car.

    Args:
        model: the trained model.
        signal_map: where its inputs come from.
        max_age: how old the newest sample of a signal may be when odometry arrives (s).
        online: whether the model's online layer learns and corrects, if it has one.
        frames: that the odometry must have; those that are empty are as they come first.

    Raises:
        ArtifactError: the model was trained with commands that do not exist live.
        ConfigurationError: the model needs command topics and the signal map has none.
    """

    def __init__(
        self,
        model: OnnxModel,
        signal_map: SignalMap,
        max_age: float = 0.2,
        online: bool = True,
        *,
        frames: Frames = ("", ""),
    ) -> None:
        self.signal_map = live_signal_map(model, signal_map)
        self._frames = frames
        self._history = History(self.signal_map, model.T_s, model.H, max_age=max_age, held=model.card.held)
        self._learner: OnlineLearner | None = None
        self._learns = online
        self._window = np.zeros((model.H, len(WINDOW_COLUMNS)))
        self._rows: deque[tuple[int, Vector]] = deque(maxlen=_KEPT_ROWS)
        self._start: tuple[int, Pose | None] | None = None  # of the newest odometry, if it has a prediction
        self._measured: tuple[int, list[float]] | None = None  # that the hindsight has yet to see
        self._set_model(model)

    @property
    def online(self) -> OnlineState | None:
        """What the online layer has learned so far; ``None`` without one."""
        return None if self._learner is None else self._learner.state

    def recent(self) -> Vector:
        """What was predicted from lately, without a gap: rows T_s apart, the newest last, ``(N, 7)``."""
        if not self._rows:
            return np.zeros((0, len(WINDOW_COLUMNS)))
        stamps, rows = (np.array(part) for part in zip(*self._rows, strict=True))
        seconds = (stamps - stamps[-1]) / 1e9
        first = int(np.max(np.flatnonzero(np.diff(seconds) > self.signal_map.max_gap), initial=-1)) + 1
        count = 1 + int(min(-seconds[first], _RECENT_S) / self.model.T_s)
        grid = self.model.T_s * np.arange(1.0 - count, 1.0)
        return np.stack([np.interp(grid, seconds[first:], column[first:]) for column in rows.T], axis=1)

    def check_swap(self, model: OnnxModel) -> None:
        """Checks that ``model`` can take the place of the present one, and predicts from what is measured now.

        How well it predicts is tried in a process of its own before: :func:`~dynssm_ros.runtime.trial.try_model`.

        Raises:
            ArtifactError: it is for other commands or another car, or what it predicts is not finite.
        """
        require_same_use(model, self.model.card)
        rows = np.zeros((model.H, len(WINDOW_COLUMNS)))
        recent = self._window[-model.H :]
        if np.all(np.isfinite(recent)):
            rows[-len(recent) :] = recent
            rows[: -len(recent)] = recent[0]
        for part in model.predict(rows[None])[:4]:
            if part is not None and not np.all(np.isfinite(part)):
                raise ArtifactError(f"{model.artifact.path}: what it predicts is not finite; expected numbers")

    def swap(self, model: OnnxModel) -> None:
        """Exchanges the model between two predictions; the samples received so far are kept.

        What was learned online is kept by a model with the same prior, and forgotten by another.
        """
        self.check_swap(model)
        self._history.resize(model.T_s, model.H, model.card.held)
        self._set_model(model)

    @property
    def row(self) -> Vector:
        """Last row of the window that was predicted from last, with the columns ``WINDOW_COLUMNS`` ``(7,)``."""
        row: Vector = self._window[-1]
        return row

    @property
    def vehicle(self) -> Vehicle:
        """The car that the model is for."""
        return self.model.vehicle

    def figures(self) -> dict[str, str]:
        """By name, for the diagnostics: the model, what was implausible last, what the online layer has learned."""
        figures = {
            "model": self.model.name,
            "model folder": str(self.model.artifact.path),
            "implausible": self._plausibility.last,
        }
        if (state := self.online) is not None:
            figures["online steps"] = str(state.steps)
            experts = expert_weights(state.layer, state.mean)
            figures |= {f"online weight of the {name}": f"{weight:.3f}" for name, weight in experts.items()}
        return figures

    def hindsight(self) -> tuple[Level, str]:
        """What became of the predictions of the last second; see :class:`Hindsight`."""
        return self._hindsight.verdict()

    def finish(self) -> None:
        """Does what can wait until the prediction is out; the next one or a horizon does it else."""
        measured, self._measured = self._measured, None
        if measured is not None:
            self._hindsight.measured(*measured)
        if self._learner is not None:
            self._learner.finish()

    def online_writer(self, path: Path) -> Callable[[], None]:
        """Writes what was learned online until now, once it is called, so that another stint can start with it.

        Another thread may call it. It writes nothing without an online layer.
        """
        return (lambda: None) if self.online is None else self.online.writer(path, self.model.prior)

    def load_online(self, path: Path) -> None:
        """Goes on from what :meth:`online_writer` wrote.

        Raises:
            ArtifactError: unreadable, or learned by another model; the model has no online layer.
        """
        if self.online is None:
            raise ArtifactError(f"{path}: model {self.model.name} has no online layer, or it is switched off")
        self.online.load(path, self.model.prior)

    def _set_model(self, model: OnnxModel) -> None:
        layer, learner = model.online, self._learner
        if layer is None or not self._learns:
            self._learner = None
        elif learner is not None and learner.model.prior == model.prior:
            self._learner = learner.continued_with(model)
        else:
            self._learner = OnlineLearner(model, layer)
        self._learned_at: int | None = None
        self.model = model
        self._plausibility = Plausibility(model.card.vehicle, frames=self._frames)
        self._scale = model.card.normalisation.increment_scale
        self._hindsight = Hindsight(self._scale, model.vehicle.minimum_speed)
        self._measured = self._start = None
        self._period = round(model.T_s * 1e9)

    def observe(self, stamp: int, values: dict[str, float], frames: Frames | None = None) -> Refusal | None:
        """Takes the samples of one message; see :meth:`History.add`. What the car cannot have produced is refused."""
        refusal = self._plausibility.check(stamp, values, frames) or self._history.add(stamp, values)
        if refusal is Refusal.JUMPED_BACK:
            self._plausibility.forget()
            self._hindsight.forget()
            self._rows.clear()
            if self._learner is not None:
                self._learner.reset()
                self._learned_at = None
        return refusal

    def predict(self, stamp: int, values: dict[str, float], frames: Frames | None = None) -> Prediction | Refusal:
        """Takes the odometry sample ``values`` at ``stamp`` (ns) and predicts the instant ``stamp + T_s``."""
        self.finish()
        self._start = None
        refusal = self.observe(stamp, values, frames)
        if refusal is not None:
            return refusal
        if not _finite(values.values()):  # the pose, which is no part of the window
            return Refusal.NOT_FINITE
        window = self._history.window(stamp)
        if isinstance(window, Refusal):
            return window
        self._window = window
        self._rows.append((stamp, window[-1].copy()))
        learner = self._learner
        predicted = self.model.predict(window[None]) if learner is None else self._learn(learner, stamp, window)
        state, theta, physics, variance = predicted[:4]
        now, (following, adapted, stated) = window[-1, :3].tolist(), predicted.numbers()
        self._measured = stamp, now
        if not math.isfinite(sum(following) + sum(stated) + sum(adapted)):
            return Refusal.BAD_PREDICTION
        if words := self._plausibility.of_prediction(now, following, self.model.T_s, variance=stated, theta=adapted):
            self._plausibility.last = words
            return Refusal.IMPLAUSIBLE_PREDICTION
        self._hindsight.predicted(stamp + self._period, following, now)
        self._start = stamp, _pose_in(values)
        return Prediction(
            stamp + self._period,
            state[0],
            propagate_pose(values, now, following, self.model.T_s),
            None if theta is None else theta[0],
            None if self.online is None else self.online.coefficients.std,
            None if variance is None else variance[0],
            0.0 if physics is None else self._residual_share(now, following, physics[0].tolist()),
        )

    def horizon(self, prediction: Prediction, steps: int, *, deadline: float = math.inf) -> list[Pose]:
        """Poses of a rollout with the last command held: the predicted one and ``steps - 1`` more.

        Call it right after :meth:`predict`; it continues the window of that prediction. The actuators reach the held
        command within one step, so that from then on feedback is the command and the increment is zero. It ends early
        at ``deadline``, a time of ``time.monotonic`` (s).
        """
        if prediction.pose is None:
            return []
        ahead = np.zeros((steps, len(WINDOW_COLUMNS)))
        ahead[0, :3], ahead[:, 3:5] = prediction.state, self._window[-1, 3:5] + self._window[-1, 5:7]
        rows = np.concatenate([self._window[1:], ahead])[None]
        step = step_of(self.model, None if self._learner is None else self._learner.rollout())
        driven = self._driven(step, rows, State(*prediction.state.tolist()), prediction.pose, deadline)
        return [prediction.pose, *(pose for _, pose in driven if pose is not None)]

    def rollout(self, inputs: Vector, *, deadline: float = math.inf) -> CandidateRollout | None:
        """What comes if the actuators do as they are told, from the newest odometry on.

        Args:
            inputs: throttle (fraction) or speed set-point (m/s), and steering (rad), absolute, for a step of T_s each,
                ``(K, 2)``. They are taken as far as the actuators go.
            deadline: a time of ``time.monotonic`` (s), after which it ends early.

        Returns:
            ``None`` where the newest odometry had no prediction.
        """
        if self._start is None:
            return None
        stamp, pose = self._start
        inputs = np.clip(inputs, *np.transpose([self.vehicle.inputs.throttle, self.vehicle.inputs.steering]))
        rows = np.concatenate([self._window, np.zeros((len(inputs), len(WINDOW_COLUMNS)))])[None]
        acting = rows[0, self.model.H - 1 :]
        if self.model.commands == "topics":
            acting[1:, 3:5] = inputs
            acting[1:-1, 5:7] = np.diff(inputs, axis=0)
            acting[0, 5:7] = inputs[0] - acting[0, 3:5]
        else:
            acting[:-1, 3:5], acting[-1, 3:5] = inputs, inputs[-1]
        step = step_of(self.model, None if self._learner is None else self._learner.afresh())
        states, poses = [], []
        for state, following in self._driven(step, rows, State(*self._window[-1, :3].tolist()), pose, deadline):
            states.append(state)
            if following is not None:
                poses.append(following)
        return CandidateRollout(stamp, states, poses)

    def _driven(
        self, step: Step, rows: Vector, state: State, pose: Pose | None, deadline: float
    ) -> Iterator[tuple[State, Pose | None]]:
        """States and poses along ``rows`` ``(1, H + steps, 7)``, as far as they are finite, until ``deadline``.

        ``state`` and ``pose`` are those before the first step.
        """
        for (values,) in states_ahead(step, rows, self.model.H):
            following = State(*values.tolist())
            if pose is not None:
                pose = advance_pose(SCALAR, pose, state, following, self.model.T_s)
            if not _finite((*following, *(pose or ()))) or time.monotonic() > deadline:
                return
            state = following
            yield state, pose

    def _learn(self, learner: OnlineLearner, stamp: int, window: Vector) -> WindowPrediction:
        """Lets the learner follow the drive up to the ``window`` at ``stamp`` (ns), in rows T_s apart, and predict from it.

        These are those of the odometry where its rate is 1 / T_s. Else rows between the messages are cut from the
        history. After a gap and after rows that are too slow they start anew, with ``window``.
        """
        slack, last = self._period // 100, self._learned_at
        while last is not None and (due := last + self._period) < stamp - slack:
            row, recut = self._history.window(due), partial(self._recut, last)
            last = due if not isinstance(row, Refusal) and learner.predict(row, recut)[1] else None
        if last is None:
            learner.interrupt()
        learns = last is None or last + self._period <= stamp + slack
        predicted, fast = learner.predict(window, partial(self._recut, last), learns=learns)
        if learns:
            last = stamp if fast else None
        self._learned_at = last
        return predicted

    def _recut(self, stamp: int | None) -> Vector | None:
        window = Refusal.FILLING if stamp is None else self._history.window(stamp)
        return None if isinstance(window, Refusal) else window

    def _residual_share(self, now: list[float], following: list[float], physics: list[float]) -> float:
        residual = explained = 0.0
        for before, own, after, scale in zip(now, physics, following, self._scale, strict=True):
            residual += abs(after - own) / scale
            explained += abs(own - before) / scale
        return residual / (residual + explained) if residual > 0 else 0.0


def live_signal_map(model: OnnxModel, signal_map: SignalMap) -> SignalMap:
    """The signal map with the commands that the model was trained with, of signals that a model needs.

    Raises:
        ArtifactError: the model was trained with ``lookahead``, which does not exist live.
        ConfigurationError: it needs command topics and the map has none, or the map is of another kind of car.
    """
    vehicle = model.vehicle
    if signal_map.set_point != vehicle.inputs.set_point:
        raise ConfigurationError(
            f"signal map {signal_map.name}: has {signal_map.set_point}_feedback, but vehicle {vehicle.name} has "
            f"inputs.set_point: {vehicle.inputs.set_point}; expected {vehicle.inputs.set_point}_feedback"
        )
    if model.commands == "lookahead":
        raise ArtifactError(
            f"{model.artifact.path}: trained with commands 'lookahead', which look into the future and do not exist "
            "live; train with --commands none or topics"
        )
    return signal_map.without(CONTEXT_SIGNALS).with_commands(model.commands)


def _finite(values: Iterable[float]) -> bool:
    return all(map(math.isfinite, values))


def _pose_in(values: Mapping[str, float]) -> Pose | None:
    """The pose among a sample's values; ``None`` without one."""
    try:
        return Pose(values["x"], values["y"], values["theta"])
    except KeyError:
        return None


def propagate_pose(
    values: Mapping[str, float], now: Iterable[float], following: Iterable[float], T_s: float
) -> Pose | None:
    """The pose one step on; ``None`` without a pose."""
    pose = _pose_in(values)
    return None if pose is None else advance_pose(SCALAR, pose, State(*now), State(*following), T_s)
