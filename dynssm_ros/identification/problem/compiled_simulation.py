"""Simulations of a fit by the compiled loop: the equations of its cars as tapes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt

from dynssm_ros import compiled
from dynssm_ros.arrays import Indices, Vector
from dynssm_ros.identification.problem.car import CarBatch
from dynssm_ros.vehicle import Applied, CarModel, Coefficients, State
from dynssm_ros.vehicle.compiled_car import tape_structure
from dynssm_ros.vehicle.tape import trace


def simulate(
    bind: Callable[[CarBatch], CarModel],
    fleet: CarBatch,
    rows: Vector,
    applied: Vector,
    context: Mapping[str, Vector | float],
    *,
    out: Vector,
    starts: Indices,
    begin: int,
    every: int,
    taken: float,
) -> bool:
    """Simulates cars from each start; whether it could.

    It cannot where the library was not built, or an effect branches on a value or computes with what a tape does not have.

    Args:
        bind: makes the model of some cars.
        fleet: the cars.
        rows: model inputs, shape ``(7, N)``.
        applied: throttle and steering that act from each row on, shape ``(2, N)``.
        context: what effects of the cars read beside them: by row ``(N,)``, or one value for all rows.
        out: what is written, states of the rows that are kept, ``(P, W, K, 3)``; contiguous but for the first axis.
        starts: rows, shape ``(W,)``.
        begin: row from the starts at which a simulation begins; not positive.
        every: each so many-th row after the start is kept.
        taken: share of the measured row that the state takes until the start.
    """
    if compiled.LIBRARY is None:
        return False
    by_row = {name: values for name, values in context.items() if isinstance(values, np.ndarray)}
    structure = _traced(bind, fleet, context, tuple(by_row))
    if structure is None:
        return False
    cars, windows = out.shape[:2]
    beside = list(by_row.values())
    own = [np.broadcast_to(each, (cars, windows)) for each in _varied(fleet)]
    structure.fill(
        signal_places=_places([*rows[:3], *applied, *beside], 1), settling=_places([*rows[:5], *beside], 1),
        parameter_places=_places(own, 2), cars=cars, windows=windows, starts=np.ascontiguousarray(starts, np.int64),
        begin=begin, steps=out.shape[2] * every, every=every, taken=taken,
    )  # fmt: skip
    compiled.LIBRARY.dynssm_simulate(structure.address, compiled.address(out), out.strides[0] // out.itemsize)
    return True


def _traced(
    bind: Callable[[CarBatch], CarModel], fleet: CarBatch, context: Mapping[str, Any], by_row: tuple[str, ...]
) -> compiled.SimulationStructure | None:
    """The equations, whose symbols are state, inputs, the signals ``by_row``, effect states and what differs from car to car;
    ``None`` if they cannot be traced.
    """
    read, states, count = 5 + len(by_row), bind(fleet).effect_states, len(_varied(fleet))

    def model(xp: Any, q: Sequence[Any]) -> tuple[CarModel, Coefficients, dict[str, Any]]:
        symbols = iter(q[len(q) - count :])
        cars = _with_values(fleet, lambda value: next(symbols) if isinstance(value, np.ndarray) else value)
        return bind(cars).under(xp), cars.theta, {**context, **dict(zip(by_row, q[5:read], strict=True))}

    def settle(xp: Any, *q: Any) -> list[Any]:
        car, theta, here = model(xp, q)
        settled = car.settled(State(*q[:3]), Applied(*q[3:5]), theta, context=here)
        return [settled[name] for name in states]

    def step(xp: Any, *q: Any) -> list[Any]:
        car, theta, here = model(xp, q)
        carried = dict(zip(states, q[read : read + len(states)], strict=True))
        state, carried = car.step(State(*q[:3]), Applied(*q[3:5]), theta, carried, context=here)
        return [*state, *(carried[name] for name in states)]

    structure = compiled.SimulationStructure()
    structure.fill(signals=read, states=len(states), parameters=count, next=np.empty((3 + len(states), compiled.LANES)))
    try:
        structure.fill(step=tape_structure(trace(step, read + len(states) + count)))
        if states:
            structure.fill(settle=tape_structure(trace(settle, read + count)))
    except (TypeError, AttributeError):
        return None
    return structure


def _varied(fleet: CarBatch) -> list[Vector]:
    """The values that differ from car to car, or from window to window."""
    return [each for each in _values(fleet) if isinstance(each, np.ndarray)]


def _places(arrays: Sequence[Vector], axes: int) -> npt.NDArray[np.int64]:
    """Where each array's first number lies and how many numbers are between those along each axis, ``(n, 1 + axes)``."""
    places = [[compiled.address(each), *(stride // each.itemsize for stride in each.strides)] for each in arrays]
    return np.array(places, dtype=np.int64).reshape(-1, 1 + axes)


def _values(fleet: CarBatch) -> Iterator[Any]:
    """All values that may."""
    yield from fleet.theta
    yield fleet.constants.m
    for effect in fleet.effects:
        yield from effect.parameters.values()


def _with_values(fleet: CarBatch, value: Callable[[Any], Any]) -> CarBatch:
    """The fleet with other values, in the order of :func:`_values`."""
    theta = Coefficients(*map(value, fleet.theta))
    constants = SimpleNamespace(**{**dict(vars(fleet.constants)), "m": value(fleet.constants.m)})
    effects = tuple(
        replace(effect, **{name: value(now) for name, now in effect.parameters.items()}) for effect in fleet.effects
    )
    return fleet._replace(theta=theta, constants=constants, effects=effects)
