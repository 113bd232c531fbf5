"""Integrators of the equations of motion: forward Euler, as in the paper, and the classic Runge-Kutta scheme."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal

from dynssm_ros.vehicle.single_track import Array

Integrator = Literal["euler", "rk4"]
Values = tuple[Array, ...]
Rates = Callable[[Sequence[Array]], Values]  # from quantities to their time derivatives


def integrate(rates: Rates, start: Values, T_s: float, integrator: Integrator, substeps: int) -> Values:
    """How much the quantities ``start`` change in ``T_s`` seconds, in ``substeps`` equal steps."""
    advance, h = _INTEGRATORS[integrator], T_s / substeps
    moved = advance(rates, start, h)
    for _ in range(substeps - 1):
        moved = add(moved, advance(rates, add(start, moved), h))
    return moved


def add(a: Sequence[Array], b: Sequence[Array]) -> Values:
    """The sums of each pair."""
    return tuple([x + y for x, y in zip(a, b, strict=True)])  # a list is quicker than a generator


def _euler(rates: Rates, y: Values, h: float) -> Values:
    return _times(h, rates(y))


def _rk4(rates: Rates, y: Values, h: float) -> Values:
    k1 = rates(y)
    k2 = rates(add(y, _times(h / 2, k1)))
    k3 = rates(add(y, _times(h / 2, k2)))
    k4 = rates(add(y, _times(h, k3)))
    return tuple([h * (a + 2 * b + 2 * c + d) / 6 for a, b, c, d in zip(k1, k2, k3, k4, strict=True)])


def _times(h: float, k: Sequence[Array]) -> Values:
    return tuple([h * x for x in k])


_INTEGRATORS = {"euler": _euler, "rk4": _rk4}
