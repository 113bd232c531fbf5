"""Faults of a live stack are drawn fairly, and judged."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from benchmarks.endurance.live_faults import CARS, FAULTS, SPEEDS, Drawn, drive, way_of_full_brakes
from dynssm_ros.vehicle import load_vehicle


def test_what_breaks_follows_from_its_number_and_covers_everything() -> None:
    drawn = [Drawn.of(number) for number in range(500)]
    assert drawn[:30] == [Drawn.of(number) for number in range(30)]
    assert {fault.what for fault in drawn} == set(FAULTS)
    for share in (Counter(fault.car for fault in drawn), Counter(fault.speed for fault in drawn)):
        assert min(share.values()) > 0.8 * 500 / len(share)
    assert {fault.car for fault in drawn} == set(CARS)
    assert {fault.speed for fault in drawn} == set(SPEEDS)
    assert all(0 <= fault.share <= 1 for fault in drawn)


def test_full_brakes_take_the_square_of_the_speed() -> None:
    """The 1:43 car's deceleration hardly depends on its speed."""
    orca = load_vehicle("orca")
    assert way_of_full_brakes(orca, 2.0) == pytest.approx(4 * way_of_full_brakes(orca, 1.0), rel=0.1)
    assert 0.7 < way_of_full_brakes(orca, 2.0) < 1.5


@pytest.mark.slow
@pytest.mark.live
@pytest.mark.alone
@pytest.mark.timeout(300)
@pytest.mark.parametrize("what", ["frozen", "silent", "rogue coefficients", "invalid requests"])
def test_a_fault_ends_no_node_is_told_and_braked_for(small_model: Path, what: str) -> None:
    outcome = drive(small_model, Drawn(0, what, 2.0, 0.5, "orca", 0.7))
    assert outcome.wrong == ""
    assert outcome.ended == ()
