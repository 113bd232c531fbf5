"""What a diagnosed car leaves: the anatomy of the one-step errors of the recalibrated car with its named causes."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.evaluation.residuals.ahead import patterns_ahead
from dynssm_ros.evaluation.residuals.anatomy import ModelAnatomy, model_anatomy
from dynssm_ros.evaluation.residuals.errors import BLOCK_S, OneStepErrors, PhysicsResponse, central_differences
from dynssm_ros.evaluation.residuals.evidence import FEWEST_BLOCKS
from dynssm_ros.evaluation.residuals.patterns import Pattern
from dynssm_ros.evaluation.residuals.regimes import situations
from dynssm_ros.extras import missing_libraries
from dynssm_ros.identification.problem.car import CarEstimate
from dynssm_ros.identification.problem.recordings import RecordingSet
from dynssm_ros.identification.problem.windows import SimulationWindows
from dynssm_ros.identification.result.diagnosis import EXTENDED, RECALIBRATED, Diagnosis, PatternAhead
from dynssm_ros.signals.recording import Recording
from dynssm_ros.signals.signal_map import STATE_SIGNALS


@dataclass(frozen=True)
class ExaminedDiagnosis(Diagnosis):
    """A diagnosis with what its car with the named causes leaves.

    Attributes:
        anatomy: of the errors of single steps; ``None`` if the fitted rows are less than 24 s.
        ahead: patterns of the errors at the horizon; :attr:`structure` has their words.
    """

    anatomy: ModelAnatomy | None = None
    ahead: tuple[Pattern, ...] = ()

    @classmethod
    def of(cls, diagnosis: Diagnosis) -> ExaminedDiagnosis:
        """The diagnosis with :func:`left_by` it and :func:`left_ahead`."""
        ahead = left_ahead(diagnosis)
        found = replace(diagnosis, structure=tuple(PatternAhead(one.channel, one.words, one.share) for one in ahead))
        known = {each.name: getattr(found, each.name) for each in fields(Diagnosis)}
        return cls(**known, anatomy=left_by(diagnosis), ahead=ahead)

    @property
    def patterns(self) -> tuple[Pattern, ...]:
        """That the errors have, the largest share first."""
        return () if self.anatomy is None else self.anatomy.patterns

    def to_json(self, vehicle_path: str) -> dict[str, Any]:
        """As :meth:`Diagnosis.to_json`, with the patterns."""
        return super().to_json(vehicle_path) | {"patterns": [pattern.to_json() for pattern in self.patterns]}


def left_by(diagnosis: Diagnosis) -> ModelAnatomy | None:
    """Takes the errors of the car with the named causes apart: single steps from each fitted row, as the data ask for them.

    Boosted trees are asked where scikit-learn is installed.

    Returns:
        ``None`` if the fitted rows are less than 24 s.
    """
    windows = diagnosis.windows
    rows = np.unique(windows.passed)
    if len(rows) * windows.data.T_s < FEWEST_BLOCKS * BLOCK_S:
        return None
    single = windows.single_steps(rows)
    log = _one_after_the_other(diagnosis.recordings)
    errors = OneStepErrors(
        RECALIBRATED if diagnosis.nearest_effects else EXTENDED,
        log,
        rows,
        single.errors(diagnosis.named)[:, 0],
        diagnosis.recordings.lines[0] if windows.data.on_one_lap else None,
        diagnosis.vehicle.constants.wheelbase,
    )
    response = PhysicsResponse(_derivatives(single, diagnosis.named))
    return model_anatomy(errors, situations(errors), response, learn=not missing_libraries("residuals"))


def left_ahead(diagnosis: Diagnosis) -> tuple[Pattern, ...]:
    """Patterns of the errors of the car with the named causes at the horizon; none if the fitted rows are less than 24 s."""
    windows = diagnosis.windows
    if len(np.unique(windows.passed)) * windows.data.T_s < FEWEST_BLOCKS * BLOCK_S:
        return ()
    line = diagnosis.recordings.lines[0] if windows.data.on_one_lap else None
    return patterns_ahead(windows, diagnosis.named, _one_after_the_other(diagnosis.recordings), line)


def _derivatives(single: SimulationWindows, car: CarEstimate) -> Vector:
    """How the next state depends on each of :data:`DRIVEN_SIGNALS`, an input's change being an old one, ``(N, 3, 5)``."""
    rows = single.data.rows

    def moved(k: int, change: float) -> Vector:
        there = rows.copy()
        there[k] += change
        return replace(single, data=replace(single.data, rows=there)).errors(car)[:, 0]

    out = central_differences(moved, rows.std(axis=1))
    for k in range(len(STATE_SIGNALS)):
        out[:, k, k] += 1.0  # the measured state moved too
    return out


def _one_after_the_other(recordings: RecordingSet) -> Recording:
    """The recordings with stamps that rise, moved by whole seconds so that the phase of the second stays."""
    log, second = recordings.recording, 1_000_000_000
    time = log.time.copy()
    for first in np.flatnonzero(np.diff(recordings.number)) + 1:
        gap = int(time[first] - time[first - 1])
        if gap <= 0:
            time[recordings.number == recordings.number[first]] += (round(BLOCK_S) - gap // second) * second
    return replace(log, time=time)
