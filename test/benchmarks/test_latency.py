"""What a node adds is its time less the echo's at the same rate, and the echo answers what is sent."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.endurance.latency import ECHO, Measured, measure, table
from benchmarks.endurance.live_run import isolated_environment
from dynssm_ros.errors import UserError


def test_what_a_node_adds_is_beyond_the_echo_of_its_rate() -> None:
    def found(node: str, rate: float, *latency: float, unanswered: int = 0) -> Measured:
        return Measured(node, rate, np.array(latency), unanswered)

    measured = [
        found(ECHO, 100.0, 1.0, 1.0),
        found("rls", 100.0, 3.0, unanswered=1),
        found(ECHO, 200.0, 2.0, 2.0),
        found("rls", 200.0, 3.5, 3.5),
        found("rls", 100.0, 4.0),
    ]
    rows = {(row[0], row[1]): list(row[2:]) for row in table(measured).rows}
    assert rows[ECHO, 100.0] == [1.0, 1.0, None, None, 2, 0]
    assert rows["rls", 100.0] == pytest.approx([3.5, 3.99, 2.5, 2.99, 3, 1])
    assert rows["rls", 200.0] == pytest.approx([3.5, 3.5, 1.5, 1.5, 2, 0])


def test_no_model_is_no_comparison() -> None:
    with pytest.raises(UserError, match="expected one"):
        next(measure([], [100.0], 1.0))


@pytest.mark.live
@pytest.mark.alone
@pytest.mark.slow
def test_echo_and_predictor_answer(small_model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in isolated_environment().items():
        monkeypatch.setenv(name, value)
    bare, own = measure([small_model], [50.0], 1.0)
    assert (bare.node, own.node) == (ECHO, small_model.name)
    for each in (bare, own):
        assert len(each.latency) + each.unanswered > 10
        assert len(each.latency) > each.unanswered
        assert each.latency.min() > 0.0
