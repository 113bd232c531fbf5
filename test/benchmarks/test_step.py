"""What a step of the predictor takes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import step
from benchmarks.step import evaluation_table, means, percentiles, steps_table
from dynssm_ros import compiled
from dynssm_ros.signals.extraction import extract
from dynssm_ros.signals.signal_map import load_signal_map


@pytest.mark.parametrize("integrator", ["euler", "rk4"])
def test_all_means_give_the_same(integrator: Any, library: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiled, "LIBRARY", library)
    ways = means(integrator)
    assert {"numpy", "casadi, C", "tape, compiled loop"} <= ways.keys()
    expected = ways["numpy"].result()
    for way in ways.values():
        taken = percentiles(way.call, 3)
        assert np.all(np.diff(taken) >= 0)
        np.testing.assert_allclose(way.result(), expected, rtol=1e-12, atol=1e-12)


def test_models_are_timed_with_the_compiled_loops_and_without(
    rls_model: Path, laps_bag: Path, library: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compiled, "LIBRARY", library)
    laps = extract([laps_bag], load_signal_map("default"), 50.0)
    for table in (steps_table([rls_model], laps, 80, 1), evaluation_table([rls_model], laps, 150)):
        assert [row[:2] for row in table.rows] == [["rls", "yes"], ["rls", "no"]]
        assert all(value > 0 for row in table.rows for value in row[2:])
    assert compiled.LIBRARY is library


def test_it_prints_a_table(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(step, "_CALLS", 2)
    monkeypatch.setattr(step, "percentiles", lambda call: np.zeros(3))
    step.main([])
    assert "casadi, C" in capsys.readouterr().out
