"""Laps in closed loop: a plant, a model in the controller, and what is measured of them.

The car starts rolling, on the line at the line's own speed unless said otherwise, with its actuators at zero. A model
that reads a history drives with its nominal coefficients until its window is full. Time runs from the start; a lap is
done when the car is once around on the centre line.

A violation is the car's centre of gravity outside the borders at any sample.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from dynssm_ros.control.horizon_model import STATES, HorizonModel
from dynssm_ros.control.learned import Knowledge
from dynssm_ros.control.nmpc import Nmpc, Settings
from dynssm_ros.control.reference import Reference
from dynssm_ros.simulation.laps import SimulationError
from dynssm_ros.simulation.plant import SCALAR, PlantKind, Pose, make_plant
from dynssm_ros.simulation.tracks import Track
from dynssm_ros.vehicle import Applied, Coefficients, State, Vehicle
from dynssm_ros.vehicle.effects import require_context
from dynssm_ros.vehicle.single_track import settled_memory

Vector = npt.NDArray[np.float64]
Progress = Callable[[int, int, str], None]

PATIENCE = 3.0  # laps at the line's own speed that a lap may take
LOST = 1.0  # widths of the road that the car may be outside of it


@dataclass(frozen=True)
class Start:
    """Where a race begins.

    Attributes:
        s: on the centre line (m).
        lateral: beside the line that is followed (m, positive left).
        speed: along the line (m/s); ``None``: the line's own there.
    """

    s: float = 0.0
    lateral: float = 0.0
    speed: float | None = None


@dataclass(frozen=True)
class Course:
    """What all models drive alike.

    Attributes:
        vehicle: the car that is driven, with all its effects.
        track: where.
        plant: how the car is simulated.
        reference: the line that the controller follows.
        settings: of the controller.
        laps: to drive.
        start: where it begins.
    """

    vehicle: Vehicle
    track: Track
    plant: PlantKind
    reference: Reference
    settings: Settings
    laps: int = 1
    start: Start = Start()

    def starting(self) -> tuple[Pose, State]:
        """Pose and motion at the start.

        Raises:
            SimulationError: the start is not on the road, or standing.
        """
        line = self.reference.line
        at = float(line.project(self.track.centre.position(self.start.s))[0])
        x, y = (float(value) for value in line.position(at, self.start.lateral))
        s, lateral = (float(value) for value in self.track.project([x, y]))
        right, left = (float(width) for width in self.track.widths(s))
        if not -right < lateral < left:
            raise SimulationError(
                f"start {lateral:+.3g} m beside the centre line of track {self.track.name} at s = {s:.4g} m; expected "
                f"it on the road, {-right:.3g} to {left:.3g} m"
            )
        v_x = float(self.reference.speed_at(at)) if self.start.speed is None else self.start.speed
        if not v_x > 0:
            raise SimulationError(f"start at {v_x:g} m/s; expected a rolling start, more than 0")
        return Pose(x, y, float(line.heading(at))), State(v_x, 0.0, v_x * float(line.curvature(at)))


@dataclass(frozen=True, eq=False)
class Race:
    """A drive of ``n`` control steps with one model. Row ``k`` holds what was at ``time[k]`` and the command from then on.

    Attributes:
        name: of the model.
        course: what was driven.
        time: since the start (s), shape ``(n,)``.
        pose: ``x, y, theta`` (m, m, rad), shape ``(n, 3)``.
        state: true ``v_x, v_y, omega``, shape ``(n, 3)``.
        command: throttle (fraction) and steering (rad), shape ``(n, 2)``.
        s: along the centre line since its first point, counted on over the laps (m), shape ``(n,)``.
        lateral: beside it (m, positive left), shape ``(n,)``.
        theta: coefficients of the first step of each horizon, shape ``(n, 17)``.
        correction: likewise the correction, shape ``(n, 3)``.
        solve: time of each control step, model and plan together (s of one core), shape ``(n,)``.
        infeasible: steps at which there was no plan.
        late: steps at which it came too late.
        failure: why the laps were not completed; empty if they were.
    """

    name: str
    course: Course
    time: Vector
    pose: Vector
    state: Vector
    command: Vector
    s: Vector
    lateral: Vector
    theta: Vector
    correction: Vector
    solve: Vector
    infeasible: int
    late: int
    failure: str

    @property
    def completed(self) -> bool:
        """Whether all laps were driven."""
        return not self.failure

    @property
    def lap_times(self) -> list[float]:
        """Times of the complete laps (s)."""
        length = self.course.track.length
        done = int((self.s[-1] - self.s[0]) / length + 1e-9)
        marks = self.s[0] + length * np.arange(done + 1)
        return [float(lap) for lap in np.diff(np.interp(marks, np.maximum.accumulate(self.s), self.time))]

    @property
    def outside(self) -> float:
        """How far the car's centre came outside the borders (m); 0 if it stayed between them."""
        right, left = self.course.track.widths(self.s)
        return float(np.max(np.maximum(self.lateral - left, -right - self.lateral), initial=0.0))

    def to_json(self) -> dict[str, Any]:
        """The figures of the race, for programs; ``lap_time_s`` is the mean over the laps, null without one."""
        laps = self.lap_times
        p50, p99 = 1e3 * np.percentile(self.solve, [50, 99])
        mean_v_x, mean_v_y, mean_omega = (float(np.mean(np.abs(column))) for column in self.state.T)
        return {
            "lap_time_s": float(np.mean(laps)) if self.completed else None,
            "violation": self.outside > 0,
            "mean_v_x": mean_v_x,
            "mean_abs_v_y": mean_v_y,
            "mean_abs_omega": mean_omega,
            "steering_total_variation": float(np.sum(np.abs(np.diff(self.command[:, 1], prepend=0.0)))),
            "solve_ms": {"p50": float(p50), "p99": float(p99)},
            "completed": self.completed,
            "failure": self.failure,
            "lap_times_s": laps,
            "outside_m": self.outside,
            "steps": len(self.time),
            "infeasible": self.infeasible,
            "late": self.late,
        }


def race(course: Course, knowledge: Knowledge, progress: Progress | None = None) -> Race:
    """Drives the laps of ``course`` with ``knowledge`` in the controller.

    A plan's time is the processor's: what else runs on the machine changes no simulated lap.

    Args:
        course: what to drive.
        knowledge: what the controller knows of the car.
        progress: told of the millimetres driven, of how many, and of a few words.

    Raises:
        SimulationError: the start is not on the road.
        ConfigurationError: the model's physics needs a signal that there is not.
    """
    vehicle, track, T_s = course.vehicle, course.track, course.vehicle.sampling_time
    pose, state = course.starting()
    require_context(
        [effect for effect in knowledge.car.effects if hasattr(effect, "needs")],  # type: ignore[misc]
        ("t", "s", "lap_length", "x", "y", "theta"),
        f"model {knowledge.name}",
    )
    car = make_plant(vehicle, course.plant, pose, state, lap_length=track.length)
    model = HorizonModel(knowledge.car, course.settings.N)
    controller = Nmpc(model, vehicle.inputs, course.reference, track, course.settings, time.thread_time)
    feedback = Applied(0.0, 0.0)
    memory: Vector | None = None
    history: deque[Vector] = deque(maxlen=max(knowledge.H, 1))
    log: list[tuple[float, Pose, State, Applied, float, float, Vector, Vector, float]] = []
    status = {"solved": 0, "infeasible": 0, "late": 0}
    first, lateral = (float(value) for value in track.project(pose[:2]))
    s, goal, failure = first, first + course.laps * track.length, ""
    limit = PATIENCE * course.laps * course.reference.lap_time
    while True:
        now_t = len(log) * T_s
        began = time.thread_time()
        seen = car.measured
        outlook = controller.outlook
        increments = np.zeros(2) if outlook is None else outlook.u[0]
        history.append(np.array([*seen, *feedback, *increments]))
        adapted = knowledge.read(np.array(history), outlook)
        if memory is None:
            memory = _settled(knowledge, seen, feedback, adapted.theta, car.pose, now_t, s, track)
        now = np.array([*car.pose, *seen, *feedback, *memory])
        plan = controller.plan(now, adapted, now_t)
        command = controller.command(plan)
        status[plan.status] += 1
        history[-1][5:] = np.subtract(command, feedback)
        memory = plan.x[1, len(STATES) :]
        theta, correction = (np.atleast_2d(part)[0] for part in adapted)
        log.append((now_t, car.pose, car.state, command, s, lateral, theta, correction, time.thread_time() - began))
        failure = _failure(course, log[-1], limit)
        if failure or s >= goal:
            break
        car.advance(command, s % track.length)
        feedback = command
        if not all(map(math.isfinite, (*car.pose, *car.state))):
            failure = f"its motion is not finite after {now_t:.2f} s"
            break
        on_track, lateral = (float(value) for value in track.project(car.pose[:2], near=s))
        s += math.remainder(on_track - s, track.length)
        if progress is not None:
            progress(round(1e3 * max(min(s, goal) - first, 0.0)), round(1e3 * (goal - first)), knowledge.name)
    times, poses, states, commands, along, beside, theta_log, correction_log, solve = (
        np.array(column) for column in zip(*log, strict=True)
    )
    return Race(
        knowledge.name, course, times, poses, states, commands, along, beside, theta_log, correction_log, solve,
        status["infeasible"], status["late"], failure,
    )  # fmt: skip


def _settled(
    knowledge: Knowledge, seen: State, feedback: Applied, theta: Vector, pose: Pose, t: float, s: float, track: Track
) -> Vector:
    """The memory of the model's effects at the start."""
    car = knowledge.car
    context = {"t": t, "s": s, "lap_length": track.length, **pose._asdict()}
    coefficients = Coefficients(*(float(value) for value in np.atleast_2d(theta)[0]))
    memory = settled_memory(SCALAR, seen, feedback, coefficients, car.constants, car.effects, None, context)
    return np.array([memory[name] for name in car.memory])


def _failure(course: Course, row: tuple[Any, ...], limit: float) -> str:
    """Why the drive ends before its time; empty if it does not."""
    t, _, state, _, s, lateral = row[:6]
    right, left = (float(width) for width in course.track.widths(s))
    if max(lateral - left, -right - lateral) > LOST * (left + right):
        return f"leaves the track after {t:.2f} s at s = {s % course.track.length:.4g} m"
    if state.v_x <= abs(state.v_y):
        return f"spins or stops after {t:.2f} s at s = {s % course.track.length:.4g} m"
    if t > limit:
        return f"takes longer than {limit:.3g} s"
    return ""
