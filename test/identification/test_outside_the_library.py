"""What no effect of the library describes is called unexplained, with its place in time, and gets no wrong name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.hidden_causes.cases import Case, record
from dynssm_ros.arrays import Vector
from dynssm_ros.identification.diagnose import diagnose
from dynssm_ros.identification.diagnosis import Diagnosis
from dynssm_ros.reporting.diagnosis_report import as_text

Spoil = Callable[[dict[str, Vector], Vector], None]
CASE = Case({}, 9800, "rk4", 100.0)


def drifting_scale(columns: dict[str, Vector], t: Vector) -> None:
    """The gyroscope's scale factor grows by 15 % in 100 s."""
    columns["omega"] *= 1.0 + 0.0015 * t


def loose_sensor(columns: dict[str, Vector], t: Vector) -> None:
    """The velocity sensor swings for six seconds."""
    loose = (t > 40.0) & (t < 46.0)
    columns["v_y"][loose] += 0.12 * np.sin(2 * np.pi * 1.3 * t[loose])


@pytest.fixture(scope="module")
def spoiled() -> Callable[[Spoil], Diagnosis]:
    recording, vehicle = record(CASE)

    def diagnosed(spoil: Spoil) -> Diagnosis:
        columns = {name: values.copy() for name, values in recording.columns.items()}
        spoil(columns, (recording.time - recording.time[0]) / 1e9)
        return diagnose(replace(recording, columns=columns), vehicle, integrator="rk4", line=CASE.road.centre)

    return diagnosed


def test_grip_that_grows_does_not_stand_for_a_scale_that_drifts(spoiled: Callable[[Spoil], Diagnosis]) -> None:
    found = spoiled(drifting_scale)
    assert (found.verdict, found.causes) == ("unexplained", ())
    assert found.vehicle.effects == ()
    assert any("grip_drift would be on the side of neutral on which no car has it" in note for note in found.notes)


def test_a_sensor_that_was_loose_for_seconds_is_placed_in_time(spoiled: Callable[[Spoil], Diagnosis]) -> None:
    found = spoiled(loose_sensor)
    assert (found.verdict, found.causes) == ("unexplained", ())
    low, high = found.clustered.when
    assert 40.0 < low < high < 46.0
    assert "largest 42 to 45 s into" in as_text(found)
