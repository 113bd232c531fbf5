"""Predictions that are worse than none are told within a second."""

from __future__ import annotations

import math

import pytest

from dynssm_ros.runtime.health import Level
from dynssm_ros.runtime.hindsight import Hindsight

T_S = 40_000_000  # ns
SCALE = (0.3, 0.1, 0.2)


def state(seconds: float) -> tuple[float, float, float]:
    """A car that turns to and fro."""
    return 20.0 + math.sin(seconds), 0.5 * math.sin(3 * seconds), 2.0 * math.sin(3 * seconds)


def driven(seconds: float, period: int, *, error: float, still: bool = False) -> Hindsight:
    """After a drive with odometry every ``period`` (ns), each prediction off by ``error`` usual increments."""
    hindsight = Hindsight(SCALE, 5.0)
    for stamp in range(0, round(seconds * 1e9), period):
        now, then = (state(0.0 if still else at / 1e9) for at in (stamp, stamp + T_S))
        hindsight.measured(stamp, now)
        hindsight.predicted(stamp + T_S, [value + error * s for value, s in zip(then, SCALE, strict=True)], now)
    return hindsight


@pytest.mark.parametrize("period", [T_S, T_S // 4, 30_000_000])
def test_the_ratio_is_that_of_the_errors(period: int) -> None:
    assert driven(3.0, period, error=0.5).verdict() == (Level.OK, "")
    level, words = driven(3.0, period, error=20.0).verdict()
    assert level is Level.ERROR
    assert words.startswith("predictions were off by 20 usual steps lately, the state before them by 0.")


def test_bad_predictions_are_told_after_a_second_and_forgotten_after_another() -> None:
    hindsight = driven(3.0, T_S, error=0.2)
    for k in range(55):
        stamp = 3_000_000_000 + k * T_S
        now, then = state(stamp / 1e9), state((stamp + T_S) / 1e9)
        hindsight.measured(stamp, now)
        hindsight.predicted(stamp + T_S, [50.0, *then[1:]] if k < 25 else then, now)
        if k == 25:
            assert hindsight.verdict()[0] is Level.ERROR
    assert hindsight.verdict()[0] is Level.OK


def test_small_errors_of_a_car_that_drives_evenly_are_none() -> None:
    """No prediction at all is exact there."""
    assert driven(3.0, T_S, error=0.9, still=True).verdict()[0] is Level.OK
    assert driven(3.0, T_S, error=1.1, still=True).verdict()[0] is Level.WARN


def test_without_enough_comparisons_nothing_is_said() -> None:
    assert driven(9 * T_S / 1e9, T_S, error=99.0).verdict()[0] is Level.OK


def test_of_a_car_that_stands_nothing_is_said() -> None:
    hindsight = Hindsight(SCALE, 5.0)
    for stamp in range(0, 3_000_000_000, T_S):
        hindsight.measured(stamp, (0.0, 0.0, 0.0))
        hindsight.predicted(stamp + T_S, (9.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    assert hindsight.verdict()[0] is Level.OK
