"""A car's steps over windows by the compiled loop: its equations as tapes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from dynssm_ros import compiled
from dynssm_ros.arrays import Vector
from dynssm_ros.vehicle.car import CarModel
from dynssm_ros.vehicle.effects.base import initial_effect_states
from dynssm_ros.vehicle.single_track import Applied, Coefficients, State
from dynssm_ros.vehicle.tape import Tape, trace


def tape_structure(tape: Tape) -> compiled.TapeStructure:
    """A tape as the library takes it, with room to work in."""
    work = np.zeros((tape.slots, compiled.LANES))
    work[tape.inputs : tape.inputs + len(tape.constants)] = tape.constants[:, None]
    structure = compiled.TapeStructure()
    structure.fill(code=tape.code, operations=len(tape.code), work=work, outputs=tape.outputs, count=len(tape.outputs))
    return structure


def car_structure(car: CarModel, theta: Vector, rows: int) -> compiled.CarStructure | None:
    """The steps of a car with the coefficients ``theta`` ``(17,)`` from windows of ``rows`` rows.

    ``None`` if its equations cannot be traced: an effect branches on a value, or computes with what a tape does not have.
    """
    coefficients, names = Coefficients(*theta.tolist()), car.effect_states

    def step(xp: Any, *q: Any) -> Sequence[Any]:
        moved, _ = car.under(xp).increment(
            State(*q[:3]), Applied(*q[3:5]), coefficients, dict(zip(names, q[5:], strict=True))
        )
        return moved

    def settle(xp: Any, *q: Any) -> Sequence[Any]:
        known = initial_effect_states(car.effects, *q[5:7])
        now = car.under(xp).settled(State(*q[:3]), Applied(*q[3:5]), coefficients, known)
        return [now[name] for name in names]

    def carry(xp: Any, *q: Any) -> Sequence[Any]:
        now = car.under(xp).carried_on(
            State(*q[:3]), Applied(*q[3:5]), coefficients, dict(zip(names, q[5:], strict=True))
        )
        return [now[name] for name in names]

    structure = compiled.CarStructure()
    try:
        structure.fill(step=tape_structure(trace(step, 5 + len(names))))
        if names:
            structure.fill(settle=tape_structure(trace(settle, 7)), carry=tape_structure(trace(carry, 5 + len(names))))
    except (TypeError, AttributeError):
        return None
    structure.fill(states=len(names), along=np.zeros((rows, max(len(names), 1), compiled.LANES)))
    return structure
