"""Simulations of a fit by the compiled loop: the equations of its cars as tapes."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from dynssm_ros import compiled
from dynssm_ros.arrays import Indices, Vector
from dynssm_ros.identification.problem.car import CarBatch
from dynssm_ros.vehicle import Applied, CarModel, Coefficients, State
from dynssm_ros.vehicle.compiled_car import tape_structure
from dynssm_ros.vehicle.tape import Tape, trace


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
    equations = _equations(bind(fleet), fleet, context, tuple(by_row))
    if equations is None:
        return False
    cars, windows = out.shape[:2]
    beside = list(by_row.values())
    own = [np.broadcast_to(np.asarray(each, dtype=np.float64), (cars, windows)) for each in _fitted(fleet)]
    structure = compiled.SimulationStructure()
    structure.fill(
        step=tape_structure(equations.step), signals=5 + len(beside), states=equations.states, parameters=len(own),
        next=np.empty((3 + equations.states, compiled.LANES)),
        signal_places=_places([*rows[:3], *applied, *beside], 1), settling=_places([*rows[:5], *beside], 1),
        parameter_places=_places(own, 2), cars=cars, windows=windows, starts=np.ascontiguousarray(starts, np.int64),
        begin=begin, steps=out.shape[2] * every, every=every, taken=taken,
    )  # fmt: skip
    if equations.settle is not None:
        structure.fill(settle=tape_structure(equations.settle))
    compiled.LIBRARY.dynssm_simulate(structure.address, compiled.address(out), out.strides[0] // out.itemsize)
    return True


class _Equations(NamedTuple):
    """Of cars that differ in values alone: how they step, and where their effect states settle, if there are any."""

    step: Tape
    settle: Tape | None
    states: int


_KNOWN: dict[tuple[Hashable, ...], _Equations | None] = {}
_KEPT = 256  # equations that are at hand


def _equations(
    car: CarModel, fleet: CarBatch, context: Mapping[str, Any], by_row: tuple[str, ...]
) -> _Equations | None:
    """The equations, whose symbols are state, inputs, the signals ``by_row``, effect states and the values of a fit; ``None``
    if they cannot be traced. They are traced once for all that have the same symbols and the same numbers beside them.
    """
    numbers = [None if _is_fitted(value, neutral) else value for value, neutral in _values(fleet)]
    constants = [value for name, value in vars(fleet.constants).items() if name != "m"]
    alone = [(name, value) for name, value in context.items() if name not in by_row]
    key = (
        car.T_s, car.integrator, car.substeps, car.set_point, *map(type, fleet.effects), *numbers, *constants, *alone, by_row
    )  # fmt: skip
    if key not in _KNOWN:
        if len(_KNOWN) > _KEPT:
            _KNOWN.clear()
        _KNOWN[key] = _traced(car, fleet, context, by_row)
    return _KNOWN[key]


def _traced(car: CarModel, fleet: CarBatch, context: Mapping[str, Any], by_row: tuple[str, ...]) -> _Equations | None:
    read, states, count = 5 + len(by_row), car.effect_states, len(_fitted(fleet))

    def model(xp: Any, q: Sequence[Any]) -> tuple[CarModel, Coefficients, dict[str, Any]]:
        cars = _with_values(fleet, iter(q[len(q) - count :]))
        there = replace(car, constants=cars.constants, effects=cars.effects, xp=xp)
        return there, cars.theta, {**context, **dict(zip(by_row, q[5:read], strict=True))}

    def settle(xp: Any, *q: Any) -> list[Any]:
        there, theta, here = model(xp, q)
        settled = there.settled(State(*q[:3]), Applied(*q[3:5]), theta, context=here)
        return [settled[name] for name in states]

    def step(xp: Any, *q: Any) -> list[Any]:
        there, theta, here = model(xp, q)
        carried = dict(zip(states, q[read : read + len(states)], strict=True))
        state, carried = there.step(State(*q[:3]), Applied(*q[3:5]), theta, carried, context=here)
        return [*state, *(carried[name] for name in states)]

    try:
        settled = trace(settle, read + count) if states else None
        return _Equations(trace(step, read + len(states) + count), settled, len(states))
    except (TypeError, AttributeError):
        return None


def _values(fleet: CarBatch) -> Iterator[tuple[Any, float | None]]:
    """Coefficients, mass and the parameters of the effects, each with where it is neutral, which changes the equations."""
    yield from ((value, None) for value in fleet.theta)
    yield fleet.constants.m, None
    for effect in fleet.effects:
        yield from ((value, effect.PARAMETERS[name].neutral) for name, value in effect.parameters.items())


def _is_fitted(value: Any, neutral: float | None) -> bool:
    """Whether a value is a symbol of the equations: not where it makes an effect, or a part of it, absent."""
    return isinstance(value, np.ndarray) or value != neutral


def _fitted(fleet: CarBatch) -> list[Any]:
    """The values of the symbols."""
    return [value for value, neutral in _values(fleet) if _is_fitted(value, neutral)]


def _with_values(fleet: CarBatch, symbols: Iterator[Any]) -> CarBatch:
    """The fleet with symbols in the place of values, in the order of :func:`_values`."""

    def symbol(value: Any, neutral: float | None = None) -> Any:
        return next(symbols) if _is_fitted(value, neutral) else value

    theta = Coefficients(*map(symbol, fleet.theta))
    constants = SimpleNamespace(**{**dict(vars(fleet.constants)), "m": symbol(fleet.constants.m)})
    effects = tuple(
        replace(effect, **{n: symbol(now, effect.PARAMETERS[n].neutral) for n, now in effect.parameters.items()})
        for effect in fleet.effects
    )
    return fleet._replace(theta=theta, constants=constants, effects=effects)


def _places(arrays: Sequence[Vector], axes: int) -> npt.NDArray[np.int64]:
    """Where each array's first number lies and how many numbers are between those along each axis, ``(n, 1 + axes)``."""
    places = [[compiled.address(each), *(stride // each.itemsize for stride in each.strides)] for each in arrays]
    return np.array(places, dtype=np.int64).reshape(-1, 1 + axes)
