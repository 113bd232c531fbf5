"""Laps of a car that is followed around a track: timed, with gaps, and how far outside it came."""

from __future__ import annotations

import math

import pytest

from dynssm_ros.control.live import Laps


@pytest.mark.parametrize("first", [0.0, 2.0, 6.2])
def test_laps_are_timed_from_where_the_car_was_first_seen(circle, first):
    track, _ = circle(radius=1.0)
    laps = Laps(track)
    speed = 1.3
    for k in range(600):
        angle = first + speed * 0.02 * k
        laps.passed(5.0 + 0.02 * k, math.cos(angle), math.sin(angle))
    assert laps.count == int(600 * 0.02 * speed / (2 * math.pi))
    assert laps.last == pytest.approx(2 * math.pi / speed, rel=1e-4)
    assert laps.worst == 0.0


def test_a_lap_with_a_gap_does_not_count(circle):
    track, _ = circle(radius=1.0)
    laps = Laps(track)
    for k in range(150):
        angle = 2 * math.pi * k / 100
        laps.passed(0.1 * k, math.cos(angle), math.sin(angle), together=k != 60)
    assert laps.count == 0
    for k in range(150, 170):
        angle = 2 * math.pi * k / 100
        laps.passed(0.1 * k, math.cos(angle), math.sin(angle))
    assert laps.count == 1
    assert laps.last == pytest.approx(10.0)


def test_how_far_outside_is_measured_and_kept(circle):
    track, _ = circle(radius=1.0)
    laps = Laps(track)
    for radius, outside in ((1.0, 0.0), (1.25, 0.05), (0.7, 0.1), (1.1, 0.0)):
        laps.passed(0.0, radius, 0.0)
        assert laps.outside == pytest.approx(outside, abs=1e-6)
    assert laps.worst == pytest.approx(0.1, abs=1e-6)
