"""Laps in closed loop: a plant, a model in the controller, and what is measured of them.

The car starts on the line at the line's own speed unless said otherwise, its actuators at zero. A lap is done when the
car is once around on the centre line; an open road is driven once, to its end. A violation is its centre of gravity
outside the borders at any sample.
"""

from __future__ import annotations

import gc
import math
import time
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.control.caution import QUANTILE
from dynssm_ros.control.controller import LOST, Controller, Decision
from dynssm_ros.control.evidence import SOURCES
from dynssm_ros.control.horizon_model import VELOCITIES
from dynssm_ros.control.lap_learning import LapLearner, LapLog, LearnedLap
from dynssm_ros.control.prediction_model import PredictionModel
from dynssm_ros.control.reference import Reference
from dynssm_ros.control.settings import Settings
from dynssm_ros.progress import NamedProgress
from dynssm_ros.simulation.laps import SimulationError
from dynssm_ros.simulation.plant import PlantKind, make_plant, plant_type
from dynssm_ros.simulation.sensing import Sensing, Sensors
from dynssm_ros.track.tracks import Track
from dynssm_ros.vehicle import Applied, State, Vehicle
from dynssm_ros.vehicle.kinematics import Pose
from dynssm_ros.vehicle.low_speed import LowSpeedRolling

PATIENCE = 3.0  # laps at the line's own speed that a lap may take


@dataclass(frozen=True)
class Start:
    """Where a race begins."""

    s: float = 0.0  # on the centre line (m)
    lateral: float = 0.0  # beside the line that is followed (m, positive left)
    speed: float | None = None  # along the line (m/s), 0: standing; None: the line's own there


@dataclass(frozen=True)
class Course:
    """What all models drive alike."""

    vehicle: Vehicle  # that is driven, with all its effects
    track: Track
    plant: PlantKind  # how it is simulated
    reference: Reference  # the line that the controller follows
    settings: Settings  # of the controller
    laps: int = 1
    start: Start = Start()
    sensing: Sensing = field(default_factory=Sensing)  # what comes between the car and its controller
    learning: Vehicle | None = None  # the file's car, to be driven faster every lap: lap_learning; None: it is not

    @property
    def delay(self) -> float:
        """From an instant until the command that answers it acts (s)."""
        return self.sensing.steps(self.vehicle.sampling_time) * self.vehicle.sampling_time

    def starting(self) -> tuple[Pose, State]:
        """Pose and motion at the start.

        Raises:
            SimulationError: the road is too narrow for the car; the start is not on it, or backwards; more than a lap
                of a line or a road for one; an open road for a car that learns from lap to lap.
        """
        if self.learning is not None:
            self.track.require_closed()
        if self.laps > 1 and self.reference.once:
            why = "starts from standstill" if self.track.centre.closed else "is that of an open road"
            raise SimulationError(f"{self.laps} laps of line {self.reference.name}, which {why}; expected 1")
        narrow = int(np.argmin(self.track.width_left + self.track.width_right))
        width = float(self.track.width_left[narrow] + self.track.width_right[narrow])
        if not width > 2 * self.settings.margin:
            raise SimulationError(
                f"track {self.track.name} is {width:.3g} m wide at s = {self.track.centre.s[narrow]:.4g} m; expected more "
                f"than {2 * self.settings.margin:.3g} m, the width of {self.vehicle.name}"
            )
        line = self.reference.line
        at = float(self.reference.project(self.track.centre.position(self.start.s)))
        x, y = (float(value) for value in line.position(at, self.start.lateral))
        s, lateral = (float(value) for value in self.track.project([x, y]))
        right, left = (float(width) for width in self.track.widths(s))
        if not -right < lateral < left:
            raise SimulationError(
                f"start {lateral:+.3g} m beside the centre line of track {self.track.name} at s = {s:.4g} m; expected "
                f"it on the road, {-right:.3g} to {left:.3g} m"
            )
        v_x = float(self.reference.speed_at(at)) if self.start.speed is None else self.start.speed
        if not 0 <= v_x < math.inf:
            raise SimulationError(f"start at {v_x:g} m/s; expected 0 or more")
        return Pose(x, y, float(line.heading(at))), State(v_x, 0.0, v_x * float(line.curvature(at)))


@dataclass(frozen=True, eq=False)
class Race:
    """A drive of ``n`` control steps with one model. Row ``k`` holds what was at ``time[k]`` and the command from then
    on.
    """

    name: str  # of the model
    course: Course
    time: Vector  # since the start (s), (n,)
    pose: Vector  # x, y, theta (m, m, rad), (n, 3)
    state: Vector  # true v_x, v_y, omega, (n, 3)
    command: Vector  # throttle (fraction) and steering (rad), (n, 2)
    s: Vector  # along the centre line since its first point, counted on over the laps (m), (n,)
    lateral: Vector  # beside it (m, positive left), (n,)
    theta: Vector  # coefficients of the first step of each horizon, (n, 17)
    correction: Vector  # likewise the correction, (n, 3)
    weights: Vector  # shares of evidence.SOURCES in both, (n, 3)
    solve: Vector  # time of each control step, model and plan together (s of one core), (n,)
    learn: Vector  # what is learned from it took after its command was out (likewise), (n,)
    infeasible: int  # steps at which there was no plan
    late: int  # steps at which it came too late
    failure: str  # why the laps were not completed; empty if they were
    learned: tuple[LearnedLap, ...] = ()  # lap by lap, what a car that learns was driven with

    @property
    def completed(self) -> bool:
        """Whether all laps were driven."""
        return not self.failure

    @property
    def lap_times(self) -> list[float]:
        """Times of the complete laps, or from the start to the end of an open road (s)."""
        length = self.course.track.length
        if not self.course.track.centre.closed:
            return [float(np.interp(length, self.s, self.time))] if self.s[-1] >= length else []
        done = int((self.s[-1] - self.s[0]) / length + 1e-9)
        marks = self.s[0] + length * np.arange(done + 1)
        return [float(lap) for lap in np.diff(np.interp(marks, np.maximum.accumulate(self.s), self.time))]

    @property
    def outside(self) -> float:
        """How far the car's centre came outside the borders (m); 0 if it stayed between them."""
        return float(np.max(-self.course.track.room(self.s, self.lateral), initial=0.0))

    def to_json(self) -> dict[str, Any]:
        """The figures of the race, for programs; ``lap_time_s`` is the mean over the laps, null without one."""
        laps = self.lap_times
        mean_v_x, mean_v_y, mean_omega = (float(np.mean(np.abs(column))) for column in self.state.T)
        return {
            "lap_time_s": float(np.mean(laps)) if self.completed else None,
            "violation": self.outside > 0,
            "mean_v_x": mean_v_x,
            "mean_abs_v_y": mean_v_y,
            "mean_abs_omega": mean_omega,
            "steering_total_variation": float(np.sum(np.abs(np.diff(self.command[:, 1], prepend=0.0)))),
            "planned_with": dict(zip(SOURCES, self.weights.mean(axis=0).tolist(), strict=True)),
            "solve_ms": _milliseconds(self.solve),
            "learn_ms": _milliseconds(self.learn),
            "completed": self.completed,
            "failure": self.failure,
            "lap_times_s": laps,
            "outside_m": self.outside,
            "steps": len(self.time),
            "infeasible": self.infeasible,
            "late": self.late,
            "learned": [lap.to_json() for lap in self.learned],
        }


def _milliseconds(seconds: Vector) -> dict[str, float]:
    """What half and what all but a hundredth of some times stay below."""
    p50, p99 = 1e3 * np.percentile(seconds, [50, 99])
    return {"p50": float(p50), "p99": float(p99)}


class _RaceCar:
    """The car of a race on its way."""

    def __init__(self, course: Course, model: PredictionModel) -> None:
        pose, state = course.starting()
        vehicle, track = course.vehicle, course.track
        # the processor's time, so that what else runs on the machine changes no simulated lap
        settings = replace(
            course.settings, travel="start" if plant_type(course.plant).integrator == "euler" else "middle"
        )
        self.pilot = Controller(model, vehicle.inputs, course.reference, track, settings, clock=time.thread_time)
        rolling = LowSpeedRolling(vehicle, plant_type(course.plant).step(vehicle))
        self._car = make_plant(vehicle, course.plant, pose, state, last=(rolling,), line=track.centre)
        self._course = course
        self._feedback = Applied(vehicle.inputs.coasting(state.v_x), 0.0)
        self._sensors = Sensors(course.sensing, vehicle.sampling_time)
        self._limit = PATIENCE * course.laps * course.reference.lap_time
        self._rows: list[tuple[Any, ...]] = []
        self._learner: LapLearner | None = None
        self._logged: list[tuple[Any, ...]] = []  # of the lap under way
        if course.learning is not None:
            theta = model.calibrated.first.theta
            self._learner = LapLearner(course.learning, track, course.reference, settings, car=model.car, theta=theta)
            self.pilot.follow(self._learner.reference, self._learner.theta)
        self.s, self._lateral = (float(value) for value in track.project(pose[:2]))
        self.start = self.s
        self.goal = self.s + course.laps * track.length if track.centre.closed else track.length

    def step(self) -> str | None:
        """Drives on by T_s; once it is over, why: a failure, or nothing."""
        t, car = len(self._rows) * self._course.vehicle.sampling_time, self._car
        self._sensors.measure(car.pose, car.measured)
        pose, seen, age = self._sensors.arrived
        decision = self.pilot.step(t, pose, seen, self._feedback, age)
        began = time.thread_time()
        self.pilot.learn()
        self._rows.append(
            (t, car.pose, car.state, decision.command, self.s, self._lateral, *decision.adapted.first, decision.weights,
             decision.seconds, time.thread_time() - began)
        )  # fmt: skip
        self._log(t, decision)
        failure = self._failure(t)
        if failure or self.s >= self.goal:
            return failure
        car.advance(decision.command, self._course.track.centre.wrapped(self.s))
        self._feedback = decision.command
        if not all(map(math.isfinite, (*car.pose, *car.state))):
            return f"its motion is not finite after {t:.2f} s"
        at, self._lateral = (float(value) for value in self._course.track.project(car.pose[:2], near=self.s))
        self.s = self._course.track.centre.counted_on(at, self.s)
        return None

    def result(self, name: str, failure: str) -> Race:
        """What was driven."""
        counts, learned = self.pilot.counts, () if self._learner is None else tuple(self._learner.laps)
        columns = [np.array(column) for column in zip(*self._rows, strict=True)]
        found: list[Any] = [*columns, counts["infeasible"], counts["late"], failure, learned]
        return Race(name, self._course, *found)

    def _log(self, t: float, decision: Decision) -> None:
        """Keeps what was measured at ``t`` (s), and learns from the lap once it is complete."""
        if self._learner is None:
            return
        track, believed = self._course.track, decision.plan.x[0]
        room = float(track.room(*track.project(believed[:2], near=self.s)))
        row = (*self._sensors.newest[1], *self._feedback, *np.subtract(decision.command, self._feedback))
        self._logged.append((t, self.s, room, decision.caution / QUANTILE, believed[VELOCITIES], row))
        if self.s >= self.start + (1 + len(self._learner.laps)) * track.length:
            self._learner.learn(LapLog(*(np.array(column) for column in zip(*self._logged, strict=True))))
            self.pilot.follow(self._learner.reference, self._learner.theta)
            del self._logged[:-1]

    def _failure(self, t: float) -> str:
        """Why the drive ends before its time; empty if it does not."""
        track, state, s = self._course.track, self._car.state, self.s
        if -track.room(s, self._lateral) > LOST * np.sum(track.widths(s)):
            return f"leaves the track after {t:.2f} s at s = {track.centre.wrapped(s):.4g} m"
        if state.v_x < abs(state.v_y):
            return f"spins after {t:.2f} s at s = {track.centre.wrapped(s):.4g} m"
        if t > self._limit:
            return f"takes longer than {self._limit:.3g} s"
        return ""


def race(course: Course, model: PredictionModel, progress: NamedProgress | None = None) -> Race:
    """Drives the laps of ``course`` with ``model`` in the controller; ``progress`` is told of millimetres, of how many,
    and the model.

    Raises:
        SimulationError: the road is too narrow for the car, or the start is not on it.
        ConfigurationError: the model's physics needs a signal that there is not.
    """
    drive = _RaceCar(course, model)
    # a search for garbage through all that is there takes longer than some T_s, and a plan would be late for it
    gc.collect()
    gc.freeze()
    try:
        while (failure := drive.step()) is None:
            if progress is not None:
                done = min(max(drive.s, drive.start), drive.goal) - drive.start
                progress(round(1e3 * done), round(1e3 * (drive.goal - drive.start)), model.name)
    finally:
        gc.unfreeze()
    return drive.result(model.name, failure)
