"""One-step errors of a model along a recording, and what was going on then."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from dynssm_ros.arrays import Indices, Vector
from dynssm_ros.evaluation.metrics import Tick, drive_through, predict_rows, silent
from dynssm_ros.runtime.baselines import SingleTrack
from dynssm_ros.runtime.contract import WindowModel
from dynssm_ros.signals.inputs import WINDOW_COLUMNS, applied_inputs
from dynssm_ros.signals.recording import Recording
from dynssm_ros.track.lines import Line
from dynssm_ros.vehicle.integrators import Integrator

BLOCK_S = 3.0
"""Length of the blocks of time that count as independent (s): actuators, filters and noise forget within one."""
DRIVEN_SIGNALS = WINDOW_COLUMNS[:5]
"""State and feedback, by which a prediction is driven."""
SMALL_CHANGE = 1e-3
"""Change of a signal, in its standard deviations, that gives its derivative."""
_AT_ONCE = 4096  # windows that exist at a time
_SUBSTEPS = 4  # of Runge-Kutta within a sampling time


@dataclass(frozen=True)
class OneStepErrors:
    """Errors of one model at rows of a recording.

    Attributes:
        model: its name.
        recording: that was driven.
        rows: last row of each window, ascending; ``rows + 1`` were predicted, shape ``(N,)``.
        values: predicted minus measured state, shape ``(N, 3)`` (m/s, m/s, rad/s).
        line: closed line along which the place on the lap is counted; ``None`` without one.
        wheelbase: of the car (m), by which wheels are known; ``None`` without a car.
    """

    model: str
    recording: Recording
    rows: Indices
    values: Vector
    line: Line | None = None
    wheelbase: float | None = None

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def T_s(self) -> float:
        """Sampling time (s)."""
        return self.recording.T_s

    @cached_property
    def driven(self) -> Vector:
        """The model's input rows from which each prediction starts, shape ``(N, 7)``."""
        return self.recording.rows(self.rows)

    @cached_property
    def inputs(self) -> dict[str, Vector]:
        """Throttle and steering that act at each row of the recording, by name, each of shape ``(M,)``."""
        rows = self.recording.rows(np.arange(len(self.recording)))
        return dict(zip(("throttle", "steering"), applied_inputs(rows.T), strict=True))

    @cached_property
    def applied(self) -> Vector:
        """Throttle and steering that act in each step, shape ``(N, 2)``."""
        return np.stack([column[self.rows] for column in self.inputs.values()], axis=1)

    @cached_property
    def seconds(self) -> Vector:
        """Stamp of each predicted row since the recording's first full second (s), shape ``(N,)``."""
        whole = self.recording.time[0] // 1_000_000_000 * 1_000_000_000
        return np.asarray((self.recording.time[self.rows + 1] - whole) / 1e9)

    @cached_property
    def number(self) -> Indices:
        """Which step of the clock each predicted row is, shape ``(N,)``."""
        return np.rint(self.seconds / self.T_s).astype(np.intp)

    @cached_property
    def block(self) -> Indices:
        """Number of the block of :data:`BLOCK_S` of each row, without gaps in the numbers, shape ``(N,)``."""
        raw = (self.seconds / BLOCK_S).astype(np.intp)
        return np.unique(raw, return_inverse=True)[1].astype(np.intp)

    @cached_property
    def run(self) -> Indices:
        """Number of the stretch of rows in a row, shape ``(N,)``."""
        return np.cumsum(np.diff(self.rows, prepend=self.rows[:1]) != 1).astype(np.intp)

    def before(self, values: Vector, rows: int) -> Vector:
        """``values`` ``(M, ...)`` of the recording so many rows before each window's last, held at the segment's first."""
        return np.asarray(values[np.clip(self.rows - rows, *self._segment_ends)])

    @cached_property
    def _segment_ends(self) -> tuple[Indices, Indices]:
        """First and last row of the segment of each window's last row, ``(N,)`` each."""
        segment = self.recording.segment
        first, after = (np.searchsorted(segment, segment[self.rows], side=side) for side in ("left", "right"))
        return first, after - 1


class PhysicsResponse(NamedTuple):
    """How the physics' predictions of rows would change.

    Attributes:
        slopes: of the predicted state, by each of :data:`DRIVEN_SIGNALS` of the last row, shape ``(N, 3, 5)``.
        integrators: by which they are stepped, and which other one is compared; empty without.
        otherwise: predictions by the other integrator less these, shape ``(N, 3)``.
    """

    slopes: Vector
    integrators: tuple[Integrator, ...] = ()
    otherwise: Vector | None = None

    @classmethod
    def of(cls, physics: WindowModel, recording: Recording, rows: Indices) -> PhysicsResponse:
        """Of a model's predictions after windows that end at ``rows``; of a vehicle file's also by the other integrator."""
        slopes = derivatives(physics, recording, rows)
        if physics.vehicle is None:
            return cls(slopes)
        own = physics.vehicle.model_integrator
        other: Integrator = "rk4" if own == "euler" else "euler"
        stepped = SingleTrack(physics.vehicle, other, _SUBSTEPS if other == "rk4" else 1)
        if stepped.H != physics.H:
            return cls(slopes)
        return cls(slopes, (own, other), _predicted(stepped, recording, rows) - _predicted(physics, recording, rows))


def _predicted(model: WindowModel, recording: Recording, rows: Indices) -> Vector:
    return np.concatenate([each.state for each in predict_rows(model, recording, rows)])


def one_step_errors(
    model: WindowModel,
    recording: Recording,
    rows: Indices,
    *,
    line: Line | None = None,
    wheelbase: float | None = None,
    tick: Tick = silent,
) -> OneStepErrors:
    """The errors of the predictions of ``rows + 1``; an online layer learns along the drive as it does live.

    Args:
        model: fits the recording.
        recording: with the commands in use.
        rows: last row of each window, ascending, as of :meth:`Recording.window_ends`.
        line: closed line along which the place on the lap is counted.
        wheelbase: of the car (m).
        tick: told of the predictions made.
    """
    parts = [
        prediction.state
        for drive, (ends,) in drive_through(model, recording, (rows,), paths=False)
        for prediction in predict_rows(model, recording, ends, tick=tick, drive=drive)
    ]
    predicted = np.concatenate([np.empty((0, 3)), *parts])
    return OneStepErrors(model.name, recording, rows, predicted - recording.states(rows + 1), line, wheelbase)


def derivatives(physics: WindowModel, recording: Recording, rows: Indices) -> Vector:
    """How the predicted state depends on each of :data:`DRIVEN_SIGNALS` of the last row, by differences, ``(N, 3, 5)``."""

    def moved(k: int, change: float) -> Vector:
        parts = []
        for start in range(0, len(rows), _AT_ONCE):
            windows = recording.windows(rows[start : start + _AT_ONCE], physics.H)
            windows[:, -1, k] += change
            parts.append(physics.predict(windows).state)
        return np.concatenate(parts)

    return central_differences(moved, recording.rows(rows).std(axis=0))


def central_differences(moved: Callable[[int, float], Vector], spread: Vector) -> Vector:
    """How predictions depend on each of :data:`DRIVEN_SIGNALS`, ``(N, 3, 5)``.

    Args:
        moved: the predictions ``(N, 3)`` if a signal, by its number, is larger by a change.
        spread: standard deviations of the signals, ``(5,)`` or more; 0 where one does not move.
    """
    steps = [SMALL_CHANGE * (float(each) or 1.0) for each in spread[: len(DRIVEN_SIGNALS)]]
    slopes = [(moved(k, step) - moved(k, -step)) / (2 * step) for k, step in enumerate(steps)]
    return np.stack(slopes, axis=-1)
