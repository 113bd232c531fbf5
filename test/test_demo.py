"""The whole way, shortened: the same code as `make demo` with less driving and training."""

from __future__ import annotations

from pathlib import Path

import pytest

from examples import demo

pytestmark = [pytest.mark.live, pytest.mark.slow, pytest.mark.timeout(240)]


def test_the_demo_goes_the_whole_way_and_ends_with_a_report(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, value in {"TRAINING_TIME": 90.0, "TEST_TIME": 20.0, "LIVE_TIME": 4.0, "EPOCHS": 1}.items():
        monkeypatch.setattr(demo, name, value)
    demo.demo(tmp_path / "demo")
    assert "0 missing" in " ".join(capsys.readouterr().out.split())
    made = {path.name for path in (tmp_path / "demo").iterdir()}
    assert made >= {"report.html", "vehicle.yaml", "model", "losses.png", "road_course_bag", "oval.parquet"}
    assert not any("checkpoint" in name for name in made)
    html = (tmp_path / "demo" / "report.html").read_text()
    assert "Live: predicted against measured" in html
    assert html.count("<img") + html.count("<svg") >= 6
