"""A car that is asked for a speed, in closed loop."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from dynssm_ros.control.live import LiveController
from dynssm_ros.control.nmpc import manoeuvres
from dynssm_ros.control.race import Course, Race, Start, race
from dynssm_ros.control.race_models import true_model
from dynssm_ros.control.reference import load_reference
from dynssm_ros.control.settings import Settings
from dynssm_ros.reporting.race_report import race_table
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import Applied, State, load_vehicle
from dynssm_ros.vehicle.kinematics import Pose

CAR = load_vehicle("f1tenth")


@pytest.fixture(scope="module")
def course() -> Course:
    """Without a deadline, so that no load of the machine changes a lap."""
    track = load_track("club").scaled(10.0)
    settings = replace(Settings.of(CAR), deadline=math.inf)
    return Course(CAR, track, "euler", load_reference("racing", CAR, track, 0.9), settings)


def test_what_changes_of_the_set_point_cost_is_that_of_a_throttle_with_the_same_force() -> None:
    orca, unit = load_vehicle("orca"), CAR.input_unit
    assert (orca.input_unit, unit) == (1.0, pytest.approx(35.6 / 24.0))
    assert Settings.of(CAR).rates[0] * unit**2 == pytest.approx(Settings.of(orca).rates[0])


def test_manoeuvres_that_brake_stop_and_do_not_drive_backwards() -> None:
    increments = manoeuvres(Applied(5.0, 0.0), CAR.inputs, 10, 0.02)
    assert increments[:, :, 0].min() == -5.0


def test_a_controller_that_brakes_asks_for_standstill(course: Course) -> None:
    driver = LiveController(CAR, course.reference, course.track, course.settings)
    x, y = (float(value) for value in course.reference.line.position(0.0))
    command = driver.step(0, Pose(x, y, float(course.reference.line.heading(0.0))), State(8.0, 0.0, 0.0))
    assert isinstance(command, Applied)
    assert 7.0 < command.r < 12.0  # as it rolls, not braked first
    assert driver.brake().r == 0.0


@pytest.fixture(scope="module")
def laps(course: Course) -> dict[str, Race]:
    """From the line's own speed, and from standstill."""
    model = true_model(CAR, "euler")
    return {"rolling": race(course, model), "standing": race(replace(course, start=Start(speed=0.0)), model)}


@pytest.mark.slow
@pytest.mark.parametrize(("start", "longer"), [("rolling", 0.03), ("standing", 0.12)])
def test_the_true_model_completes_a_lap_close_to_what_the_line_allows(
    laps: dict[str, Race], start: str, longer: float
) -> None:
    lap = laps[start]
    assert lap.completed
    assert (lap.outside, lap.infeasible) == (0.0, 0)
    assert lap.lap_times[0] < (1 + longer) * lap.course.reference.lap_time
    low, high = CAR.inputs.throttle
    assert ((low <= lap.command[:, 0]) & (lap.command[:, 0] <= high)).all()
    assert np.ptp(lap.command[:, 0]) > 3.0
    assert race_table([lap]) is not None
