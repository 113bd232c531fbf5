"""A car bound to its constants, sampling time, effects and integrator: its motion, its steps, its effect states.

Some effects change what is measured and not what happens. :meth:`CarModel.motion` is about what happens. Steps take and
give what is measured, because a model starts from it and is compared with it: measured -> true -> step -> measured.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, fields, replace
from functools import cached_property
from importlib import import_module
from types import ModuleType
from typing import Any

import numpy as np

from dynssm_ros.vehicle.effects.base import initial_effect_states, inputs_alone
from dynssm_ros.vehicle.integrators import Integrator, add, integrate
from dynssm_ros.vehicle.low_speed import LowSpeedRolling
from dynssm_ros.vehicle.parameters import Vehicle
from dynssm_ros.vehicle.single_track import (
    INSTANT,
    Applied,
    Array,
    Coefficients,
    Motion,
    SetPoint,
    Stage,
    StageEffect,
    State,
    VehicleConstants,
    at_least,
    staged,
)

CARRIED_S = 0.64  # length of the window over which effect states are carried (s); lags are far shorter

EffectStates = Mapping[str, Array]  # the effects' own states (a lag, a relaxing tyre) by name


@dataclass(frozen=True)
class CarModel:
    """The physics of a car in one array namespace.

    Throughout, ``state`` has the body-frame velocities and ``applied`` the throttle and steering that act now, each of
    shape ``(...)``. The coefficients ``theta`` are broadcastable to it. ``context`` has other signals that effects read, by
    the names of ``CONTEXT_UNITS``. Effect states that are not given start settled.
    """

    constants: VehicleConstants  # mass and geometry
    T_s: float  # length of a step (s)
    effects: Sequence[StageEffect] = ()  # physics beyond the nominal model, in the order in which it acts
    integrator: Integrator = "euler"  # of a step; the paper's is one forward Euler step
    substeps: int = 1  # integration steps per step
    _: KW_ONLY
    xp: Any = np  # array namespace: numpy, torch, casadi or ``SCALAR``
    set_point: SetPoint = "throttle"  # what the first input asks for
    measured: bool = True  # whether states are measured ones, as models step them, or true ones, as a plant does

    @classmethod
    def of(cls, vehicle: Vehicle, integrator: Integrator | None = None, substeps: int = 1, *, xp: Any = np) -> CarModel:
        """The car of a vehicle file with its effects; without ``integrator`` with the one that it was calibrated for."""
        integrator = integrator or vehicle.model_integrator
        return cls(
            vehicle.constants, vehicle.sampling_time, vehicle.active_effects, integrator, substeps,
            xp=xp, set_point=vehicle.inputs.set_point,
        )  # fmt: skip

    @classmethod
    def at_any_speed(
        cls,
        vehicle: Vehicle,
        integrator: Integrator | None = None,
        substeps: int = 1,
        *,
        first: Sequence[StageEffect] = (),
    ) -> CarModel:
        """As :meth:`of`, also at low speed, where a step of T_s is too long for the tyres.

        ``first`` acts before the vehicle's own effects.
        """
        car = cls.of(vehicle, integrator, substeps)
        return replace(car, effects=(*first, *car.effects, LowSpeedRolling(vehicle, car.T_s)))

    def under(self, xp: Any) -> CarModel:
        """The same car in another array namespace."""
        return replace(self, xp=xp)

    @cached_property
    def effect_states(self) -> tuple[str, ...]:
        """Names of the effects' own states."""
        return tuple(name for effect in self.effects for name in effect.carries)

    @cached_property
    def sensors(self) -> tuple[StageEffect, ...]:
        """The effects that change what is measured."""
        return tuple(effect for effect in self.effects if effect.measures)

    @cached_property
    def _stages(self) -> tuple[Stage, ...]:
        return staged(self.effects)

    def __getstate__(self) -> dict[str, Any]:
        """The attributes; a module goes by its name."""
        state = {each.name: getattr(self, each.name) for each in fields(self)}
        if isinstance(self.xp, ModuleType):
            state["xp"] = self.xp.__name__
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        xp = state["xp"]
        vars(self).update(state, xp=import_module(xp) if isinstance(xp, str) else xp)

    def motion(
        self,
        state: State,
        applied: Applied,
        theta: Coefficients,
        effect_states: EffectStates | None = None,
        *,
        context: Mapping[str, Array] | None = None,
        h: float = INSTANT,
    ) -> Motion:
        """All quantities of one instant, from the true ``state``.

        Effect states that are not given are settled and returned with the result. ``h`` is the time (s) over which an
        integrator holds the rates; lags that are quicker settle within it.

        Raises:
            ConfigurationError: an effect needs a signal that ``context`` does not have.
        """
        car = self.constants
        q = Motion(
            *state,
            *applied,
            theta=theta,
            m=car.m,
            l_f=car.l_f,
            l_r=car.l_r,
            h_cg=car.h_cg,
            F_z0=car.F_z0,
            load_transfer=car.load_transfer,
            set_point=self.set_point,
            reverse=car.reverse,
            effect_states=dict(effect_states or {}),
            context=context or {},
            h=h,
        )
        for stage in self._stages:
            stage(self.xp, q)
        return q

    def measured_state(self, state: State, effect_states: EffectStates) -> State:
        """What the sensors show of the true ``state``."""
        for sensor in self.sensors:
            state = sensor.measured(self.xp, state, effect_states)
        return state

    def true_state(self, state: State, effect_states: EffectStates) -> State:
        """The true state behind a measured one: the inverse of :meth:`measured_state`."""
        for sensor in reversed(self.sensors):
            state = sensor.true(self.xp, state, effect_states)
        return state

    def settled(
        self,
        state: State,
        applied: Applied,
        theta: Coefficients,
        known: EffectStates | None = None,
        *,
        context: Mapping[str, Array] | None = None,
    ) -> dict[str, Array]:
        """The effect states ``known`` and those that it lacks, settled under ``applied``.

        To start from measured rows, ``applied`` is what acted until then: the actuators' feedback. The state of a sensor
        that hides part of the true motion depends on that motion in turn. Both are found by a secant step, exact as far as
        the motion is linear in what is hidden.
        """
        known = dict(known or {})
        if all(name in known for name in self.effect_states):
            return known

        def settled(hidden: EffectStates) -> dict[str, Array]:
            true = self.true_state(state, {**known, **hidden}) if self.measured else state
            return self.motion(true, applied, theta, known, context=context).effect_states

        first = settled({})
        names = [name for sensor in self.sensors for name in sensor.carries if name not in known]
        if not (self.measured and names):
            return first
        second = settled({name: first[name] for name in names})
        hidden = {name: _meeting(first[name], second[name]) for name in names}
        return settled(hidden) | hidden

    def step(
        self,
        state: State,
        applied: Applied,
        theta: Coefficients,
        effect_states: EffectStates | None = None,
        *,
        context: Mapping[str, Array] | None = None,
    ) -> tuple[State, dict[str, Array]]:
        """State and effect states after ``T_s`` seconds of constant inputs, Eq. (32)."""
        now = self.settled(state, applied, theta, effect_states, context=context)
        moved, changed = self.increment(state, applied, theta, now, context=context)
        return State(*add(state, moved)), {name: value + changed[name] for name, value in now.items()}

    def increment(
        self,
        state: State,
        applied: Applied,
        theta: Coefficients,
        effect_states: EffectStates | None = None,
        *,
        context: Mapping[str, Array] | None = None,
    ) -> tuple[State, dict[str, Array]]:
        """How much state and effect states change in a step.

        In single precision an increment is known far better than the difference of two states.
        """
        now = self.settled(state, applied, theta, effect_states, context=context)
        sensors = self.measured and self.sensors
        true = self.true_state(state, now) if sensors else state
        names, h = tuple(now), self.T_s / self.substeps

        def rates(y: Sequence[Array]) -> tuple[Array, ...]:
            q = self.motion(State(*y[:3]), applied, theta, dict(zip(names, y[3:], strict=True)), context=context, h=h)
            return (q.a_x, q.a_y, q.omega_dot, *map(q.effect_state_rates.__getitem__, names))

        moved = integrate(rates, (*true, *now.values()), self.T_s, self.integrator, self.substeps)
        change, changed = State(*moved[:3]), dict(zip(names, moved[3:], strict=True))
        if sensors:
            end = {name: value + changed[name] for name, value in now.items()}
            seen = self.measured_state(State(*add(true, change)), end)
            change = State(*(after - before for after, before in zip(seen, state, strict=True)))
        return change, changed

    def over(
        self, states: State, applied: Applied, feedback: Applied, theta: Coefficients, latest: int | None = None
    ) -> State:
        """Increments from the latest rows of measured windows, each of shape ``(B, latest, ...)``.

        Args:
            states: measured, in order, ``T_s`` apart, each of shape ``(B, H, ...)``.
            applied: inputs that act from each row on, ``(B, H, ...)``.
            feedback: measured inputs, ``(B, H, ...)``.
            theta: numbers, or values of shape ``(B, 1, ...)`` that hold over the window.
            latest: rows wanted; ``None``: all.
        """
        wanted = slice(0 if latest is None else states.v_x.shape[1] - latest, None)
        if self.effect_states:
            along = self.effect_states_along(states, applied, feedback, theta)[wanted]
            now = {name: self.xp.stack([at[name] for at in along], 1) for name in along[0]}
        else:
            now = initial_effect_states(self.effects, *(each[:, wanted] for each in feedback))
        state = State(*(each[:, wanted] for each in states))
        acting = Applied(*(each[:, wanted] for each in applied))
        return self.increment(state, acting, theta, now)[0]

    def effect_states_along(
        self, states: State, applied: Applied, feedback: Applied, theta: Coefficients
    ) -> list[dict[str, Array]]:
        """Effect states at each row of measured windows, each of shape ``(B, ...)``; for the arguments see :meth:`over`.

        At every row the state is the measured one; only what no sensor shows is carried, such as where a lagging steering
        is. It starts settled under the feedback of the first row. Effect states on the inputs alone, as those of lagging
        actuators, are carried without the car's equations.
        """
        rows = [
            (State(*(each[:, k] for each in states)), Applied(*(each[:, k] for each in applied)))
            for k in range(states.v_x.shape[1])
        ]
        theta = Coefficients(*(each[:, 0] if getattr(each, "ndim", 0) > 1 else each for each in theta))
        known = initial_effect_states(self.effects, *(each[:, 0] for each in feedback))
        carried = self.settled(*rows[0], theta, known)
        along = [carried]
        for state, acting in rows[:-1]:
            carried = self.carried_on(state, acting, theta, carried)
            along.append(carried)
        return along

    def carried_on(
        self, state: State, applied: Applied, theta: Coefficients, effect_states: EffectStates
    ) -> dict[str, Array]:
        """All effect states one step after a row."""
        names = tuple(effect_states)
        if names == self._on_inputs:

            def rates(y: Sequence[Array]) -> tuple[Array, ...]:
                here = dict(zip(names, y, strict=True))
                q = inputs_alone(self.xp, state, applied, self.effects, effect_states=here, h=self.T_s / self.substeps)
                return tuple(q.effect_state_rates[name] for name in names)

            changes = integrate(rates, tuple(effect_states.values()), self.T_s, self.integrator, self.substeps)
            changed = dict(zip(names, changes, strict=True))
        else:
            _, changed = self.increment(state, applied, theta, effect_states)
        return {name: value + changed[name] for name, value in effect_states.items()}

    @cached_property
    def _on_inputs(self) -> tuple[str, ...]:
        """Names of the effect states that the inputs alone settle."""
        return tuple(initial_effect_states(self.effects, 0.0, 0.0))


def _meeting(first: Array, second: Array) -> Array:
    """Where the line through ``(0, first)`` and ``(first, second)`` meets the diagonal, if it falls or hardly rises."""
    square = first * first
    return first * square / at_least(2 * square - first * second, square / 4 + 1e-30)
