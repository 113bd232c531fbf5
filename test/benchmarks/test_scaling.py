"""What thousands of hours would cost follows from two amounts of logs."""

from __future__ import annotations

import pytest

from benchmarks.scaling import Slope, Used, arithmetic, slope


def test_the_slope_is_of_what_more_hours_cost_and_the_rest_is_the_start() -> None:
    found = slope(Used(7.0, 5.0, 100.0), Used(12.0, 9.0, 120.0), hours=0.5)
    assert found == Slope(start=2.0, clock=10.0, cpu=8.0, memory=120.0)


def test_a_season_costs_what_its_hours_cost_on_one_core_and_a_hundredth_on_a_hundred() -> None:
    found = {
        "extract, 1 worker": Slope(1.0, 18.0, 18.0, 100.0),
        "extract, 2 workers": Slope(1.0, 9.0, 20.0, 100.0),
        "train, an epoch, 1 worker": Slope(1.0, 36.0, 36.0, 100.0),
        "evaluate, 1 worker": Slope(1.0, 18.0, 18.0, 100.0),
    }
    rows = {row[0]: row[1:] for row in arithmetic(found, 10, {"bags": 400.0, "recordings": 20.0}).rows}
    assert rows["bags (TB)"] == [pytest.approx(0.4), pytest.approx(40.0)]
    assert rows["extract (core h)"] == [pytest.approx(5.0), pytest.approx(500.0)]
    assert rows["both on 100 cores (h)"] == [pytest.approx(0.1), pytest.approx(10.0)]
    assert rows["train 10 epochs (core h)"] == [pytest.approx(100.0), pytest.approx(1e4)]
