"""CommonRoad's car as a plant, and what is hidden in it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from benchmarks.hidden_causes import multi_body
from benchmarks.hidden_causes.cases import cases
from dynssm_ros.errors import ConfigurationError
from dynssm_ros.simulation.plant import Plant, make_plant
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import Applied, State, load_vehicle
from dynssm_ros.vehicle.kinematics import Pose
from dynssm_ros.vehicle.single_track import GRAVITY

CAR = load_vehicle(multi_body.FILE)
SPEED = 20.0  # m/s
LINE = load_track("club").scaled(140.0).centre


def driven(steps: int = 25, steering: float = 0.0, s: float = 0.0, **hidden: dict[str, float]) -> Plant:
    """The car after a second without throttle."""
    car = make_plant(
        CAR.with_effects(hidden.items()), multi_body.NAME, Pose(0.0, 0.0, 0.0), State(SPEED, 0.0, 0.0), line=LINE
    )
    for _ in range(steps):
        car.advance(Applied(0.0, steering), s)
    return car


def test_it_coasts_against_the_air_alone() -> None:
    # v' = -c v^2 / m
    m, c = CAR.constants.m, 0.45
    assert driven().state.v_x == pytest.approx(SPEED / (1.0 + c * SPEED / m), abs=0.02)
    assert driven(drag={"coefficient": 0.6}).state.v_x == pytest.approx(SPEED / (1.0 + (c + 0.6) * SPEED / m), abs=0.02)
    rolling = driven(rolling_resistance={"coefficient": 0.04}).state.v_x - driven().state.v_x
    assert rolling == pytest.approx(-0.04 * GRAVITY, rel=0.06)  # wheels that spin are heavier


@pytest.mark.parametrize("throttle", [0.2, 1.0, -0.3])
def test_a_heavier_car_has_the_same_engine_and_brakes(throttle: float) -> None:
    def gained(**hidden: dict[str, float]) -> float:
        car = driven(0, **hidden)
        car.advance(Applied(throttle, 0.0))
        before = car.state.v_x
        car.advance(Applied(throttle, 0.0))
        return car.state.v_x - before

    assert gained(mass={"factor": 1.25}) == pytest.approx(gained() / 1.25, rel=0.02)


def test_in_a_bend_it_turns_as_its_wheels_point() -> None:
    turning = driven(steering=0.02).state.omega
    assert 0.5 < turning / (SPEED * 0.02 / (CAR.constants.l_f + CAR.constants.l_r)) < 1.1
    for hidden in ({"steering_gain": {"factor": 0.8}}, {"steering_offset": {"offset": -0.004}}):
        assert driven(steering=0.02, **hidden).state.omega == pytest.approx(
            driven(steering=0.016).state.omega, rel=1e-6
        )


def test_wheels_that_lag_turn_the_car_later() -> None:
    quick, late = driven(), driven(steering_lag={"time_constant": 0.2})
    for car in (quick, late):
        for _ in range(3):
            car.advance(Applied(0.0, 0.02))
    assert 0.0 < late.state.omega < 0.6 * quick.state.omega


def test_on_the_patch_it_slips_earlier() -> None:
    patch = {"factor": 0.5, "centre": 0.3, "length": 0.1}
    usual = driven(steering=0.1).state.omega
    assert driven(steering=0.1, s=0.3 * LINE.length, grip_patch=patch).state.omega < 0.9 * usual
    assert driven(steering=0.1, s=0.4 * LINE.length, grip_patch=patch).state.omega == usual


def test_sensors_show_what_they_should() -> None:
    true = driven(steering=0.05)
    turned, off, biased = (
        driven(steering=0.05, **{name: values}).measured
        for name, values in (
            ("odometry_misalignment", {"angle": 0.1}),
            ("odometry_lever_arm", {"x": 0.5}),
            ("yaw_rate_bias", {"bias": 0.01}),
        )
    )
    assert math.hypot(turned.v_x, turned.v_y) == pytest.approx(math.hypot(true.state.v_x, true.state.v_y))
    assert math.atan2(true.state.v_y, true.state.v_x) - math.atan2(turned.v_y, turned.v_x) == pytest.approx(0.1)
    assert off.v_y - true.state.v_y == pytest.approx(0.5 * true.state.omega)
    assert biased.omega - true.state.omega == pytest.approx(0.01)
    assert driven(steering=0.05, odometry_delay={"delay": 0.04}).measured == driven(steps=24, steering=0.05).state


def test_what_cannot_be_hidden_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="plant multi_body: tire_relaxation; expected some of"):
        driven(tire_relaxation={"length": 0.3})


def test_cases_hide_in_it_what_can_be() -> None:
    drawn = [case for case in cases(0, 200) if case.plant == multi_body.NAME]
    hidden = {name for case in drawn for name in case.hidden}
    assert len(drawn) == 50
    assert hidden <= set(multi_body.HIDES)
    assert len(hidden) > 0.8 * len(multi_body.HIDES)
    assert np.ptp([case.seed for case in drawn]) > 190
