"""What a car cannot have produced is refused, and named."""

from __future__ import annotations

import numpy as np
import pytest

from dynssm_ros.api import recorded, simulate
from dynssm_ros.runtime.plausibility import Plausibility, implausible_rows, ranges
from dynssm_ros.signals.history import Refusal
from dynssm_ros.vehicle import load_vehicle

T_S = 20_000_000
ORCA = load_vehicle("orca")


def sample(v_x: float = 2.0, v_y: float = 0.05, omega: float = 1.0) -> dict[str, float]:
    return {"v_x": v_x, "v_y": v_y, "omega": omega}


@pytest.fixture
def checks() -> Plausibility:
    """After one sample at 2 m/s."""
    checks = Plausibility(ORCA)
    assert checks.check(0, sample()) is None
    return checks


@pytest.mark.parametrize(
    "wrong",
    [
        {"v_x": 1e4},
        {"v_x": 7.2},  # km/h
        {"omega": 57.3},  # degrees per second
        {"steering_feedback": 8.0},  # degrees
        {"throttle_feedback": 40.0},  # per cent
    ],
)
def test_beyond_what_the_car_can_do_is_refused_however_often_it_comes(checks: Plausibility, wrong) -> None:
    for k in range(1, 50):
        assert checks.check(k * T_S, wrong) is Refusal.IMPLAUSIBLE
    (name, value) = next(iter(wrong.items()))
    assert checks.last.startswith(f"{name} = {value:.4g}; expected")


def test_a_jump_is_refused_once_and_believed_when_it_is_confirmed(checks: Plausibility) -> None:
    assert checks.check(T_S, sample(v_x=0.0)) is Refusal.JUMPED
    assert checks.last == "v_x = 0 after 2"
    assert checks.check(2 * T_S, sample(v_x=0.1)) is None  # it has hit a wall
    assert checks.check(3 * T_S, sample(v_x=0.1)) is None


def test_of_two_publishers_that_disagree_the_first_one_is_believed(checks: Plausibility) -> None:
    for k in range(1, 50):
        assert checks.check(k * T_S, sample()) is None
        assert checks.check(k * T_S + T_S // 2, sample(v_x=0.5)) is Refusal.JUMPED


def test_what_is_not_finite_or_not_known_is_left_to_others(checks: Plausibility) -> None:
    assert checks.check(T_S, sample(v_x=np.nan)) is None
    assert checks.check(T_S, {"x": 1e7, "anything": 1e9}) is None


def test_rows_of_a_recording_that_the_car_cannot_have_driven_are_named() -> None:
    drive = recorded(simulate("orca", "club", duration=4.0))
    assert list(implausible_rows(drive, ORCA)) == []
    drive["v_x"][[70, 90]] = 12.0, np.nan
    drive["delta_fb"][30] = -8.0  # degrees
    drive["r_cmd"][10] = 50.0  # who commands may ask for anything
    named = sorted(implausible_rows(drive, ORCA))
    assert len(named) == 2
    assert named[0].startswith("row 30 at 0.60 s: delta_fb = -8; expected -0.")
    assert named[0].endswith("of vehicle orca (1 such rows)")
    assert named[1].startswith("row 70 at 1.40 s: v_x = 12; expected ")
    assert named[1].endswith("(2 such rows)")


@pytest.mark.parametrize("plant", ["rk4", pytest.param("double_track", marks=pytest.mark.slow)])
def test_a_car_at_its_limit_with_three_times_the_usual_noise_is_plausible(plant) -> None:
    drive = recorded(simulate("orca", "club", plant=plant, duration=20.0, noise=(0.03, 0.03, 0.09), seed=3))
    checks = Plausibility(ORCA)
    names = {"v_x": "v_x", "v_y": "v_y", "omega": "omega", "r_fb": "throttle_feedback", "delta_fb": "steering_feedback"}
    for k, stamp in enumerate(drive.time.tolist()):
        assert checks.check(stamp, {name: float(drive[column][k]) for column, name in names.items()}) is None
    assert list(implausible_rows(drive, ORCA)) == []


def test_limits_grow_with_the_car() -> None:
    small, large = ranges(ORCA), ranges(load_vehicle("av21"))
    assert large["v_x"].high > 50 > 10 > small["v_x"].high
    assert large["omega"].high < small["omega"].high
