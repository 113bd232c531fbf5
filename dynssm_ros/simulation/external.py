"""A car that somebody else drives: it obeys commands as they come, brakes when they stop coming, and stands still well."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from typing import Any

from dynssm_ros.simulation.laps import Sample, SimulationError
from dynssm_ros.simulation.plant import RK4_STEP, PlantKind, Pose, make_plant
from dynssm_ros.simulation.tracks import Track
from dynssm_ros.vehicle import Applied, State, Vehicle
from dynssm_ros.vehicle.single_track import Array, Motion

Clock = Callable[[], float]


class CommandHolder:
    """The last command, within what the actuators can do, for as long as it is fresh; after that the brakes.

    Args:
        vehicle: whose actuator limits hold.
        timeout: age (s) of a command from which on the car brakes with its steering held.
        clock: time now (s), of any origin.
    """

    def __init__(self, vehicle: Vehicle, timeout: float, clock: Clock) -> None:
        self._limits = vehicle.inputs
        self._reach = vehicle.inputs.steering_rate * vehicle.sampling_time
        self._timeout = timeout
        self._clock = clock
        self._last = Applied(0.0, 0.0)
        self._since = -math.inf

    @property
    def fresh(self) -> bool:
        """Whether there is a command to obey."""
        return self._clock() - self._since <= self._timeout

    def receive(self, command: Applied) -> bool:
        """Takes a command; one that is not finite changes nothing. Returns whether it was taken."""
        if not all(map(math.isfinite, command)):
            return False
        self._last, self._since = command, self._clock()
        return True

    def command(self, previous: Applied) -> Applied:
        """What the actuators do next, ``previous`` being what they do now."""
        wanted = self._last if self.fresh else Applied(self._limits.throttle[0], previous.delta)
        delta = _between(wanted.delta, previous.delta - self._reach, previous.delta + self._reach)
        return Applied(_between(wanted.r, *self._limits.throttle), _between(delta, *self._limits.steering))


class Creeping:
    """Takes the place of the tyres at low speed, as an effect: the wheels roll without slip, and never backwards.

    The tyres' response quickens as the car slows down. Below the speed at which it is as quick as the steps of the
    plant, forward Euler rings; and the resistance of the nominal model would push a standing car back.
    """

    def __init__(self, vehicle: Vehicle, plant: PlantKind) -> None:
        th = {name: c.nominal for name, c in vehicle.coefficients.items()}
        car = vehicle.constants
        front, rear = (th[f"B_{axle}"] * th[f"C_{axle}"] * th[f"D_{axle}"] for axle in "fr")
        stiffest = max((front + rear) / car.m, (car.l_f**2 * front + car.l_r**2 * rear) / th["I_z"])  # m/s^2
        self._step = vehicle.sampling_time if plant == "euler" else RK4_STEP
        self.speed = stiffest * self._step / 2  # m/s

    def apply(self, stage: str, xp: Any, q: Motion) -> None:
        """Sets the rates of the state such that it rolls within one step."""
        if stage != "accelerations":
            return
        omega = q.v_x * xp.tan(q.delta) / (q.l_f + q.l_r)
        rest = -q.v_x / self._step
        rolling = (
            _chosen(q.a_x > rest, q.a_x, rest),
            (q.l_r * omega - q.v_y) / self._step,
            (omega - q.omega) / self._step,
        )
        creeps = q.v_x <= self.speed
        q.a_x, q.a_y, q.omega_dot = (
            _chosen(creeps, *pair) for pair in zip(rolling, (q.a_x, q.a_y, q.omega_dot), strict=True)
        )


def _chosen(condition: Array, one: Array, other: Array) -> Array:
    """``one`` where ``condition`` holds, else ``other``; also of casadi symbols."""
    return condition * one + (1 - condition) * other


def drive_by_commands(
    vehicle: Vehicle, track: Track, plant: PlantKind, next_command: Callable[[Applied], Applied]
) -> Iterator[Sample]:
    """Goes on without end from standstill at the first point of the centre line, on and off the road.

    Args:
        vehicle: the car; its effects act.
        track: where it starts.
        plant: how the car is modelled and its motion integrated; see :class:`Creeping` for low speeds.
        next_command: from what the actuators do now to what they do next; asked once per T_s.

    Raises:
        SimulationError: the motion is not finite.
    """
    (x, y), theta = track.centre.position(0.0), float(track.centre.heading(0.0))
    start = Pose(float(x), float(y), theta), State(0.0, 0.0, 0.0)
    car = make_plant(vehicle, plant, *start, last=(Creeping(vehicle, plant),), lap_length=track.length)
    feedback, s = Applied(0.0, 0.0), 0.0
    for k in itertools.count():
        time, pose, state = k * vehicle.sampling_time, car.pose, car.state
        if not all(map(math.isfinite, (*pose, *state))):
            raise SimulationError(
                f"{vehicle.name}: its motion is not finite after {time:.2f} s; expected other commands"
            )
        on_track, lateral = (float(value) for value in track.project(pose[:2], near=s))
        s += math.remainder(on_track - s, track.length)
        command = next_command(feedback)
        yield Sample(time, state, pose, feedback, command, s, lateral, car.measured)
        car.advance(command, on_track)
        feedback = command


def _between(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)
