"""The gear, by a sensor or by engine speed over speed."""

from __future__ import annotations

import numpy as np

from dynssm_ros.vehicle.gears import changes_into, gear_of

V_X = 16.0 - 10.0 * np.cos(np.linspace(0.0, 60.0, 6000))
GEAR = np.digitize(V_X, [9.0, 14.0, 21.0]) + 1
RATIOS = np.array([0.0, 60.0, 40.0, 28.0, 20.0])  # rad/m


def test_a_sensor_is_taken_at_its_word() -> None:
    assert (gear_of({"gear": GEAR + 0.1}, V_X) == GEAR).all()
    assert gear_of({}, V_X) is None


def test_gears_follow_from_noisy_engine_speeds_with_a_clutch_that_slips_between_them() -> None:
    rng = np.random.default_rng(0)
    ratio = np.convolve(RATIOS[GEAR], np.full(5, 0.2), mode="same")
    ratio[:3] = ratio[-3:] = RATIOS[1]
    found = gear_of({"engine_speed": V_X * ratio * (1 + 0.01 * rng.standard_normal(len(V_X)))}, V_X)
    assert found is not None
    assert np.mean(found == GEAR) > 0.98  # all but the rows of changes
    assert set(found) == {1, 2, 3, 4}


def test_an_engine_of_one_gear_is_always_in_it_and_one_that_stands_tells_nothing() -> None:
    assert set(gear_of({"engine_speed": 10.0 * V_X}, V_X)) == {1}
    assert gear_of({"engine_speed": np.zeros(len(V_X))}, V_X) is None


def test_speeds_of_changes_are_those_at_which_the_gear_rises_and_falls() -> None:
    changes = changes_into(GEAR, V_X, 3)
    assert len(changes.up) == len(changes.down) + 1 == 10
    assert np.abs([*changes.up, *changes.down] - np.float64(14.0)).max() < 0.2
