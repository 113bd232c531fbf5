"""The car on the road: the vehicle's equations of motion with its effects, and its pose, advanced step by step."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import Any, Protocol

from dynssm_ros.errors import ConfigurationError
from dynssm_ros.simulation.double_track import DoubleTrack
from dynssm_ros.track.lines import Line
from dynssm_ros.vehicle import Applied, CarModel, Coefficients, State, Vehicle
from dynssm_ros.vehicle.compiled_car import CompiledStep
from dynssm_ros.vehicle.effects import require_context
from dynssm_ros.vehicle.integrators import Integrator
from dynssm_ros.vehicle.kinematics import SCALAR, Pose, time_of_day, world_velocity
from dynssm_ros.vehicle.single_track import Motion, StageEffect

PlantKind = str
"""Name of a plant, see :data:`PLANTS`."""

RK4_STEP = 1e-3  # s, at most
START_TIME = 1_000_000_000_000_000_000  # ns: the stamp of a drive's first sample; a fixed one, so that runs repeat


class Plant(Protocol):
    """A car that can be driven."""

    @property
    def pose(self) -> Pose:
        """Where it is."""

    @property
    def state(self) -> State:
        """How it moves."""

    @property
    def measured(self) -> State:
        """What its sensors say of that, without noise."""

    def advance(self, applied: Applied, s: float = 0.0) -> None:
        """Moves it on by T_s under constant inputs; ``s`` is its track position (m), for effects that live there."""


class _Odometer(StageEffect):
    """Carries the pose as states of the equations of motion, so that it is integrated exactly like them."""

    POSE = ("pose.x", "pose.y", "pose.theta")

    def inputs(self, xp: Any, q: Motion) -> None:
        """Shows the pose to the effects that follow."""
        x, y, theta = self.POSE
        now = q.effect_states
        q.context = {**q.context, "x": now[x], "y": now[y], "theta": now[theta]}

    def accelerations(self, xp: Any, q: Motion) -> None:
        """Sets the rates of the pose."""
        x, y, theta = self.POSE
        q.effect_state_rates[x], q.effect_state_rates[y] = world_velocity(xp, q.effect_states[theta], q.v_x, q.v_y)
        q.effect_state_rates[theta] = q.omega


class SingleTrackPlant:
    """The single-track car. The input of a step acts on that step.

    Effects may read from the context ``t`` and ``clock`` (s), ``s``, ``lap_length`` (m) and ``bend``, held over a step, and
    ``x, y, theta`` (m, m, rad). Those that change what is measured leave the motion as it is.

    Args:
        vehicle: the car with its effects.
        integrator: how its motion is integrated.
        pose: where it starts.
        state: how it moves then.
        first: acts before the vehicle's own effects.
        last: acts after them.
        line: centre line of the track; ``None`` if there is none.
        step: longest Runge-Kutta step (s).

    Raises:
        ConfigurationError: an effect needs a signal that there is not.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        integrator: Integrator,
        pose: Pose,
        state: State,
        *,
        first: Sequence[StageEffect] = (),
        last: Sequence[StageEffect] = (),
        line: Line | None = None,
        step: float = RK4_STEP,
    ) -> None:
        self.state = state
        self._vehicle = vehicle
        self._theta = Coefficients(*(float(value) for value in vehicle.nominal))
        effects = vehicle.active_effects
        sensors = [effect for effect in effects if effect.SENSOR and not effect.reading_delay]
        physics = [effect for effect in effects if not effect.SENSOR]
        acting: tuple[StageEffect, ...] = (_Odometer(), *first, *physics, *last, *sensors)
        delay = sum(effect.reading_delay for effect in effects)
        substeps = 1 if integrator == "euler" else math.ceil(vehicle.sampling_time / step - 1e-9)
        self._pieces = substeps if delay > 0 else 1  # a late reading falls between two steps
        T_s, substeps = vehicle.sampling_time / self._pieces, substeps // self._pieces
        self._car = CarModel(
            vehicle.constants, T_s, acting, integrator, substeps,
            xp=SCALAR, set_point=vehicle.inputs.set_point, measured=False,
        )  # fmt: skip
        self._steps = 0
        self._line = line
        require_context(effects, {*self._context(0.0), *Pose._fields}, "simulation")
        self._effect_states = self._car.settled(
            state,
            Applied(vehicle.inputs.coasting(state.v_x), 0.0),
            self._theta,
            dict(zip(_Odometer.POSE, pose, strict=True)),
            context=self._context(0.0),
        )
        self._compiled = CompiledStep.of(self._car, self._theta, tuple(self._effect_states), tuple(self._context(0.0)))
        self._late = _Late(delay, self._seen()) if delay > 0 else None

    @property
    def pose(self) -> Pose:
        """Where the car is."""
        return Pose(*(self._effect_states[name] for name in _Odometer.POSE))

    @property
    def measured(self) -> State:
        """What the sensors say of the motion, without noise."""
        return self._late.state if self._late else self._seen()

    def advance(self, applied: Applied, s: float = 0.0) -> None:
        """Moves the car on by T_s under constant inputs; ``s`` is its track position (m)."""
        context = self._context(s)
        for _ in range(self._pieces):
            self.state, self._effect_states = self._step(applied, context)
            if self._late:
                self._late.add(self._car.T_s, self._seen())
        self._steps += 1

    def _step(self, applied: Applied, context: dict[str, float]) -> tuple[State, dict[str, float]]:
        if self._compiled is not None:
            return self._compiled(self.state, applied, self._effect_states, context)
        return self._car.step(self.state, applied, self._theta, self._effect_states, context=context)

    def _context(self, s: float) -> dict[str, float]:
        place = {"s": s} if self._line is None else self._line.place(s)
        t = self._steps * self._vehicle.sampling_time
        return {"t": t, "clock": time_of_day(START_TIME) + t, **place}

    def _seen(self) -> State:
        """The present state as the sensors see it."""
        return self._car.measured_state(self.state, self._effect_states)


class _Late:
    """A state that is read ``delay`` seconds late; it was ``first`` for ever before."""

    def __init__(self, delay: float, first: State) -> None:
        self._delay = delay
        self._past = deque([(-delay, first), (0.0, first)])

    def add(self, h: float, state: State) -> None:
        """Notes the state ``h`` seconds after the last one."""
        self._past.append((self._past[-1][0] + h, state))
        while self._past[1][0] <= self._past[-1][0] - self._delay:
            self._past.popleft()

    @property
    def state(self) -> State:
        """The state then, between two notes in proportion."""
        (before, old), (after, new) = self._past[0], self._past[1]
        share = (self._past[-1][0] - self._delay - before) / (after - before)
        return State(*(a + share * (b - a) for a, b in zip(old, new, strict=True)))


class PlantType:
    """How cars of a kind of plant are made. Derive your own and register it by :func:`register_plant`.

    This one takes one forward Euler step per T_s for state and pose, as in the published data.
    """

    integrator: Integrator = "euler"
    """Of a model that steps like it: ``euler`` carries the pose by the velocity at the start of a step."""
    substeps = 1
    """Of such a model."""

    def step(self, vehicle: Vehicle) -> float:
        """Longest integration step (s)."""
        return vehicle.sampling_time

    def first(self, vehicle: Vehicle) -> tuple[StageEffect, ...]:
        """Physics that it has beyond the single-track equations."""
        return ()

    def make(self, vehicle: Vehicle, pose: Pose, state: State, last: Sequence[StageEffect], line: Line | None) -> Plant:
        """A car of that kind; see :class:`SingleTrackPlant` for the arguments and errors."""
        return SingleTrackPlant(
            vehicle, self.integrator, pose, state,
            first=self.first(vehicle), last=last, line=line, step=self.step(vehicle),
        )  # fmt: skip


class Rk4Plant(PlantType):
    """Runge-Kutta steps of 1 ms at most."""

    integrator: Integrator = "rk4"
    substeps = 2

    def step(self, vehicle: Vehicle) -> float:
        """1 ms."""
        return RK4_STEP


class DoubleTrackPlant(Rk4Plant):
    """Four wheels with load transfer and load-sensitive tyres, in steps of 1 ms."""

    def first(self, vehicle: Vehicle) -> tuple[StageEffect, ...]:
        """Left and right wheels."""
        return (DoubleTrack.of(vehicle.constants),)


PLANTS: dict[str, PlantType] = {"euler": PlantType(), "rk4": Rk4Plant(), "double_track": DoubleTrackPlant()}
"""Plants by name."""


def register_plant(name: str, plant: PlantType) -> None:
    """Makes a plant known by its name to ``simulate``, ``race`` and the simulator node.

    Raises:
        ValueError: the name is taken.
    """
    if PLANTS.get(name, plant) is not plant:
        raise ValueError(f"plant {name}: the name is taken by {type(PLANTS[name]).__name__}")
    PLANTS[name] = plant


def plant_type(kind: PlantKind) -> PlantType:
    """The plant of that name.

    Raises:
        ConfigurationError: there is none.
    """
    if kind not in PLANTS:
        raise ConfigurationError(f"plant '{kind}'; expected one of {', '.join(PLANTS)}")
    return PLANTS[kind]


def make_plant(
    vehicle: Vehicle,
    kind: PlantKind,
    pose: Pose,
    state: State,
    *,
    last: Sequence[StageEffect] = (),
    line: Line | None = None,
) -> Plant:
    """A car of that kind of plant; see :class:`SingleTrackPlant` for the arguments and errors."""
    return plant_type(kind).make(vehicle, pose, state, last, line)
