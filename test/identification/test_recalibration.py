"""Where the vehicle file is off, the coefficient is named with its size, and nothing is where the file is right."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.hidden_causes.cases import Case, drive, known
from dynssm_ros.arrays import Vector
from dynssm_ros.identification.problem.car import CarEstimate
from dynssm_ros.identification.problem.fit import IdentificationProblem
from dynssm_ros.identification.result.diagnose import diagnose
from dynssm_ros.identification.result.diagnosis import EXTENDED, GIVEN, Diagnosis
from dynssm_ros.identification.result.improvement import measure_improvement
from dynssm_ros.identification.result.recalibration import recalibration
from dynssm_ros.reporting.diagnosis_report import diagnosis_report
from dynssm_ros.reporting.diagnosis_words import as_text
from dynssm_ros.signals.recording import Recording
from dynssm_ros.vehicle import COEFFICIENTS, Vehicle
from dynssm_ros.vehicle.effects import EFFECTS

CASE = Case({}, 5, "euler", 70.0)
TRUE = known(CASE)
STD: Vector = np.where(np.abs(TRUE.nominal) > 0, 0.02 * np.abs(TRUE.nominal), 1e-4)
TRIED = {"rear_grip", "yaw_rate_bias"}


def file_with(**factors: float) -> Vehicle:
    """The vehicle file with coefficients off by factors, all of them stated to be known to 2 %."""
    wrong = TRUE.nominal * [factors.get(name, 1.0) for name in COEFFICIENTS]
    return TRUE.with_nominal(wrong, STD)


@pytest.fixture(scope="module")
def laps() -> Recording:
    return drive(CASE)


def diagnosed(laps: Recording, vehicle: Vehicle) -> Diagnosis:
    return diagnose(laps, vehicle, integrator="euler", line=CASE.road.centre, exclude=set(EFFECTS) - TRIED)


@pytest.fixture(scope="module")
def less_grip(laps: Recording) -> Diagnosis:
    """Of a file that has 5 % more rear grip than the car."""
    return diagnosed(laps, file_with(D_r=1.05))


@pytest.fixture(scope="module")
def right(laps: Recording) -> Diagnosis:
    """Of a file that is right."""
    return diagnosed(laps, file_with())


def assert_named_first(found: Diagnosis, name: str) -> None:
    assert (found.verdict, found.causes) == ("recalibrate", ())
    assert found.recalibration is not None
    first = found.recalibration.coefficients[0]
    true = TRUE.nominal[COEFFICIENTS.index(name)]
    assert first.name == name
    assert first.given == pytest.approx(1.05 * true)
    assert first.value == pytest.approx(true, abs=3 * first.std)
    assert first.deviations == pytest.approx(-2.5, abs=0.5)
    assert name in found.moved


@pytest.mark.parametrize("name", [pytest.param(name, marks=pytest.mark.slow) for name in ("D_f", "B_f", "C_m1", "I_z")])
def test_a_coefficient_that_is_off_by_five_per_cent_is_named_with_its_size(name: str, laps: Recording) -> None:
    assert_named_first(diagnosed(laps, file_with(**{name: 1.05})), name)


def test_less_rear_grip_than_the_file_has_is_named_with_what_it_takes_away(less_grip: Diagnosis) -> None:
    assert_named_first(less_grip, "D_r")
    found = less_grip.recalibration
    assert found is not None
    assert found.share[2] > 0.5
    assert found.coefficients[0].explains == pytest.approx(found.explains, abs=0.05)
    (hiding,) = [one for one in found.candidates if one.effect == "rear_grip"]
    assert hiding.values["factor"] == pytest.approx(1 / 1.05, abs=0.01)
    assert less_grip.minimum_detectable["rear_grip"] > 1 - hiding.values["factor"], "else it would be a cause"


def test_words_and_json_name_the_coefficient(less_grip: Diagnosis) -> None:
    words = as_text(less_grip)
    assert words.startswith("recalibrate: Coefficients of the vehicle file are off.")
    assert words.splitlines()[1].startswith("1. The file is off in D_r (5 % less than the file's ")
    assert "rear_grip (factor 0.95" in " ".join(words.split())
    (line,) = [each for each in diagnosis_report(less_grip).verdicts if each.name == "file"]
    assert (line.state, line.text[:25]) == ("look", "The file is off in D_r (5")
    content = json.loads(json.dumps(less_grip.to_json("vehicle.yaml"), allow_nan=False))
    assert content["verdict"] == "recalibrate"
    (shift,) = content["recalibration"]["coefficients"]
    assert {"name", "from", "to", "std", "standard_deviations", "reduction", "alternatives"} == set(shift)
    assert set(content["recalibration"]["candidates"][0]) == {"effect", "parameters", "minimum_detectable"}
    assert list(content["moved"]) == ["D_r"]
    assert [one["kind"] for one in content["conclusions"]] == ["recalibration"]


def test_coefficients_that_only_make_up_for_a_small_effect_are_not_off(right: Diagnosis) -> None:
    """A car whose drive is 5 % stronger by an effect, and as much weaker by its coefficients, is that of the file."""
    given, free = CarEstimate.of(file_with()), (("drive_gain", "factor"),)
    problem = IdentificationProblem(right.windows, given)
    fit = problem.fit(given.with_effect("drive_gain", {"factor": 1.0}), free)
    moved = given.moved.copy()
    moved[[COEFFICIENTS.index(name) for name in ("C_m1", "C_m2")]] = -np.log(1.05) / 0.02
    car = replace(given.with_effect("drive_gain", {"factor": 1.05}), moved=moved)
    fit = replace(fit, car=car, errors=problem.errors(car))
    improvement = measure_improvement(right.improvement.windows, {GIVEN: given, EXTENDED: car}, right.windows.steps)
    assert improvement.reduction == pytest.approx(0.0, abs=1e-6)
    beside = recalibration(problem, fit, given, improvement)
    assert beside is not None
    assert {one.name for one in beside.coefficients} <= {"C_m1", "C_m2"}
    assert recalibration(problem, fit, given, improvement, small=["drive_gain"]) is None


def test_a_right_file_is_healthy(right: Diagnosis) -> None:
    found = right
    assert (found.verdict, found.conclusions, found.recalibration, dict(found.moved)) == ("healthy", (), None, {})
    assert as_text(found).startswith("healthy: The simulation is right within the noise")
    assert [each.state for each in diagnosis_report(found).verdicts] == ["ok"]


def test_a_throttle_that_explains_nothing_is_said_first(laps: Recording) -> None:
    order = np.random.default_rng(0).permutation(len(laps) // 50)  # seconds of it change places
    shuffled = {name: values.copy() for name, values in laps.columns.items()}
    for name in ("r_fb", "r_cmd"):
        pieces = laps[name][: 50 * len(order)].reshape(len(order), 50)
        shuffled[name][: pieces.size] = pieces[order].ravel()
    found = diagnosed(replace(laps, columns=shuffled), file_with())
    assert found.verdict == "unexplained"
    assert found.no_better == ("v_x",)
    assert as_text(found).splitlines()[1].startswith("1. The throttle explains nothing of v_x: 0.5")
    assert diagnosis_report(found).verdicts[0].state == "wrong"
