"""Drives with a fault that no effect has: how they are made, and how an answer is judged."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.hidden_causes import outside
from benchmarks.hidden_causes.cases import Case, drive


def test_each_fault_can_be_driven_on_each_truth() -> None:
    for number, fault in enumerate(outside.PHYSICS):
        case = Case({}, 3, outside.TRUTHS[number % 3], 8.0)
        with_it, without = (np.array(one["omega"]) for one in (outside.driven(case, fault, 0.01), drive(case)))
        assert with_it.shape == without.shape
        assert np.abs(with_it - without).max() > 0.0


def test_a_sensor_that_is_loose_swings_for_seconds() -> None:
    case = Case({}, 3, "rk4", 30.0)
    with_it, without = outside.driven(case, "loose_sensor", 0.3), drive(case)
    off = np.flatnonzero(with_it["v_y"] != without["v_y"]) * without.T_s
    assert 20.0 < off.min() < 21.0
    assert 25.0 < off.max() < 26.0


@pytest.mark.slow
def test_where_no_effect_fits_the_nearest_is_no_cause() -> None:
    (answer,) = outside.answers(1, 1, only=["throttle_and_yaw"])
    assert (answer.verdict, answer.named, answer.shown) == ("unexplained", (), True)


@pytest.mark.slow
def test_a_sensor_that_pitches_is_unexplained_with_the_right_picture() -> None:
    (answer,) = outside.answers(9, 1)
    assert answer.fault == "pitching_sensor"
    assert answer.right
    assert "`unexplained` with the right picture | 1 of 1" in outside.page([answer])
