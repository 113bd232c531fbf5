"""The gear that a car was in: as a sensor tells it, or by engine speed over speed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from dynssm_ros.arrays import Indices, Vector

_FINE, _WIDTH = 0.01, 0.04
"""Bins of the ratio's logarithm, and how far off the middle of its gear a ratio is: slip and noise are below
4 %, neighbouring gears 15 % apart or more."""
_LEAST = 0.02  # of the rows, from which on a ratio is a gear
_SLOW = 0.2  # of the usual speed, below which a clutch slips
_BRIEF_ROWS = 3  # that a gear holds at least: less is a clutch that slips through its ratio


class GearChanges(NamedTuple):
    """Speeds (m/s) at which the car changed into a gear from below, and out of it to below."""

    up: Vector
    down: Vector


def gear_of(context: Mapping[str, Vector], v_x: Vector) -> Indices | None:
    """The gear at each row ``(N,)``, the lowest 1 where engine speed and ``v_x`` (m/s) tell it; ``None`` if nothing does.

    Rows between gears, as while one changes, are in the gear before.
    """
    if "gear" in context:
        return np.rint(context["gear"]).astype(np.intp)
    if "engine_speed" not in context:
        return None
    rolls = (v_x > _SLOW * float(np.median(np.abs(v_x)))) & (context["engine_speed"] > 0.0)
    if not rolls.any():
        return None
    ratio = np.log(np.where(rolls, context["engine_speed"], 1.0) / np.where(rolls, v_x, 1.0))
    middles = _middles(ratio[rolls])
    if not len(middles):
        return None
    nearest = np.argmin(np.abs(ratio[:, None] - middles), axis=1)
    known = rolls & (np.abs(ratio - middles[nearest]) < _WIDTH)
    gear = _lasting(np.where(known, nearest, -1))
    return np.asarray(gear + 1) if gear.max() >= 0 else None


def changes_into(gear: Indices, v_x: Vector, number: int) -> GearChanges:
    """The speeds at which gears ``(N,)`` rise to ``number`` or above, and fall below it."""
    above = (gear >= number).astype(np.int8)
    step = np.diff(above)
    return GearChanges(v_x[1:][step > 0], v_x[1:][step < 0])


def _middles(ratio: Vector) -> Vector:
    """The ratios that the drive keeps, ``(gears,)``, the largest first, as in the lowest gear."""
    edges = np.arange(ratio.min() - 2 * _FINE, ratio.max() + 2 * _FINE, _FINE)
    near = round(_WIDTH / _FINE)
    count = np.histogram(ratio, edges)[0].astype(np.float64)
    found: list[float] = []
    while len(found) < 12:
        around = np.convolve(count, np.ones(2 * near + 1), mode="same")
        top = int(np.argmax(around))
        if around[top] < _LEAST * len(ratio):
            break
        part = slice(max(0, top - near), top + near + 1)
        found.append(float(np.average(edges[:-1][part] + _FINE / 2, weights=count[part])))
        count[max(0, top - 2 * near) : top + 2 * near + 1] = 0.0
    return np.sort(np.array(found))[::-1]


def _lasting(gear: Indices) -> Indices:
    """With the gear before where none (-1) or a brief one is told; the first one before it."""
    edges = np.flatnonzero(np.diff(gear)) + 1
    for first, last in zip(np.append(0, edges), np.append(edges, len(gear)), strict=True):
        if last - first < _BRIEF_ROWS:
            gear[first:last] = -1
    at = np.maximum.accumulate(np.where(gear >= 0, np.arange(len(gear)), -1))
    lasting = np.where(at >= 0, gear[np.maximum(at, 0)], gear[np.argmax(gear >= 0)])
    return np.asarray(lasting)
