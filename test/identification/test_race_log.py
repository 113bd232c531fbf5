"""The measured AV-21 log: calibrated as a team would, then diagnosed."""

from __future__ import annotations

from pathlib import Path

import pytest

from dynssm_ros.identification import tuning
from dynssm_ros.identification.result.calibration import calibrate
from dynssm_ros.identification.result.diagnose import diagnose
from dynssm_ros.identification.result.diagnosis import RECALIBRATED
from dynssm_ros.signals.extraction import extract
from dynssm_ros.signals.recording import Recording
from dynssm_ros.signals.signal_map import load_signal_map
from dynssm_ros.vehicle import load_vehicle

LATE_OR_ELSEWHERE = {"odometry_lever_arm", "odometry_delay", "yaw_rate_lag", "steering_lag"}


@pytest.fixture
def recording(putnam: Path) -> Recording:
    return extract([putnam], load_signal_map("av21"), 25.0)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_where_nothing_is_known_yaw_is_found_to_come_late(
    recording: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    # fewer simulations than those of a diagnosis proper tell the same, in less time
    monkeypatch.setattr(tuning, "MAX_WINDOWS", 200)
    seen = recording.split_last(0.25)[0]
    car = calibrate(seen, load_vehicle("av21").unmeasured(), integrator="rk4", starts=1).vehicle
    found = diagnose(recording, car, horizon=0.6, integrator="rk4")
    assert found.verdict == "cause"
    # a yaw rate that is measured late and a steering that answers late are hard to tell apart in this log
    assert found.causes[0].effect in LATE_OR_ELSEWHERE
    assert found.improvement.reduction_from(RECALIBRATED)[found.improvement.horizon, 2] >= 0.3


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_from_the_shipped_file_the_extended_car_errs_less_sideways(recording: Recording) -> None:
    found = diagnose(recording, load_vehicle("av21"), horizon=0.6, integrator="rk4")
    assert found.verdict == "cause"
    assert found.causes[0].effect in LATE_OR_ELSEWHERE
    at = found.improvement.horizon
    assert found.improvement.horizons[at] == pytest.approx(0.6)
    # how much of that a recalibration takes hangs on which of two cars, equally likely, is found
    assert found.improvement.reduction[at, 1] >= 0.3


@pytest.mark.slow
def test_a_race_car_is_not_taken_for_one_that_moves_in_euler_steps(putnam: Path) -> None:
    """Euler steps are closer to its one-step errors, and explain them no better than Runge-Kutta."""
    recording = extract([putnam], load_signal_map("av21"), 25.0)
    assert calibrate(recording, load_vehicle("av21"), starts=1).vehicle.integrator == "rk4"
