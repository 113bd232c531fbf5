"""What no effect of the library describes is called unexplained, with its place in time, and gets no wrong name."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from benchmarks.hidden_causes.cases import Case, record
from dynssm_ros.arrays import Vector
from dynssm_ros.identification.result.diagnose import diagnose
from dynssm_ros.identification.result.diagnosis import Diagnosis
from dynssm_ros.reporting.diagnosis_report import diagnosis_report
from dynssm_ros.reporting.diagnosis_words import as_text
from dynssm_ros.simulation.laps import as_recording, simulate
from dynssm_ros.simulation.plant import Rk4Plant, register_plant
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import Vehicle, load_vehicle
from dynssm_ros.vehicle.single_track import Motion, StageEffect

Spoil = Callable[[dict[str, Vector], Vector], None]
CASE, QUICK = Case({}, 9800, "rk4", 100.0), Case({}, 9800, "euler", 100.0)


def drifting_scale(columns: dict[str, Vector], t: Vector) -> None:
    """The gyroscope's scale factor grows by 15 % in 100 s."""
    columns["omega"] *= 1.0 + 0.0015 * t


def loose_sensor(columns: dict[str, Vector], t: Vector) -> None:
    """The velocity sensor swings for six seconds."""
    loose = (t > 40.0) & (t < 46.0)
    columns["v_y"][loose] += 0.12 * np.sin(2 * np.pi * 1.3 * t[loose])


@pytest.fixture(scope="module")
def spoiled() -> Callable[..., Diagnosis]:
    def diagnosed(spoil: Spoil, case: Case = CASE) -> Diagnosis:
        recording, vehicle = record(case)
        columns = {name: values.copy() for name, values in recording.columns.items()}
        spoil(columns, (recording.time - recording.time[0]) / 1e9)
        return diagnose(replace(recording, columns=columns), vehicle, integrator=case.plant, line=case.road.centre)

    return diagnosed


@pytest.mark.slow
def test_grip_that_grows_does_not_stand_for_a_scale_that_drifts(spoiled: Callable[..., Diagnosis]) -> None:
    found = spoiled(drifting_scale)
    assert (found.verdict, found.causes) == ("unexplained", ())
    assert found.vehicle.effects == ()
    assert any("grip_drift would be on the side of neutral on which no car has it" in note for note in found.notes)


@pytest.mark.slow
def test_a_sensor_that_was_loose_for_seconds_is_placed_in_time(spoiled: Callable[..., Diagnosis]) -> None:
    found = spoiled(loose_sensor, QUICK)
    assert (found.verdict, found.causes) == ("unexplained", ())
    low, high = found.clustered.when
    assert 40.0 < low < high < 46.0
    assert "largest 42 to 45 s into" in as_text(found)


class Fin(StageEffect):
    """A fin turns the car's nose into the air: ``M_z = 4 v_x^2 v_y``."""

    def forces(self, xp: Any, q: Motion) -> None:
        q.M_z = q.M_z + 4.0 * q.v_x * q.v_x * q.v_y


class FinnedPlant(Rk4Plant):
    def first(self, vehicle: Vehicle) -> tuple[StageEffect, ...]:
        return (Fin(),)


@pytest.mark.slow
def test_a_term_that_no_effect_has_is_proposed_as_a_formula() -> None:
    register_plant("finned", FinnedPlant())
    car = load_vehicle("av21")
    laps = simulate(car, load_track("road_course"), 200.0, plant="finned", seed=5, noise=(0.02, 0.02, 0.003))
    found = diagnose(as_recording(laps), car)
    assert (found.verdict, found.causes) == ("unexplained", ())
    (yaw,) = (formula for formula in found.formulas if formula.channel == "omega")
    assert "v_x^2 v_y" in yaw.terms
    assert yaw.terms["v_x^2 v_y"] > 0
    assert yaw.share > 0.3
    assert (yaw.improvement > 0).all()
    assert "domega/dt may lack" in as_text(found)
    assert "v_x^2 v_y" in diagnosis_report(found).html()
    (told,) = (
        each for each in json.loads(json.dumps(found.to_json("car.yaml")))["formulas"] if each["channel"] == "omega"
    )
    assert told["terms"] == yaw.terms


@pytest.mark.slow
def test_where_the_library_for_formulas_is_missing_a_note_says_how_to_have_it(
    spoiled: Callable[..., Diagnosis], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "dynssm_ros.identification.result.diagnose.missing_libraries", lambda *extras: {"sklearn": "formula"}
    )
    found = spoiled(loose_sensor)
    assert found.formulas == ()
    assert any("pip install 'dynssm_ros[formula]'" in note for note in found.notes)
