"""Laps: a driver and a plant on a track, as arrays and as a rosbag2 with the package's default topics."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from dynssm_ros.arrays import Vector
from dynssm_ros.errors import UserError
from dynssm_ros.progress import Progress
from dynssm_ros.signals.inputs import WINDOW_COLUMNS
from dynssm_ros.signals.recording import Recording, RecordingInfo
from dynssm_ros.signals.signal_map import POSE_SIGNALS
from dynssm_ros.signals.standard import write_standard_bag
from dynssm_ros.simulation.plant import START_TIME, PlantKind, make_plant
from dynssm_ros.track.driver import Driver, Style
from dynssm_ros.track.lines import Line
from dynssm_ros.track.tracks import Track
from dynssm_ros.vehicle import Applied, State, Vehicle
from dynssm_ros.vehicle.kinematics import Pose
from dynssm_ros.vehicle.limits import vehicle_limits

DEFAULT_STYLE = Style()


class SimulationError(UserError):
    """The car cannot be driven around the track as asked."""


class Sample(NamedTuple):
    """One instant: state and pose, the feedback of the actuators, the command that acts until the next instant."""

    time: float  # since the start (s)
    state: State
    pose: Pose
    feedback: Applied
    command: Applied
    s: float  # along the track's centre line (m), counted on over the laps
    lateral: float  # beside it (m, positive left)
    measured: State  # what the car's sensors say of state, without noise


@dataclass(frozen=True, eq=False)
class Run:
    """A simulated drive of ``N`` samples. Sample ``k`` holds the state at ``time[k]`` and the command that acts on
    it.
    """

    vehicle: Vehicle  # the car, with the effects that acted
    track: Track
    plant: PlantKind  # how it was integrated
    seed: int  # of driver and noise
    time: npt.NDArray[np.int64]  # stamps (ns), (N,)
    state: Vector  # true v_x, v_y, omega (m/s, m/s, rad/s), (N, 3)
    measured: Vector  # the same with the vehicle's effects on the measurement and noise, (N, 3)
    pose: Vector  # x, y, theta (m, m, rad unwrapped), (N, 3)
    feedback: (
        Vector  # throttle (fraction) or speed set-point (m/s), steering (rad): the commands of the step before, (N, 2)
    )
    command: Vector  # absolute throttle and steering from this step to the next, (N, 2)
    s: Vector  # along the centre line since its first point (m), counted on over the laps, (N,)
    lateral: Vector  # beside it (m, positive left), (N,)

    @property
    def duration(self) -> float:
        """Time from the first sample to the last (s)."""
        return float(self.time[-1] - self.time[0]) / 1e9

    @property
    def laps(self) -> float:
        """Laps driven, with the fraction of the last."""
        return float(self.s[-1] - self.s[0]) / self.track.length

    @property
    def lap_times(self) -> Vector:
        """Times of the complete laps (s), from crossings of the first sample's place."""
        marks = self.s[0] + self.track.length * np.arange(int(self.laps) + 1)
        return np.diff(np.interp(marks, self.s, (self.time - self.time[0]) / 1e9))


def drive(
    vehicle: Vehicle,
    track: Track,
    *,
    plant: PlantKind = "euler",
    seed: int = 0,
    style: Style = DEFAULT_STYLE,
    line: Line | None = None,
) -> Iterator[Sample]:
    """Drives without end, or to the end of an open road, from a rolling start at the line's first point; see
    :func:`simulate`.

    Raises:
        SimulationError: the car spins, stops or leaves the track.
    """
    line = line or track.centre
    room = max(0.0, float(np.min(track.clearance(line.points))))
    driver = Driver(vehicle, line, vehicle_limits(vehicle), style, seed=seed, room=room)
    (x, y), theta = line.position(0.0, driver.offset(0.0)), float(line.heading(0.0))
    v_x = 0.7 * driver.speed(0.0)
    state = State(v_x, 0.0, v_x * float(line.curvature(0.0)))
    car = make_plant(vehicle, plant, Pose(float(x), float(y), theta), state, line=track.centre)
    feedback, on_line = Applied(vehicle.inputs.coasting(v_x), 0.0), 0.0
    s = float(track.project([x, y])[0])
    for k in itertools.count():
        pose, state, time = car.pose, car.state, k * vehicle.sampling_time
        _check_motion(vehicle, track, time, pose, state)
        on_line = float(line.project(pose[:2], near=on_line)[0])
        on_track, lateral = (float(value) for value in track.project(pose[:2], near=s))
        s = track.centre.counted_on(on_track, s)
        _check_place(vehicle, track, time, state, s, lateral)
        command = driver.command(time, pose, state, on_line, feedback)
        yield Sample(time, state, pose, feedback, command, s, lateral, car.measured)
        if not track.centre.closed and s >= track.length:
            return
        car.advance(command, on_track)
        feedback = command


def simulate(
    vehicle: Vehicle,
    track: Track,
    duration: float | None = None,
    laps: float | None = None,
    plant: PlantKind = "euler",
    *,
    seed: int = 0,
    style: Style = DEFAULT_STYLE,
    line: Line | None = None,
    noise: tuple[float, float, float] = (0.0, 0.0, 0.0),
    progress: Progress | None = None,
) -> Run:
    """Drives ``duration`` seconds or a number of ``laps``; an open road once, from start to end, at most.

    Args:
        vehicle: the car; its effects act, its actuator limits hold, its T_s is the time between samples.
        track: where to drive.
        duration: time to drive (s).
        laps: or laps to drive.
        plant: how the car is modelled and its motion integrated.
        seed: of the driver's variation and the noise; the same seed gives the same run.
        style: how the driver drives.
        line: line to follow; the centre line if not given.
        noise: standard deviations of white noise on the measured ``v_x, v_y`` (m/s) and ``omega`` (rad/s).
        progress: told of each sample.

    Raises:
        SimulationError: neither or both of ``duration`` and ``laps``, or one that is not positive; the car spins, stops
            or leaves the track.
    """
    goal = duration if laps is None else laps
    if (duration is None) == (laps is None) or goal is None or not goal > 0:
        raise SimulationError(f"duration {duration}, laps {laps}; expected one of them, positive")
    if laps is not None and laps > 1 and not track.centre.closed:
        raise SimulationError(f"{laps:g} laps of track {track.name}, an open road; expected 1 at most")
    samples: list[Sample] = []
    for sample in drive(vehicle, track, plant=plant, seed=seed, style=style, line=line):
        samples.append(sample)
        done = sample.time if laps is None else (sample.s - samples[0].s) / track.length
        if progress is not None:
            progress(min(round(1000 * done), round(1000 * goal)), round(1000 * goal))
        if done >= goal - 1e-9:
            break
    names = ("state", "measured", "pose", "feedback", "command", "s", "lateral")
    columns = {name: np.array([getattr(sample, name) for sample in samples]) for name in names}
    rng = np.random.default_rng([seed, 1])  # apart from the driver's, so that noise does not change the drive
    columns["measured"] = columns["measured"] + rng.standard_normal((len(samples), 3)) * np.array(noise)
    time = START_TIME + np.round(1e9 * np.array([sample.time for sample in samples])).astype(np.int64)
    return Run(vehicle, track, plant, seed, time, **columns)


def as_recording(run: Run) -> Recording:
    """The drive as it would be extracted from its bag."""
    increments = run.command - run.feedback
    columns = dict(
        zip(
            (*WINDOW_COLUMNS, *POSE_SIGNALS),
            (*run.measured.T, *run.feedback.T, *increments.T, *run.pose.T),
            strict=True,
        )
    )
    info = RecordingInfo(
        sampling_time=run.vehicle.sampling_time,
        commands="topics",
        set_point=run.vehicle.inputs.set_point,
        source=(f"{run.vehicle.name} on {run.track.name}",),
    )
    return Recording(info, run.time, np.zeros(len(run.time), dtype=np.int32), columns)


def write_run(run: Run, path: str | Path) -> None:
    """Writes what a recorder on the car would have written: a rosbag2 folder (MCAP), atomically.

    All messages of a sample carry its stamp. They are logged as they become known: feedback, command, odometry, a
    microsecond apart, so that a reader holds the actuators of a step when its odometry arrives.

    Raises:
        BagError: ``path`` exists and is no bag.
    """
    write_standard_bag(
        path, run.time, run.measured, run.pose, feedback=run.feedback, command=run.command,
        set_point=run.vehicle.inputs.set_point,
    )  # fmt: skip


def _check_motion(vehicle: Vehicle, track: Track, time: float, pose: Pose, state: State) -> None:
    """The car must roll forwards, more along than across."""
    if not (all(map(math.isfinite, (*pose, *state))) and state.v_x > abs(state.v_y)):
        raise SimulationError(
            f"{vehicle.name} spins or stops on track {track.name} after {time:.2f} s "
            f"(v_x = {state.v_x:.3g} m/s, v_y = {state.v_y:.3g} m/s); drive less aggressively"
        )


def _check_place(vehicle: Vehicle, track: Track, time: float, state: State, s: float, lateral: float) -> None:
    """The centre of gravity must stay between the borders."""
    if not track.room(s, lateral) >= 0:
        raise SimulationError(
            f"{vehicle.name} leaves track {track.name} after {time:.2f} s at s = {track.centre.wrapped(s):.4g} m "
            f"({lateral:+.3g} m beside the centre line, {state.v_x:.3g} m/s); "
            "drive less aggressively or take a wider track"
        )
