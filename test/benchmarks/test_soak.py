"""An hour's soak in short: the benchmark counts what it should, and sees what must not happen."""

from __future__ import annotations

import json
import shutil
import time
from pathlib import Path

import pytest

from benchmarks.endurance.fuzz import Traffic
from benchmarks.endurance.soak import main, soak

pytestmark = pytest.mark.live


@pytest.mark.slow
def test_each_message_is_answered_while_models_are_swapped(small_model: Path, tmp_path: Path) -> None:
    other = shutil.copytree(small_model, tmp_path / "other")
    begin = time.monotonic()
    done = soak([small_model, other], 3.0, 100.0, swap_every=0.8)
    assert done.violations == {}
    assert 1 <= done.swaps <= (time.monotonic() - begin) / 0.8, "a busy machine takes longer and tries less"
    assert done.odometry == done.predictions + done.passed_over
    assert 50 < done.odometry <= 310
    assert done.messages == 3 * done.odometry
    assert 0 < done.latency_ms["p50"] <= done.latency_ms["p100"] == max(done.slowest_at_swap_ms, done.slowest_else_ms)
    assert done.rss_mb[0] > 30
    assert done.open_files[0] > 5


@pytest.mark.slow
def test_a_swap_that_is_refused_is_seen(small_model: Path, tmp_path: Path) -> None:
    done = soak([small_model, tmp_path / "none"], 1.5, 100.0, swap_every=0.8)
    assert "no such model folder" in done.violations["a swap was refused"]
    assert done.swaps == 0


@pytest.mark.slow
def test_the_command_writes_what_it_measured(small_model: Path, tmp_path: Path) -> None:
    file = tmp_path / "soak.json"
    with pytest.raises(SystemExit) as ended:
        main(["--model", str(small_model), "--minutes", "0.02", "--json", str(file)])
    assert ended.value.code == 0
    content = json.loads(file.read_text(encoding="utf-8"))
    assert content["predictions"] + content["passed_over"] == content["odometry"] > 30
    assert content["slowest_at_swap_ms"] is None


@pytest.mark.slow
def test_nothing_is_predicted_from_what_is_spoilt(small_model: Path) -> None:
    done = soak([small_model], 3.0, 200.0, spoilt=0.15)
    assert done.violations == {}
    assert 0.1 < done.spoilt / done.messages < 0.2
    assert done.predictions > 0.5 * done.odometry


def test_a_prediction_from_an_invalid_sample_is_seen(small_model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Traffic, "invalid", lambda self, values: "planted")
    assert "planted" in soak([small_model], 1.0, 100.0).violations["predicted from an invalid sample"]
