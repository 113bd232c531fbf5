"""The page of a season: what is in it, also of sessions in which nothing could be done."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from dynssm_ros.evaluation.open_loop import Accuracy
from dynssm_ros.evaluation.season_review import Estimate, Found, LeftOver, Review, Stretch, alarms
from dynssm_ros.reporting.season_report import season_report, session_table
from dynssm_ros.signals.season import Season, Session
from dynssm_ros.simulation.laps import as_recording, simulate
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import COEFFICIENTS, load_vehicle

ORCA = load_vehicle("orca")


def a_review(k: int, car: str = "orca", D_r: float = 0.17) -> Review:
    values = dict(zip(COEFFICIENTS, ORCA.nominal, strict=True)) | {"D_r": D_r}
    coefficients = {name: Estimate(value=value, std=0.002) for name, value in values.items()}
    errors = {"dynssm": Accuracy(ade=0.01 + 0.001 * k, rmse=(0.0, 0.0, 0.0))}
    return Review(
        key="", car=car, track="club", session=f"run_{k}", start=f"2026-06-{k + 1:02d}T10:00:00+00:00", seconds=600.0,
        accuracy=errors, stretches=(Stretch(start="", coefficients=coefficients),) * 2, verdict="cause",
        causes=(Found(effect="drag", values={"factor": 1.4}, std={}, improvement=0.3),),
        patterns=(LeftOver(channel="v_y", share=0.4, words="v_y errs every 1 s"),),
    )  # fmt: skip


def test_the_page_names_alarms_models_coefficients_and_causes() -> None:
    reviews = [a_review(k, D_r=0.17 if k < 4 else 0.14) for k in range(6)]
    nothing = {"session": "run_6", "accuracy": {}, "stretches": (), "patterns": (), "failures": ("models: too short",)}
    reviews.append(reviews[-1].model_copy(update=nothing))
    raised = alarms(reviews)
    report = season_report(reviews, raised, {"Vehicle": "orca"})
    assert report.summary == "7 sessions, 1.2 h of orca on club. Alarms: 1, in 1 of them."
    assert [section.title for section in report.sections] == [
        "Alarms",
        "Models",
        "Coefficients",
        "Causes",
        "What is left",
        "Not done",
    ]
    html = report.html()
    assert "D_r moved from 0.17 to 0.14" in html
    assert "run_6: models: too short." in html
    assert html.count("v_y errs every 1 s") == 6
    assert html.count("data:image/svg") == 3
    row = session_table(reviews, raised).rows[4]
    assert row == ["run_4", "2026-06-05 10:00", "club", 600, pytest.approx(0.014), "dynssm", "drag", 1]


def test_several_cars_are_told_apart() -> None:
    reviews = [a_review(k, "orca" if k % 2 else "spare") for k in range(4)]
    assert [column.title for column in session_table(reviews, []).columns][2] == "car"
    assert "orca, spare on club" in season_report(reviews, [], {}).summary


def test_the_command_writes_it_though_nothing_can_be_done(
    tmp_path: Path, dynssm: Callable[..., tuple[int, str, str]]
) -> None:
    season = Season(tmp_path / "season")
    laps = as_recording(simulate(ORCA, load_track("club"), duration=0.4))
    session = Session(
        car="orca", track="club", session="run_0", bag="", files={}, checksum="", settings="", signal_map="", rate=50.0,
        start="2026-06-01T10:00:00+00:00", rows=len(laps), seconds=laps.duration, segments=1,
    )  # fmt: skip
    season.sessions[session.place] = session
    season.file(session.place).parent.mkdir(parents=True)
    laps.save(season.file(session.place))
    season.save()
    status, _, err = dynssm("season", season.path, "--vehicle", "orca", "--out", tmp_path / "review")
    assert status == 0, err
    assert "Not done" in (tmp_path / "review" / "report.html").read_text()
