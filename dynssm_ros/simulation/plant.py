"""The car on the road: the vehicle's equations of motion with its effects, and its pose, advanced step by step."""

from __future__ import annotations

import math
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any, Literal, NamedTuple, Protocol

from dynssm_ros.simulation.double_track import DoubleTrack
from dynssm_ros.vehicle import Applied, Coefficients, State, Vehicle, step_with_memory
from dynssm_ros.vehicle.effects import initial_memory
from dynssm_ros.vehicle.single_track import Integrator, Motion, StageEffect

PlantKind = Literal["euler", "rk4", "double_track"]
"""``euler``: one forward Euler step per T_s for state and pose, as in the published data; ``rk4``: steps of 1 ms;
``double_track``: four wheels with load transfer, in steps of 1 ms."""

RK4_STEP = 1e-3  # s, at most

# floats through `math` are ten times faster than through numpy; the names are those of numpy
SCALAR = SimpleNamespace(
    sin=math.sin, cos=math.cos, tan=math.tan, arctan=math.atan, arctan2=math.atan2, tanh=math.tanh, exp=math.exp,
    sqrt=math.sqrt, fabs=math.fabs, hypot=math.hypot, pi=math.pi,
)  # fmt: skip


class Pose(NamedTuple):
    """Position (m) and heading (rad, counter-clockwise, not wrapped) of the centre of gravity."""

    x: float
    y: float
    theta: float


class Plant(Protocol):
    """A car that can be driven."""

    @property
    def pose(self) -> Pose:
        """Where it is."""

    state: State
    """How it moves."""

    def advance(self, applied: Applied, s: float = 0.0) -> None:
        """Moves it on by T_s under constant inputs; ``s`` is its track position (m), for effects that live there."""


class _Odometer:
    """Carries the pose as states of the equations of motion, so that it is integrated exactly like them."""

    MEMORY = ("pose.x", "pose.y", "pose.theta")

    def apply(self, stage: str, xp: Any, q: Motion) -> None:
        """Shows the pose to the effects that follow, and sets its rates."""
        x, y, theta = self.MEMORY
        if stage == "inputs":
            q.context = {**q.context, "x": q.memory[x], "y": q.memory[y], "theta": q.memory[theta]}
        elif stage == "accelerations":
            sin, cos = xp.sin(q.memory[theta]), xp.cos(q.memory[theta])
            q.memory_rate[x] = q.v_x * cos - q.v_y * sin
            q.memory_rate[y] = q.v_x * sin + q.v_y * cos
            q.memory_rate[theta] = q.omega


class SingleTrackPlant:
    """The single-track car. The input of a step acts on that step.

    Effects may read from the context ``time`` (s) and ``s`` (m), held over a step, and ``x, y, theta`` (m, m, rad).
    ``first`` and ``last`` act before and after the vehicle's own effects.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        integrator: Integrator,
        pose: Pose,
        state: State,
        first: Sequence[StageEffect] = (),
        last: Sequence[StageEffect] = (),
    ) -> None:
        self.state = state
        self._vehicle = vehicle
        self._integrator: Integrator = integrator
        self._theta = Coefficients(*(float(value) for value in vehicle.nominal))
        self._effects: tuple[StageEffect, ...] = (_Odometer(), *first, *vehicle.active_effects, *last)
        self._memory = dict(zip(_Odometer.MEMORY, pose, strict=True))
        self._memory |= initial_memory(vehicle.active_effects, 0.0, 0.0)
        self._substeps = 1 if integrator == "euler" else math.ceil(vehicle.sampling_time / RK4_STEP - 1e-9)
        self._steps = 0

    @property
    def pose(self) -> Pose:
        """Where the car is."""
        return Pose(*(self._memory[name] for name in _Odometer.MEMORY))

    def advance(self, applied: Applied, s: float = 0.0) -> None:
        """Moves the car on by T_s under constant inputs; ``s`` is its track position (m)."""
        T_s = self._vehicle.sampling_time
        self.state, self._memory = step_with_memory(
            SCALAR,
            self.state,
            self._memory,
            applied,
            self._theta,
            self._vehicle.constants,
            T_s,
            self._effects,
            self._integrator,
            self._substeps,
            {"time": self._steps * T_s, "s": s},
        )
        self._steps += 1


def make_plant(vehicle: Vehicle, kind: PlantKind, pose: Pose, state: State, last: Sequence[StageEffect] = ()) -> Plant:
    """The plant of that kind, at ``pose`` and moving with ``state``; ``last`` acts after the vehicle's effects."""
    if kind == "double_track":
        return SingleTrackPlant(vehicle, "rk4", pose, state, (DoubleTrack.of(vehicle.constants),), last)
    return SingleTrackPlant(vehicle, kind, pose, state, (), last)
