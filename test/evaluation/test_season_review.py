"""A season in review: what is planted is found, what is unchanged raises no alarm, and alarms are raised once."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from dynssm_ros.api import review_season
from dynssm_ros.evaluation.season_review import (
    Accuracy,
    Estimate,
    Found,
    Review,
    Stretch,
    alarms,
    another_day,
    expected,
)
from dynssm_ros.runtime.coefficients import daily_change
from dynssm_ros.signals.season import Season, Session
from dynssm_ros.simulation.laps import as_recording, simulate
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import COEFFICIENTS, Vehicle, load_vehicle

ORCA = load_vehicle("orca")


def a_review(
    k: int,
    D_f: float = 0.19,
    std: float = 0.002,
    ade: float = 0.01,
    simple: float = 0.02,
    cause: str = "",
    car: str = "orca",
) -> Review:
    """A session whose other coefficients are as in the vehicle file."""
    values = dict(zip(COEFFICIENTS, ORCA.nominal, strict=True)) | {"D_f": D_f}
    coefficients = {name: Estimate(value=value, std=std) for name, value in values.items()}
    none = (0.0, 0.0, 0.0)
    return Review(
        key="", car=car, track="club", session=f"run_{k}", start=f"2026-06-{k + 1:02d}T10:00:00+00:00", seconds=60.0,
        accuracy={"dynssm": Accuracy(ade=ade, rmse=none), "single_track": Accuracy(ade=simple, rmse=none)},
        stretches=(Stretch(start="", coefficients=coefficients),),
        verdict="cause" if cause else "healthy",
        causes=(Found(effect=cause, values={"factor": 0.9}, std={}, improvement=0.5),) if cause else (),
    )  # fmt: skip


def told(reviews: list[Review]) -> list[tuple[str, str]]:
    return [(alarm.review.session, alarm.subject) for alarm in alarms(reviews)]


def test_a_coefficient_that_moves_is_named_once_and_again_when_it_moves_back() -> None:
    draw = np.random.default_rng(0)
    wear = [0.19] * 5 + [0.17] * 5 + [0.19] * 2
    season = [a_review(k, D_f + 0.002 * draw.standard_normal()) for k, D_f in enumerate(wear)]
    assert told(season) == [("run_5", "D_f"), ("run_10", "D_f")]
    (first, *_) = alarms(season)
    assert first.words.startswith("D_f moved from 0.19 to 0.171 (-10 %)")


def test_what_varies_from_session_to_session_anyway_is_no_alarm() -> None:
    draw = np.random.default_rng(1)
    raised = sum(
        bool(told([a_review(k, 0.19 + 0.01 * draw.standard_normal(), 0.001) for k in range(20)])) for _ in range(50)
    )
    assert raised <= 10  # three sessions tell little of how much it varies


def test_the_spread_between_sessions_is_recovered() -> None:
    draw = np.random.default_rng(2)
    points = [
        Estimate(value=3 + 0.5 * draw.standard_normal() + 0.2 * draw.standard_normal(), std=0.2) for _ in range(4000)
    ]
    mean, std = expected(points)
    assert mean == pytest.approx(3.0, abs=0.03)
    assert std == pytest.approx(0.5, rel=0.05)
    assert expected([Estimate(value=1.0, std=0.1)] * 4) == (pytest.approx(1.0), pytest.approx(0.05))


def test_models_that_lose_and_errors_that_rise_are_named() -> None:
    season = [a_review(k, ade=ade) for k, ade in enumerate([0.01, 0.01, 0.011, 0.03, 0.03, 0.012])]
    assert told(season) == [("run_3", "models"), ("run_3", "dynssm"), ("run_4", "dynssm")]


def test_causes_come_and_go_by_car() -> None:
    season = [
        a_review(0, cause="drag"),
        a_review(1, cause="drag", car="spare"),
        a_review(2, cause="rear_grip"),
        a_review(3),
    ]
    assert told(season) == [("run_2", "rear_grip"), ("run_2", "drag"), ("run_3", "rear_grip")]
    assert next(alarm.words for alarm in alarms(season)) == "cause rear_grip comes: factor 0.9"


def test_another_day_adds_what_changes_to_what_is_known() -> None:
    known = ORCA.with_nominal(ORCA.nominal, 0.05 * np.abs(ORCA.nominal), 0.5 * np.eye(17) + 0.5)
    loose = another_day(known)
    std = np.array([loose.coefficients[name].std for name in COEFFICIENTS])
    both = np.hypot(0.05 * np.abs(ORCA.nominal), daily_change(ORCA))
    np.testing.assert_allclose(std, both)
    correlation = 0.5 * 0.05**2 * np.abs(ORCA.nominal[0] * ORCA.nominal[1]) / (std[0] * std[1])
    assert loose.known_correlation[0, 1] == pytest.approx(correlation, rel=1e-3)  # a file has few digits


WORN = ORCA.with_effects([("rear_grip", {"factor": 0.85})])
KNOWN = ORCA.with_nominal(ORCA.nominal, 0.03 * np.abs(ORCA.nominal))


@pytest.fixture
def season_of(tmp_path: Path) -> Callable[..., Season]:
    """``season_of((car, seconds), ...)``: one session of each drive on ``club``."""

    def make(*drives: tuple[Vehicle, float]) -> Season:
        made = Season(tmp_path / "season")
        for k, (car, duration) in enumerate(drives):
            run = simulate(car, load_track("club"), duration, plant="rk4", seed=8500 + k, noise=(0.005, 0.005, 0.02))
            laps = as_recording(run)
            session = Session(
                car="orca", track="club", session=f"run_{k}", bag="", files={}, checksum="", settings="", signal_map="",
                rate=50.0, start=f"2026-06-0{k + 1}T10:00:00+00:00", rows=len(laps), seconds=laps.duration, segments=1,
            )  # fmt: skip
            made.sessions[session.place] = session
            made.file(session.place).parent.mkdir(parents=True)
            laps.save(made.file(session.place))
        made.save()
        return made

    return make


def test_sessions_are_reviewed_once_and_what_cannot_be_told_of_a_short_one_is_a_failure(
    season_of: Callable[..., Season], tmp_path: Path
) -> None:
    season, out = season_of((ORCA, 0.4), (WORN, 0.5)), tmp_path / "review"
    reviews = review_season(season.path, ["persistence"], KNOWN, out)
    for short in reviews:
        assert {words.partition(":")[0] for words in short.failures} == {"models", "coefficients", "diagnosis"}
    kept = {path: path.stat().st_mtime_ns for path in (out / "sessions").iterdir()}
    assert review_season(season, ["persistence"], KNOWN, out) == reviews
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    other = review_season(season, [], KNOWN, out)
    assert all(new.key != old.key for new, old in zip(other, reviews, strict=True))


@pytest.mark.slow
def test_a_season_tells_what_a_car_has_lost(season_of: Callable[..., Season], tmp_path: Path) -> None:
    season = season_of((ORCA, 24.0), (WORN, 24.0), (ORCA, 0.4))
    healthy, worn, short = review_season(season.path, ["persistence"], KNOWN, tmp_path / "review", stretch=12.0)
    assert [len(each.stretches) for each in (healthy, worn, short)] == [2, 2, 0]
    assert healthy.causes == ()
    assert [cause.effect for cause in worn.causes][:1] == ["rear_grip"]
    assert worn.causes[0].values["factor"] == pytest.approx(0.85, abs=0.03)
    assert worn.stretches[0].coefficients["D_r"].value < 0.93 * healthy.stretches[0].coefficients["D_r"].value
    assert healthy.accuracy.keys() == {"persistence", "single_track", "single_track_ewma"}
