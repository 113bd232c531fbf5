"""The battery of hidden causes: its cases, and how they are judged."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from dynssm_ros.diagnosis import battery
from dynssm_ros.diagnosis.battery import SIZES, Case, Outcome, cases, judge, matrix, rates, size
from dynssm_ros.diagnosis.diagnose import Cause
from dynssm_ros.vehicle import load_vehicle
from dynssm_ros.vehicle.effects import EFFECTS


def cause(effect: str, values: dict[str, float], *alternatives: str, std: float = 0.0) -> Cause:
    return Cause(effect, values, dict.fromkeys(values, std), 50.0, 40.0, 0.1, alternatives)


@pytest.mark.parametrize("name", sorted(EFFECTS))
def test_every_effect_has_sizes_that_the_library_admits(name: str) -> None:
    assert name in SIZES
    for seed in range(20):
        values = size(name, np.random.default_rng(seed))
        car = load_vehicle("av21").with_effect(name, values)
        assert not car.active_effects[-1].is_neutral


def test_the_cases_hold_every_effect_none_two_and_four_wheels() -> None:
    listed = list(cases(0, 130))
    assert len(listed) == 130
    assert len({case.name for case in listed}) == 130
    single = Counter(name for case in listed if len(case.hidden) == 1 for name in case.hidden)
    assert set(single) == set(EFFECTS)
    assert min(single.values()) >= 3
    assert Counter(len(case.hidden) for case in listed)[0] == 13
    assert Counter(len(case.hidden) for case in listed)[2] == 13
    assert {case.plant for case in listed} == {"rk4", "double_track"}


def test_the_nominal_car_is_off_by_what_it_says() -> None:
    car = load_vehicle("av21")
    drawn = [battery.off(car, np.random.default_rng(seed)) for seed in range(200)]
    moved = np.array([(other.nominal - car.nominal) for other in drawn]).std(axis=0)
    stated = np.array([c.std for c in drawn[0].coefficients.values()])
    np.testing.assert_allclose(moved, stated, rtol=0.25)


def test_an_alternative_counts_and_a_wrong_name_does_not() -> None:
    case = Case({"drag": {"coefficient": 0.4}}, 0)
    assert judge(case, [cause("drag", {"coefficient": 0.42})]).first
    assert judge(case, [cause("mass", {"factor": 1.1}, "drag")]).first
    wrong = judge(case, [cause("mass", {"factor": 1.1})])
    assert (wrong.first, wrong.all, wrong.sized) == (False, False, None)
    assert not judge(case, []).first


def test_sizes_are_right_within_15_percent_or_two_standard_deviations() -> None:
    case = Case({"mass": {"factor": 1.2}}, 0)
    assert judge(case, [cause("mass", {"factor": 1.22})]).sized
    assert not judge(case, [cause("mass", {"factor": 1.25})]).sized
    assert judge(case, [cause("mass", {"factor": 1.25}, std=0.03)]).sized


def test_none_and_two_are_judged_by_all_that_is_named() -> None:
    assert judge(Case({}, 0), []).first
    assert not judge(Case({}, 0), [cause("mass", {"factor": 1.1})]).first
    two = Case({"mass": {"factor": 1.2}, "drag": {"coefficient": 0.4}}, 0)
    assert not judge(two, [cause("mass", {"factor": 1.2})]).all
    assert judge(two, [cause("mass", {"factor": 1.2}), cause("drag", {"coefficient": 0.4})]).all


def test_rates_and_confusion_count_what_happened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    outcomes = [
        Outcome("a", ("drag",), ("drag",), True, True, True),
        Outcome("b", ("drag",), ("mass",), False, False, None),
        Outcome("c", (), ("mass",), False, False, None),
        Outcome("d", ("drag", "mass"), ("drag", "mass"), True, True, False),
    ]
    assert rates(outcomes) == {
        "cases": 4,
        "named_first": {"of": 2, "share": 0.5},
        "both_found": {"of": 1, "share": 1.0},
        "false_alarms": {"of": 1, "share": 1.0},
        "right_size": {"of": 2, "share": 0.5},
    }
    labels, _, count = matrix(outcomes)
    drag, mass, none = (labels.index(name) for name in ("drag", "mass", "none"))
    assert count.sum() == 3
    assert (count[drag, drag], count[drag, mass], count[none, mass]) == (1, 1, 1)

    ran = iter(outcomes)
    monkeypatch.setattr(battery, "run_case", lambda case: next(ran))
    battery.main(["--out", str(tmp_path), "--count", "4"])
    assert "<svg" in (tmp_path / "confusion.svg").read_text()
    assert '"share": 0.5' in (tmp_path / "battery.json").read_text()
