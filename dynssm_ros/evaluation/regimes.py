"""Driving regimes: how the errors differ between slow and fast, straight and cornering, braking and accelerating.

Also where the driving is liveliest, for what shows a few seconds of it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from dynssm_ros.arrays import Indices, Vector
from dynssm_ros.evaluation.metrics import rmse
from dynssm_ros.signals.inputs import applied_inputs
from dynssm_ros.vehicle.single_track import SetPoint

COASTING_SPEED = 0.05  # speed error (m/s) that neither drives nor brakes to speak of: resistances take about as much
COASTING = 0.02  # applied throttle (fraction) that neither drives nor brakes to speak of
QUANTITIES = {"speed": "speed", "lateral_acceleration": "lateral acceleration", "throttle": "throttle"}
"""Quantities that define the regimes, with their titles."""


@dataclass(frozen=True)
class Regime:
    """Rows that were driven alike: the range, or a word, of one of :data:`QUANTITIES`, and which of the scored rows."""

    quantity: str
    label: str
    unit: str
    member: npt.NDArray[np.bool_] = field(repr=False)

    @property
    def name(self) -> str:
        """Label and unit."""
        return f"{self.label} {self.unit}".strip()

    @property
    def short(self) -> str:
        """The label where there is little room."""
        return self.label.replace(" to ", "–")

    @property
    def rows(self) -> int:
        """How many rows belong to it."""
        return int(self.member.sum())


def driving_regimes(rows: Vector, set_point: SetPoint = "throttle") -> tuple[Regime, ...]:
    """The regimes that occur in ``rows``.

    Speed ``v_x`` and lateral acceleration ``|v_x omega|`` are divided at round numbers over their range; the applied
    throttle tells braking, coasting (within 2 % of zero) and accelerating; of a speed set-point its distance from ``v_x``
    does (within 5 cm/s). Each of the model's input rows ``(N, 7)`` belongs
    to one regime of every quantity; those of a quantity ascend.
    """
    v_x, omega = rows[:, 0], rows[:, 2]
    driving, coasting = np.asarray(applied_inputs(rows.T).r), COASTING
    if set_point == "speed":
        driving, coasting = driving - v_x, COASTING_SPEED
    kinds = np.digitize(driving, [-coasting, np.nextafter(coasting, 1.0)])
    return (
        *_bins("speed", v_x, "m/s"),
        *_bins("lateral_acceleration", np.abs(v_x * omega), "m/s²"),
        *_members("throttle", ("braking", "coasting", "accelerating"), "", kinds),
    )


def regime_rmse(regimes: tuple[Regime, ...], errors: Vector) -> Vector:
    """One-step RMSE in each of ``R`` regimes, shape ``(R, 3)`` (m/s, m/s, rad/s), by errors ``(N, 3)``."""
    return np.stack([rmse(errors[regime.member]) for regime in regimes])


def _bins(quantity: str, values: Vector, unit: str) -> Iterator[Regime]:
    edges = round_edges(float(values.min()), float(values.max()), 4)
    labels = tuple(f"{low:g} to {high:g}" for low, high in pairwise(edges))
    yield from _members(quantity, labels, unit, np.digitize(values, edges[1:-1]))


def round_edges(low: float, high: float, most: int) -> Vector:
    """Edges of bins that cover ``low`` to ``high``: their width is 1, 2, 2.5 or 5 times a power of ten.

    The outer edges are multiples of the width too, so that there may be one bin more.
    """
    span = max(high - low, 1e-12 * max(abs(low), abs(high), 1e-300))
    widths = 10.0 ** np.floor(np.log10(span / most)) * np.array([1.0, 2.0, 2.5, 5.0, 10.0, 20.0])
    width = widths[np.argmax(widths * most >= span * (1 - 1e-9))]
    first, last = np.floor(low / width + 1e-9), np.ceil(high / width - 1e-9)
    return np.asarray(width * np.arange(first, max(last, first + 1) + 1))


def _members(quantity: str, labels: tuple[str, ...], unit: str, index: npt.NDArray[np.intp]) -> Iterator[Regime]:
    for k, label in enumerate(labels):
        if (index == k).any():
            yield Regime(quantity, label, unit, index == k)


def liveliest(time: Vector, states: Vector, seconds: float) -> Indices:
    """Rows of the stretch of ``seconds`` without a gap in which the states ``(N, 3)`` change most.

    All of the longest gap-free run if no run is that long. ``time`` is of each row (s), increasing.
    """
    step = float(np.median(np.diff(time))) if len(time) > 1 else 1.0
    length = max(2, round(seconds / step))
    runs = np.split(np.arange(len(time)), np.flatnonzero(np.diff(time) > 1.5 * step) + 1)
    long = [run for run in runs if len(run) >= length]
    if not long:
        return max(runs, key=len)
    spread = np.std(states, axis=0)
    change = np.abs(np.diff(states, axis=0, prepend=states[:1])) / np.where(spread > 0, spread, 1.0)
    sums = np.concatenate([[0.0], np.cumsum(change.sum(axis=1))])
    firsts = np.concatenate([run[: len(run) - length + 1] for run in long])
    first = int(firsts[np.argmax(sums[firsts + length] - sums[firsts])])
    return np.arange(first, first + length)
