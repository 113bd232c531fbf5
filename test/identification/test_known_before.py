"""What laps told once they do not tell a second time: calibrations and diagnoses begin from what was known before."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dynssm_ros.identification.result.calibration import calibrate
from dynssm_ros.identification.result.diagnose import diagnose
from dynssm_ros.signals.recording import Recording
from dynssm_ros.simulation.laps import as_recording, simulate
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import COEFFICIENTS, Vehicle, load_vehicle, save_vehicle
from dynssm_ros.vehicle.effects import EFFECTS

ORCA = load_vehicle("orca")
OTHERS = set(EFFECTS) - {"steering_offset", "drag"}  # untried
NOISE = (0.01, 0.01, 0.03)


def laps(seed: int, duration: float = 40.0) -> Recording:
    car = ORCA.with_effect("steering_offset", {"offset": 0.03})
    return as_recording(simulate(car, load_track("club"), duration, plant="euler", seed=seed, noise=NOISE))


@pytest.fixture(scope="module")
def recording() -> Recording:
    return laps(1)


@pytest.fixture(scope="module")
def calibrated(recording: Recording) -> Vehicle:
    return calibrate(recording, ORCA, horizon=0.3, integrator="euler", starts=1).vehicle


def test_a_calibration_notes_its_laps_and_what_was_known_before(recording: Recording, calibrated: Vehicle) -> None:
    assert calibrated.before is not None
    assert calibrated.before.laps == recording.fingerprints
    assert len(recording.fingerprints) >= 4
    before = calibrated.known_before(recording.fingerprints)
    np.testing.assert_array_equal(before.nominal, ORCA.nominal)
    assert [before.coefficients[name].std for name in COEFFICIENTS] == [
        ORCA.coefficients[name].std for name in COEFFICIENTS
    ]
    assert before.integrator == calibrated.integrator == "euler"


def test_the_same_laps_make_a_calibration_no_surer(recording: Recording, calibrated: Vehicle) -> None:
    again = calibrate(recording, calibrated, horizon=0.3, integrator="euler", starts=1)
    first = np.array([calibrated.coefficients[name].std for name in COEFFICIENTS], dtype=float)
    np.testing.assert_allclose(again.std, first, rtol=0.05)
    np.testing.assert_allclose(again.theta, calibrated.nominal, atol=0.1 * first.max(), rtol=0.05)
    other = calibrate(laps(2), calibrated, horizon=0.3, integrator="euler", starts=1)
    assert np.median(other.std / first) < 0.9, "other laps do tell something new"
    assert other.vehicle.before is not None
    assert set(other.vehicle.before.laps) > set(recording.fingerprints)


def test_parts_of_the_laps_are_known_again_and_others_are_not(recording: Recording, calibrated: Vehicle) -> None:
    first, last = recording.split_last(0.25)
    assert calibrated.known_before(first.fingerprints).before is None
    assert calibrated.known_before(last.fingerprints).before is None
    assert calibrated.known_before(laps(2).fingerprints) is calibrated
    moved = replace(recording, columns=recording.columns | {"v_x": recording["v_x"] + 1e-9})
    assert not set(moved.fingerprints) & set(recording.fingerprints)
    assert ORCA.known_before(recording.fingerprints) is ORCA


def test_where_nothing_was_known_the_bounds_are(recording: Recording, calibrated: Vehicle) -> None:
    found = calibrated.calibrated_on(recording.fingerprints, ORCA.unmeasured())
    before = found.known_before(recording.fingerprints)
    np.testing.assert_array_equal(before.nominal, ORCA.unmeasured().nominal)
    assert {c.std for c in before.coefficients.values()} == {None}
    assert before.correlation is None


@pytest.mark.slow
def test_what_took_up_a_cause_goes_back_where_the_cause_is_found() -> None:
    car, cause = load_vehicle("av21"), {"exponent": 0.6}
    I_z = car.coefficients["I_z"].nominal
    other = car.with_effect("load_sensitivity", cause)
    drive = simulate(other, load_track("road_course"), 60.0, plant="rk4", seed=3, noise=(0.02, 0.02, 0.003))
    recording = as_recording(drive)
    calibrated = calibrate(recording, car.unmeasured(), integrator="rk4", starts=2).vehicle
    assert calibrated.coefficients["I_z"].nominal > 1.2 * I_z, "without the cause another yaw inertia is the closest"
    found = diagnose(recording, calibrated, integrator="rk4")
    assert {one.effect: one.values for one in found.causes} == {"load_sensitivity": pytest.approx(cause, abs=0.02)}
    assert found.vehicle.coefficients["I_z"].nominal == pytest.approx(I_z, rel=0.05)


def test_a_vehicle_file_keeps_it(calibrated: Vehicle, tmp_path: Path) -> None:
    save_vehicle(calibrated, tmp_path / "car.yaml")
    assert load_vehicle(tmp_path / "car.yaml").before == calibrated.before


@pytest.mark.slow
def test_a_diagnosis_is_the_same_before_and_after_a_calibration(recording: Recording, calibrated: Vehicle) -> None:
    shipped, after = (
        diagnose(recording, car, horizon=0.3, integrator="euler", exclude=OTHERS) for car in (ORCA, calibrated)
    )
    assert [cause.effect for cause in shipped.causes] == ["steering_offset"]
    assert [(c.effect, c.values, c.std) for c in after.causes] == [(c.effect, c.values, c.std) for c in shipped.causes]
    assert any("was calibrated on these laps" in note for note in after.notes)
    assert not any("was calibrated on these laps" in note for note in shipped.notes)
    assert after.vehicle.before is not None
    np.testing.assert_array_equal(list(after.vehicle.before.nominal.values()), ORCA.nominal)
