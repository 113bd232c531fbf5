"""A car's steps by the compiled loop, over windows and one after the other: its equations as tapes."""

from __future__ import annotations

import pickle
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import replace
from typing import Any

import numpy as np

from dynssm_ros import compiled
from dynssm_ros.arrays import Vector
from dynssm_ros.vehicle.car import CarModel
from dynssm_ros.vehicle.effects.base import initial_effect_states
from dynssm_ros.vehicle.integrators import add
from dynssm_ros.vehicle.parameters import COEFFICIENTS
from dynssm_ros.vehicle.single_track import Applied, Coefficients, State
from dynssm_ros.vehicle.tape import Tape, trace


def room(tape: Tape) -> Vector:
    """Where a tape's slots lie, ``(slots, LANES)``; the loop overwrites neither inputs nor constants."""
    work = np.zeros((tape.slots, compiled.LANES))
    work[tape.inputs : tape.inputs + len(tape.constants)] = tape.constants[:, None]
    return work


def tape_structure(tape: Tape, work: Vector | None = None) -> compiled.TapeStructure:
    """A tape as the library takes it, with :func:`room` to work in."""
    structure = compiled.TapeStructure()
    structure.fill(
        code=tape.code, operations=len(tape.code), work=room(tape) if work is None else work, outputs=tape.outputs,
        count=len(tape.outputs),
    )  # fmt: skip
    return structure


def _traced(car: CarModel, theta: Coefficients | None) -> dict[str, Tape] | None:
    """The car's step and, with effect states, how they are settled and carried; see :class:`CompiledCar`.

    With ``theta`` it has these coefficients, else they are the last inputs. ``None`` if its equations cannot be traced: an
    effect branches on a value, or computes with what a tape does not have.
    """
    names, given = car.effect_states, len(COEFFICIENTS) if theta is None else 0

    def of(q: Sequence[Any]) -> Coefficients:
        return Coefficients(*q[-given:]) if theta is None else theta

    def carried(q: Sequence[Any]) -> dict[str, Any]:
        return dict(zip(names, q[5 : 5 + len(names)], strict=True))

    def step(xp: Any, *q: Any) -> Sequence[Any]:
        return car.under(xp).increment(State(*q[:3]), Applied(*q[3:5]), of(q), carried(q))[0]

    def settle(xp: Any, *q: Any) -> Sequence[Any]:
        known = initial_effect_states(car.effects, *q[5:7])
        now = car.under(xp).settled(State(*q[:3]), Applied(*q[3:5]), of(q), known)
        return [now[name] for name in names]

    def carry(xp: Any, *q: Any) -> Sequence[Any]:
        now = car.under(xp).carried_on(State(*q[:3]), Applied(*q[3:5]), of(q), carried(q))
        return [now[name] for name in names]

    try:
        tapes = {"step": trace(step, 5 + len(names) + given)}
        if names:
            tapes |= {"settle": trace(settle, 7 + given), "carry": trace(carry, 5 + len(names) + given)}
    except (TypeError, AttributeError):
        return None
    return tapes


def car_structure(car: CarModel, theta: Vector, rows: int) -> compiled.CarStructure | None:
    """The steps of a car with the coefficients ``theta`` ``(17,)`` from windows of ``rows`` rows.

    ``None`` if its equations cannot be traced.
    """
    tapes = _traced(car, Coefficients(*theta.tolist()))
    if tapes is None:
        return None
    return _structure(car, rows, {name: tape_structure(tape) for name, tape in tapes.items()})


def _structure(car: CarModel, rows: int, tapes: dict[str, compiled.TapeStructure]) -> compiled.CarStructure:
    structure, states = compiled.CarStructure(), len(car.effect_states)
    structure.fill(**tapes, states=states, along=np.zeros((rows, max(states, 1), compiled.LANES)))
    return structure


class CompiledCar:
    """A car's steps over a window, with coefficients that are given with it."""

    def __init__(self, car: CarModel, rows: int, tapes: dict[str, Tape]) -> None:
        works = {name: room(tape) for name, tape in tapes.items()}
        given = len(COEFFICIENTS)
        self._theta = [works[name][tape.inputs - given : tape.inputs] for name, tape in tapes.items()]
        self._structure = _structure(
            car, rows, {name: tape_structure(tape, works[name]) for name, tape in tapes.items()}
        )
        self._moved = np.empty((rows, 3))

    @classmethod
    def of(cls, car: CarModel, rows: int) -> CompiledCar | None:
        """For windows of so many rows; ``None`` without the library, or if the car's equations cannot be traced."""
        tapes = None if compiled.LIBRARY is None else _traced(car, None)
        return None if tapes is None else cls(car, rows, tapes)

    def over(self, rows: Vector, theta: Vector) -> Vector:
        """Increments ``(H, 3)`` from each row of a window ``(H, 7)`` with the coefficients ``theta`` ``(17,)``.

        As :meth:`CarModel.over`. The array is used again by the next call.
        """
        assert compiled.LIBRARY is not None
        for place in self._theta:
            place[:] = theta[:, None]
        count = len(rows)
        rows, moved = np.ascontiguousarray(rows), self._moved
        compiled.LIBRARY.dynssm_over(
            self._structure.address, compiled.address(rows), 1, count, count, compiled.address(moved)
        )
        return moved


class CompiledStep:
    """One step of a car after the other, its coefficients fixed, as a plant takes them."""

    def __init__(self, car: CarModel, tape: Tape, states: Sequence[str], context: Sequence[str]) -> None:
        self._names, self._context, self._substeps = tuple(states), tuple(context), car.substeps
        work = room(tape)
        self._moved, self._given = np.split(work[: tape.inputs], [len(tape.outputs)])
        self._structure = tape_structure(tape, work)

    @classmethod
    def of(
        cls, car: CarModel, theta: Coefficients, states: Sequence[str], context: Sequence[str]
    ) -> CompiledStep | None:
        """Of a car with these effect states, whose effects read this ``context``.

        ``None`` without the library, or if its equations cannot be traced. Neither are those of an effect that changes
        while it computes, or computes something else a second time.
        """
        if compiled.LIBRARY is None:
            return None
        n = 3 + len(states)

        def step(xp: Any, *q: Any) -> Sequence[Any]:
            moved, start, applied, beside = q[:n], q[n : 2 * n], Applied(*q[2 * n : 2 * n + 2]), q[2 * n + 2 :]
            now, here = add(start, moved), dict(zip(context, beside, strict=True))
            carried = dict(zip(states, now[3:], strict=True))
            change, changed = there.under(xp).increment(State(*now[:3]), applied, theta, carried, context=here)
            return add(moved, [*change, *(changed[name] for name in states)])

        inputs = 2 * n + 2 + len(context)
        try:
            effects = deepcopy(car.effects)  # a trace leaves no mark on what drives
            there = replace(car, T_s=car.T_s / car.substeps, substeps=1, effects=effects)
            before = pickle.dumps(effects)
            tape, again = trace(step, inputs), trace(step, inputs)
            same = pickle.dumps(effects) == before and pickle.dumps(tape) == pickle.dumps(again)
        except (TypeError, AttributeError, pickle.PicklingError):
            return None
        return cls(car, tape, states, context) if same else None

    def __call__(
        self, state: State, applied: Applied, effect_states: Mapping[str, float], context: Mapping[str, float]
    ) -> tuple[State, dict[str, float]]:
        """As :meth:`CarModel.step`."""
        assert compiled.LIBRARY is not None
        start = [*state, *(effect_states[name] for name in self._names)]
        self._moved[:] = 0.0
        self._given[:] = np.array([*start, *applied, *(context[name] for name in self._context)])[:, None]
        compiled.LIBRARY.dynssm_repeat(self._structure.address, self._substeps)
        now = add(start, self._moved[:, 0].tolist())
        return State(*now[:3]), dict(zip(self._names, now[3:], strict=True))
