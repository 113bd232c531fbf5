"""The driver of a car in closed loop, in races and in the controller node: what is measured becomes a command."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import NamedTuple, get_args

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.control.caution import Margins
from dynssm_ros.control.disturbance import Disturbance
from dynssm_ros.control.evidence import SOURCES, Evidence, sources, together
from dynssm_ros.control.horizon_model import CONTEXT, MOVING, STATES, VELOCITIES, HorizonModel
from dynssm_ros.control.nmpc import Adapted, Nmpc, Plan, Status
from dynssm_ros.control.prediction_model import PredictionModel
from dynssm_ros.control.reference import Reference
from dynssm_ros.control.settings import Settings
from dynssm_ros.control.state_estimator import StateEstimator
from dynssm_ros.simulation.sensing import MOST_LATE
from dynssm_ros.track.tracks import Track
from dynssm_ros.vehicle import Applied, Coefficients, State
from dynssm_ros.vehicle.effects import require_context
from dynssm_ros.vehicle.kinematics import SCALAR, Pose
from dynssm_ros.vehicle.parameters import InputLimits

LOST = 1.0  # widths of the road that the car may be outside of it and is still driven
_AS_IT_IS = np.array([float(source == "model") for source in SOURCES])
_ACTUATORS = slice(STATES.index("r"), STATES.index("delta") + 1)
_KNOWN = (*STATES[:3], *CONTEXT)  # what effects may read


class Decision(NamedTuple):
    """What one control step came to."""

    command: Applied  # absolute throttle and steering from now on: finite, within limits and steering rate
    plan: Plan  # whose first step that is
    adapted: Adapted  # what was planned with: what the model has earned, and what was found to be missing
    caution: float  # by which it stays away from the borders at the end of the horizon (m)
    weights: Vector  # of evidence.SOURCES in that, (3,)
    seconds: float  # of model and plan together, by the controller's clock; see Controller.learn


class _Sent(NamedTuple):
    """What was sent at a measurement."""

    t: float  # of the measurement (s)
    increments: Vector
    said: Sequence[Adapted]  # by each of SOURCES
    is_sound: bool  # whether the measurement is finite


class Controller:
    """A model and the controller of one car on one track, with the window that the model reads and the last plan.

    It is asked once per T_s, and to :meth:`learn` once the command is out. A step without a plan in time is driven by
    the plan before, moved on, and counted.

    Args:
        model: what is known of the car.
        limits: of the actuators.
        reference: the line.
        track: whose borders hold.
        settings: of the controller; its deadline counts for model and plan together.
        clock: time now (s), of any origin.

    Raises:
        ConfigurationError: the model's physics needs a signal that there is not.
    """

    def __init__(
        self,
        model: PredictionModel,
        limits: InputLimits,
        reference: Reference,
        track: Track,
        settings: Settings,
        *,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        require_context(model.car.effects, _KNOWN, f"model {model.name}")
        self.counts: dict[Status, int] = dict.fromkeys(get_args(Status), 0)
        """Steps by what became of their plan."""
        self._model = model
        self._theta: Callable[[Vector], Vector] | None = None  # of the calibrated car; the model's
        self._track = track
        self._clock = clock
        horizon = HorizonModel(model.car, settings.N, settings.travel, settings.scale.length / settings.scale.time)
        self._nmpc = Nmpc(horizon, limits, reference, track, settings, clock=clock)
        self._disturbances = [Disturbance.of(settings, model.car.T_s) for _ in SOURCES]
        self._estimator = StateEstimator(model.car.T_s)
        constants = model.car.constants
        self._evidence = Evidence(self._nmpc.following, settings.N, model.car.T_s, (constants.l_f, -constants.l_r))
        self._wants_evidence = settings.evidence
        self._history: deque[Vector] = deque(maxlen=max(model.H, 1))
        self._commands: deque[Applied] = deque(maxlen=MOST_LATE + 1)
        self.forget()

    def forget(self) -> None:
        """Begins anew, as after a gap in what was measured: without a window, a plan, or an error of the model."""
        self._history.clear()
        self._model.interrupt()
        self._commands.clear()
        for disturbance in self._disturbances:
            disturbance.forget()
        self._estimator.forget()
        self._evidence.forget()
        self._nmpc.forget()
        self._age = 0
        self._past: Vector | None = None  # the estimated state at the last measurement
        self._expected: Vector | None = None  # by the model, at the next one
        self._sent: _Sent | None = None  # at the last measurement, till it is learned from

    def follow(self, reference: Reference, theta: Callable[[Vector], Vector]) -> None:
        """From now on follows the same line at another speed, with coefficients ``theta`` ``(N, 17)`` of places along
        the track (m), ``(N,)``, for the calibrated car.
        """
        self._nmpc.follow(reference)
        self._theta = theta

    @property
    def expected(self) -> Vector | None:
        """The state at the next measurement, by what was planned with; ``None`` while there is none."""
        return self._expected

    def interrupt(self) -> None:
        """What is measured next is not one T_s after what was measured last."""
        self.learn()
        self._model.interrupt()
        self._past = self._expected = None
        for disturbance in self._disturbances:
            disturbance.interrupted()
        self._estimator.forget()
        self._evidence.interrupt()

    def step(self, t: float, pose: Pose, seen: State, feedback: Applied, age: int = 0) -> Decision:
        """One control step.

        The measurement is filtered (:class:`StateEstimator`). From an older one the present follows by the model, under
        the commands that were sent since. What is not finite counts as measured as it was planned.

        Args:
            t: time since the start of the drive (s).
            pose: where the car was measured to be (m, m, rad).
            seen: its measured velocities (m/s, m/s, rad/s).
            feedback: what its actuators do now.
            age: steps of T_s since the measurement, less than :data:`MOST_LATE`. While it grows, as after the start,
                the measurement counts as the one before.
        """
        began = self._clock()
        self.learn()
        previous = self._nmpc.previous
        self._commands.append(feedback)
        while len(self._commands) <= age < MOST_LATE:
            self._commands.append(feedback)  # what was sent before the start
        commands = [*self._commands][-1 - age :]
        sent: Vector = np.diff(np.array(commands), axis=0)  # increments since the measurement
        at = t - age * self._model.car.T_s  # when it was measured
        is_new, self._age = self._past is None or age <= self._age, age
        if is_new:
            planned = np.zeros(2) if previous is None else previous.u[0]
            self._history.append(np.array([*seen, *commands[0], *(sent[0] if age else planned)]))
            for disturbance in self._disturbances:
                disturbance.measured(np.array(seen))
        given = sources(self._calibrated(pose, previous), self._model.read(np.array(self._history), previous))
        said = [disturbance.added(one) for disturbance, one in zip(self._disturbances, given, strict=True)]
        adapted = self._evidence.earned(said) if self._wants_evidence else said[-1]
        if is_new or self._past is None:
            self._past = self._estimated(at, pose, seen, commands[0], adapted)
        now = self._past
        for k, increments in enumerate(sent):
            now = self._nmpc.following(now, increments, adapted, at + k * self._model.car.T_s)
        weights = self._evidence.weights if self._wants_evidence else _AS_IT_IS
        margins = self._evidence.margins() if self._wants_evidence else Margins.none(self._nmpc.settings.N)
        plan = self._nmpc.plan(now, adapted, t, began, margins)
        command = self._nmpc.command(plan)
        first = self._expect(at, plan, command, sent, adapted)
        if is_new:
            self._sent = _Sent(at, first, said, bool(np.all(np.isfinite([*pose, *seen, *feedback]))))
        self.counts[plan.status] += 1
        return Decision(command, plan, adapted, float(margins.lateral[-1]), weights, self._clock() - began)

    def learn(self) -> None:
        """Takes what was sent at the last measurement as evidence, and hands it to the model.

        To be called once the command is out, which does not wait for it; else the next step does it and counts the
        time.
        """
        if self._sent is None:
            return
        (t, increments, said, is_sound), self._sent = self._sent, None
        self._model.learn(np.array(self._history))
        if self._past is None or not is_sound:
            self._evidence.interrupt()
            return
        first = together(said)
        expected = self._nmpc.following(np.tile(self._past, (len(said), 1)), increments, first, t)
        for disturbance, state in zip(self._disturbances, expected, strict=True):
            disturbance.expects(state[VELOCITIES])
        if self._wants_evidence:
            self._evidence.sent(self._past, increments, said, t)
        else:
            self._evidence.interrupt()

    def _calibrated(self, pose: Pose, previous: Plan | None) -> Adapted:
        """The calibrated car, along the plan where its coefficients depend on the place."""
        if self._theta is None:
            return self._model.calibrated
        ahead = np.array([pose[:2]]) if previous is None else previous.x[: self._nmpc.settings.N, :2]
        if not np.all(np.isfinite(ahead)):
            return self._model.calibrated
        return Adapted(self._theta(self._track.project(ahead)[0]), self._model.calibrated.correction)

    def _expect(self, t: float, plan: Plan, command: Applied, sent: Vector, adapted: Adapted) -> Vector:
        """Completes the window's last row, and predicts the next measurement from the last one, at ``t`` (s).

        Returns:
            The increments that were sent at that measurement.
        """
        past = plan.x[0]
        if len(sent) and self._past is not None:
            past = np.where(np.isfinite(self._past), self._past, past)
        first = sent[0] if len(sent) else np.subtract(command, plan.x[0, _ACTUATORS])
        row = self._history[-1]
        row[:5] = np.where(np.isfinite(row[:5]), row[:5], past[MOVING])
        row[5:] = first
        self._past = past
        self._expected = self._nmpc.following(past, first, adapted, t)
        return np.asarray(first)

    def _estimated(self, t: float, pose: Pose, seen: State, feedback: Applied, adapted: Adapted) -> Vector:
        """The state at the measurement, with the effects' own."""
        expected = self._expected
        motion = slice(0, _ACTUATORS.start)
        moved = None if expected is None or self._past is None else expected[motion] - self._past[motion]
        state = self._estimator.update(np.array([*pose, *seen]), moved)
        effect_states = self._settled(t, pose, seen, feedback, adapted) if expected is None else expected[len(STATES) :]
        return np.array([*state, *feedback, *effect_states])

    def _settled(self, t: float, pose: Pose, seen: State, feedback: Applied, adapted: Adapted) -> Vector:
        """The effect states of the model's effects at the start; zeros while that is not known."""
        car = self._model.car
        if not (car.effect_states and np.all(np.isfinite([*pose, *seen, *feedback]))):
            return np.zeros(len(car.effect_states))
        s = float(self._track.project(pose[:2])[0])
        context = {"t": t, **self._track.centre.place(s), **pose._asdict()}
        theta = Coefficients(*(float(value) for value in adapted.first.theta))
        effect_states = car.under(SCALAR).settled(seen, feedback, theta, context=context)
        return np.array([effect_states[name] for name in car.effect_states])
