"""The state behind noisy measurements."""

import math

import numpy as np
import pytest

from dynssm_ros.control.state_estimator import GAINS, StateEstimator

T_S, STD = 0.02, np.array([0.05, 0.5])


def truth(n=500):
    """Two channels on their way, ``(n, 2)``."""
    t = T_S * np.arange(n)
    return np.stack([2.0 + np.sin(2 * t), np.cos(3 * t)], axis=1)


def followed(measured, moved):
    estimator = StateEstimator(T_S)
    return estimator, np.array(
        [estimator.update(row, None if k == 0 else moved[k - 1]) for k, row in enumerate(measured)]
    )


def test_a_measurement_without_noise_is_left_as_it_is():
    states = truth()
    estimator, found = followed(states, np.diff(states, axis=0))
    np.testing.assert_array_equal(found, states)
    assert list(estimator.gains) == [1.0, 1.0]


def test_a_model_that_errs_is_not_believed_against_a_clean_measurement():
    states = truth()
    _, found = followed(states, np.diff(states, axis=0) + np.array([0.02, -0.02]))
    np.testing.assert_array_equal(found, states)


def test_noise_is_filtered_where_the_model_is_right():
    states = truth()
    measured = states + STD * np.random.default_rng(1).standard_normal(states.shape)
    estimator, found = followed(measured, np.diff(states, axis=0))
    left = (found - states)[100:].std(axis=0) / STD
    assert np.all(estimator.gains < 0.5)
    # in its steady state the observer of the least gain leaves sqrt(g / (2 - g)) of white noise
    assert np.all(left < 2.0 * math.sqrt(GAINS[-1] / (2 - GAINS[-1])))


def test_each_channel_has_its_own_gain():
    states = truth()
    noise = [0.0, 0.5] * np.random.default_rng(1).standard_normal(states.shape)
    estimator, found = followed(states + noise, np.diff(states, axis=0) + np.array([0.01, 0.0]))
    assert estimator.gains[0] == 1.0 > estimator.gains[1]
    np.testing.assert_array_equal(found[:, 0], states[:, 0])


def test_with_noise_and_a_model_that_errs_it_finds_what_is_between():
    """The Kalman filter for a random walk of 0.02 a step, seen with noise of 0.05, has a gain of 0.33 and leaves 0.57."""
    rng = np.random.default_rng(2)
    states = np.cumsum(0.02 * rng.standard_normal((3000, 1)), axis=0)
    _, found = followed(states + 0.05 * rng.standard_normal(states.shape), np.zeros((2999, 1)))
    assert 0.57 * 0.05 < (found - states).std() < 0.7 * 0.05


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_lost_measurement_is_passed_on_and_the_rest_goes_on(bad):
    states = truth()
    measured = states + STD * np.random.default_rng(1).standard_normal(states.shape)
    lost = measured.copy()
    lost[300, 0] = bad
    moved = np.diff(states, axis=0)
    _, found = followed(lost, moved)
    assert not np.isfinite(found[300, 0])
    assert np.all(np.isfinite(found[301:]))
    assert np.abs((found - states)[301:320, 1]).max() < STD[1]


def test_it_begins_anew_where_the_model_says_nothing():
    states = truth()
    estimator, _ = followed(
        states + STD * np.random.default_rng(1).standard_normal(states.shape), np.diff(states, axis=0)
    )
    fresh = np.array([1.0, 1.0])
    np.testing.assert_array_equal(estimator.update(fresh, None), fresh)
    assert list(estimator.gains) == [1.0, 1.0]
