"""What is killed leaves the old output or the new one, and the benchmark sees it where that is not so."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from benchmarks.endurance import kills
from benchmarks.endurance.kills import Command, kill

_IN_PLACE = """
import pathlib, shutil, sys, time
out = pathlib.Path(sys.argv[-1])
shutil.rmtree(out, ignore_errors=True)
out.mkdir()
(out / "first.json").write_text("{}")
time.sleep(0.6)
(out / "second.json").write_text("{}")
"""


def test_an_extraction_that_is_killed_leaves_the_older_recording(laps_bag: Path, tmp_path: Path) -> None:
    arguments = ("extract", str(laps_bag), "--signals", "default", "--rate", "50")
    outcome = kill(Command("extract", arguments, "laps.parquet"), tmp_path, 3, seed=0)
    assert outcome.faults == []
    assert outcome.kills >= 1
    assert outcome.older + outcome.newer == 3


@pytest.mark.slow
def test_an_output_that_is_written_in_place_is_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kills, "_dynssm", lambda arguments: [sys.executable, "-c", _IN_PLACE, *arguments])
    outcome = kill(Command("toy", (), "out"), tmp_path, 8, seed=0)
    assert any(fault.endswith("out holds first.json") for fault in outcome.faults)
