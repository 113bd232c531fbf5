"""Wrong signs, units and wheelbases, found by comparing seconds of driving with the single-track model.

The car of the model is stepped ahead from measured rows under the measured inputs, as they are and with one signal changed
the way that wiring goes wrong. If a change makes the predicted lateral velocity and yaw rate much better, and other tyres do
not, it is named. Nothing is corrected: somebody has to look. A wheelbase that is off by less than a third is not found.

Each row that is added does a small part of a comparison, so that no prediction waits for long.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Generator, Iterator

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.signals.inputs import WINDOW_COLUMNS, applied_inputs
from dynssm_ros.vehicle import COEFFICIENTS, CarModel, Coefficients, State, Vehicle

_SECONDS = 6.0  # that are compared
_FEWEST = 60  # rows, before anything is said
_STARTS = 40  # rows that are stepped from
_AHEAD_S = 0.1
_CLEARLY = 0.25  # of the mean square error as it is, below which a change is named
_TURNING = 0.05  # share of the yaw rate of the tightest corner, below which nothing can be said
_CONFIRMED = 3  # times that something is found before it is said
_EVERY_S = 1.0  # between the beginnings of comparisons
_AT_ONCE = 11  # suspicions that are stepped at once: half a millisecond, one takes 0.3 and all 0.8 ms
_WHEELBASES = (0.5, 0.7, 1.4, 2.0)
_TYRES: tuple[dict[str, float], ...] = tuple(
    {"D_f": front * both, "D_r": both / front} for front in (0.8, 1.0, 1.25) for both in (0.75, 1.0, 1.33)
)
"""Factors of other tyres, which no wiring is to be named for: of the whole car, and of one axle against the other."""

_V_X, _V_Y, _OMEGA, _DELTA, _DELTA_CMD = (
    WINDOW_COLUMNS.index(name) for name in ("v_x", "v_y", "omega", "delta_fb", "delta_cmd")
)


def _scaled(columns: tuple[int, ...], factor: float) -> Vector:
    """Factors of all columns, shape ``(7,)``: those of some, one for the others."""
    factors = np.ones(len(WINDOW_COLUMNS))
    factors[list(columns)] = factor
    return factors


_CHANGES: dict[str, Vector] = {
    "the steering's sign is swapped": _scaled((_DELTA, _DELTA_CMD), -1.0),
    "the yaw rate's sign is swapped": _scaled((_OMEGA,), -1.0),
    "the lateral velocity's sign is swapped": _scaled((_V_Y,), -1.0),
    "left and right are swapped in lateral velocity and yaw rate": _scaled((_V_Y, _OMEGA), -1.0),
    "the steering is in degrees": _scaled((_DELTA, _DELTA_CMD), np.pi / 180),
    "the steering is that of the steering wheel, or its unit is wrong": _scaled((_DELTA, _DELTA_CMD), 1 / 15),
    "the yaw rate is in degrees per second": _scaled((_OMEGA,), np.pi / 180),
    "the speed is in km/h": _scaled((_V_X, _V_Y), 1 / 3.6),
    "the speed is in mph": _scaled((_V_X, _V_Y), 0.44704),
}


class Wiring:
    """Keeps the last seconds of driving and says what their signals look like.

    Args:
        vehicle: the car that they should be of.
        T_s: time between rows (s).
    """

    def __init__(self, vehicle: Vehicle, T_s: float) -> None:
        self._vehicle = vehicle
        self._T_s = T_s
        self._ahead = max(1, round(_AHEAD_S / T_s))
        self._rows: deque[Vector] = deque(maxlen=max(_FEWEST, round(_SECONDS / T_s)))
        self._last: int | None = None
        self._begun = -math.inf  # ns
        self._comparing: Iterator[str | None] | None = None
        self._found: deque[str] = deque(maxlen=_CONFIRMED)
        constants, unchanged = vehicle.constants, _scaled((), 1.0)
        self._wheelbase = wheelbase = constants.wheelbase
        suspicions = [
            *[("", unchanged, 1.0)] * len(_TYRES),
            *((words, factors, 1.0) for words, factors in _CHANGES.items()),
        ]
        for factor in _WHEELBASES:
            words = f"the wheelbase is not {wheelbase:.3g} m, but about {factor * wheelbase:.2g} m"
            suspicions.append((words, unchanged, factor))
        self._suspicions = [words for words, _, _ in suspicions]
        self._factors = np.stack([factors for _, factors, _ in suspicions])[:, None]
        theta = np.tile(vehicle.nominal, (len(suspicions), 1))
        for values, tyres in zip(theta, _TYRES, strict=False):
            for name, factor in tyres.items():
                values[COEFFICIENTS.index(name)] *= factor
        self._parts = []
        for first in range(0, len(suspicions), _AT_ONCE):
            part = slice(first, first + _AT_ONCE)
            longer = np.array([factor for _, _, factor in suspicions[part]])[:, None]
            suspected = constants.model_copy(update={"l_f": constants.l_f * longer, "l_r": constants.l_r * longer})
            car = CarModel(suspected, T_s, (), "rk4", 2, set_point=vehicle.inputs.set_point)
            self._parts.append((part, car, Coefficients(*theta[part].T[:, :, None])))

    def add(self, stamp: int, row: Vector) -> None:
        """Takes the newest row of a window, with the columns ``WINDOW_COLUMNS`` ``(7,)``; ``stamp`` in ns."""
        period = self._T_s * 1e9
        if self._last is not None:
            elapsed = stamp - self._last
            if 0 <= elapsed < 0.99 * period:
                return
            if not 0 <= elapsed < 1.5 * period:
                self._rows.clear()
                self._comparing, self._begun = None, min(self._begun, stamp)
        self._last = stamp
        self._rows.append(row.copy())
        if self._comparing is None and stamp - self._begun >= _EVERY_S * 1e9:
            self._begun, self._comparing = stamp, self._compare()
        if self._comparing is not None and (found := next(self._comparing)) is not None:
            self._comparing = None
            self._found.append(found)

    def verdict(self) -> str:
        """What is wired wrongly, in words, once it was found three times in a row.

        Empty if nothing stands out, or too little was driven in corners.
        """
        said = self._found[-1] if self._found else ""
        return said if self._found.count(said) == _CONFIRMED else ""

    def _compare(self) -> Iterator[str | None]:
        """Compares the rows, part after part; the last part is what was found, in words or empty."""
        if len(self._rows) < max(_FEWEST, self._ahead + 2):
            yield ""
            return
        rows = np.array(self._rows)
        steering = max(map(abs, self._vehicle.inputs.steering))
        fast = np.abs(rows[:, _V_X]).min() >= self._vehicle.minimum_speed
        with np.errstate(all="ignore"):
            cornering = np.sqrt(np.mean((np.abs(rows[:, _V_X]) * np.tan(steering) / self._wheelbase) ** 2))
            turns = np.std(rows[:, _OMEGA]) + np.std(rows[:, _DELTA]) > _TURNING * min(cornering, steering)
        if not (fast and turns):
            yield ""
            return
        errors = np.full(len(self._suspicions), np.inf)
        for part, car, theta in self._parts:
            errors[part] = yield from self._errors(rows, self._factors[part], car, theta)
        best, innocent = int(np.argmin(errors)), errors[: len(_TYRES)].min()
        yield self._suspicions[best] if errors[best] < _CLEARLY * innocent else ""

    def _errors(
        self, rows: Vector, factors: Vector, car: CarModel, theta: Coefficients
    ) -> Generator[None, None, Vector]:
        """Mean square of the predicted changes' errors in yaw rate and lateral velocity, over those measured.

        Args:
            rows: what was measured, shape ``(N, 7)``.
            factors: of the columns, under each of ``C`` suspicions, ``(C, 1, 7)``.
            car: under each.
            theta: likewise.

        Yields:
            Nothing, after each step.

        Returns:
            Errors ``(C,)``; infinite where the car diverges.
        """
        starts = np.linspace(0, len(rows) - 1 - self._ahead, _STARTS).astype(np.intp)
        spread = np.mean(rows[:, 1:3] ** 2, axis=0) * factors[:, 0, 1:3] ** 2 + 1e-12
        state = first = rows[starts, :3] * factors[..., :3]
        for k in range(self._ahead):
            with np.errstate(all="ignore"):
                inputs = rows[starts + k, 3:] * factors[..., 3:]
                now = np.moveaxis(np.concatenate([state, inputs], axis=-1), -1, 0)
                state = np.stack(car.step(State(*now[:3]), applied_inputs(now), theta)[0], axis=-1)
            yield
        with np.errstate(all="ignore"):
            off = state - first - (rows[starts + self._ahead, :3] - rows[starts, :3]) * factors[..., :3]
            error = np.sum(np.mean(off[:, :, 1:] ** 2, axis=1) / spread, axis=1)
        return np.where(np.isfinite(error), error, np.inf)
