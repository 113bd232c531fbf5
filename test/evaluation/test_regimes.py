"""Driving regimes against planted rows."""

from __future__ import annotations

import numpy as np
import pytest

from dynssm_ros.evaluation.regimes import QUANTITIES, driving_regimes, liveliest, regime_rmse


def rows(v_x, omega=0.0, r_fb=0.0, r_cmd=0.0):
    """Input rows with the given columns, all others zero."""
    matrix = np.zeros((len(np.atleast_1d(v_x)), 7))
    matrix[:, 0], matrix[:, 2], matrix[:, 3], matrix[:, 5] = v_x, omega, r_fb, r_cmd
    return matrix


def of(regimes, quantity):
    return [regime for regime in regimes if regime.quantity == quantity]


def test_every_row_belongs_to_one_regime_of_each_quantity():
    rng = np.random.default_rng(0)
    regimes = driving_regimes(rng.normal(size=(500, 7)) * 10)
    for quantity in QUANTITIES:
        np.testing.assert_array_equal(np.sum([regime.member for regime in of(regimes, quantity)], axis=0), 1)
    assert all(regime.rows > 0 for regime in regimes)


@pytest.mark.parametrize(
    ("low", "high", "names"),
    [
        (14.0, 32.4, ["10 to 15 m/s", "15 to 20 m/s", "20 to 25 m/s", "25 to 30 m/s", "30 to 35 m/s"]),
        (0.3, 3.4, ["0 to 1 m/s", "1 to 2 m/s", "2 to 3 m/s", "3 to 4 m/s"]),
        (7.0, 83.0, ["0 to 20 m/s", "20 to 40 m/s", "40 to 60 m/s", "60 to 80 m/s", "80 to 100 m/s"]),
    ],
)
def test_speed_is_divided_at_round_numbers_that_cover_the_range(low, high, names):
    speeds = np.linspace(low, high, 300)
    found = of(driving_regimes(rows(speeds)), "speed")
    assert [regime.name for regime in found] == names
    for regime in found:
        start, _, end = regime.label.partition(" to ")
        assert speeds[regime.member].min() >= float(start)
        assert speeds[regime.member].max() <= float(end)


def test_lateral_acceleration_is_speed_times_yaw_rate_to_either_side():
    found = of(driving_regimes(rows([10.0, 10.0, 20.0, 20.0], [0.01, -0.45, 0.17, 0.0])), "lateral_acceleration")
    assert {regime.name: regime.member.tolist() for regime in found} == {
        "0 to 2 m/s²": [True, False, False, True],
        "2 to 4 m/s²": [False, False, True, False],
        "4 to 6 m/s²": [False, True, False, False],
    }


def test_a_speed_set_point_drives_by_its_distance_from_the_speed():
    found = of(driving_regimes(rows([5.0, 5.0, 5.0, 5.0], 0.0, [4.5, 5.02, 5.5, 0.0]), "speed"), "throttle")
    assert {regime.label: regime.member.tolist() for regime in found} == {
        "braking": [True, False, False, True],
        "coasting": [False, True, False, False],
        "accelerating": [False, False, True, False],
    }


def test_bins_that_nothing_falls_into_are_left_out():
    found = of(driving_regimes(rows([1.0, 1.5, 4.5])), "speed")
    assert [(regime.label, regime.short) for regime in found] == [("1 to 2", "1–2"), ("4 to 5", "4–5")]


def test_the_throttle_that_acts_tells_braking_coasting_and_accelerating():
    feedback, command = np.array([-0.5, -0.02, 0.0, 0.02, 0.021, 0.3]), np.array([0.6, 0.0, 0.0, 0.0, 0.0, -0.4])
    found = of(driving_regimes(rows(np.ones(6), 0.0, feedback, command)), "throttle")
    assert {regime.name: regime.member.tolist() for regime in found} == {
        "braking": [False] * 5 + [True],
        "coasting": [False, True, True, True, False, False],
        "accelerating": [True, False, False, False, True, False],
    }


def test_a_car_at_constant_speed_has_one_regime_of_speed():
    assert len(of(driving_regimes(rows(np.full(9, 20.0))), "speed")) == 1


def test_errors_of_a_regime_are_those_of_its_rows():
    regimes = driving_regimes(rows(np.ones(4), r_fb=np.array([0.5, 0.5, -0.5, -0.5])))
    errors = np.array([[3.0, 0.0, 1.0], [4.0, 0.0, 1.0], [0.0, 2.0, 1.0], [0.0, -2.0, -1.0]])
    values = dict(zip([regime.name for regime in regimes], regime_rmse(regimes, errors), strict=True))
    np.testing.assert_allclose(values["accelerating"], [np.sqrt(12.5), 0.0, 1.0])
    np.testing.assert_allclose(values["braking"], [0.0, 2.0, 1.0])


def test_liveliest_stretch_is_where_the_states_change_and_never_spans_a_gap():
    time = 0.1 * np.r_[0:200, 300:500]
    states = np.zeros((400, 3))
    states[:, 0] = 0.001 * np.arange(400)
    states[330:350, 1] = np.random.default_rng(0).normal(size=20)
    stretch = liveliest(time, states, 4.0)
    assert len(stretch) == 40
    assert stretch[0] <= 330
    assert stretch[-1] >= 350
    states[195:205, 2] = np.random.default_rng(0).normal(size=10) * 100
    assert np.diff(time[liveliest(time, states, 4.0)]).max() < 0.11


def test_liveliest_stretch_of_a_short_run_is_all_of_it():
    np.testing.assert_array_equal(liveliest(np.arange(5.0), np.zeros((5, 3)), 60.0), np.arange(5))
