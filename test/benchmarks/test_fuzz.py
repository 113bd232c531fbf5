"""Damaged messages change nothing but the diagnostics, and what is done wrong with them is seen."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.endurance.fuzz import fuzz
from dynssm_ros.runtime.predictor import Prediction, Predictor
from dynssm_ros.signals.history import Refusal


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_no_damaged_message_raises_or_yields_a_prediction(small_model: Path, seed: int) -> None:
    done = fuzz(small_model, 6000, seed)
    assert done.violations == {}
    assert done.messages >= 6000
    assert 0.1 < done.spoilt / done.messages < 0.2
    assert done.predictions > 0.7 * done.messages / 3
    assert {"not_finite", "implausible", "jumped", "no_orientation", "repeated", "outlier"} <= set(done.refusals)


@pytest.mark.slow
def test_the_same_seed_sends_the_same(small_model: Path) -> None:
    assert fuzz(small_model, 1000, 3) == fuzz(small_model, 1000, 3)


@pytest.mark.slow
def test_what_must_not_happen_is_seen(small_model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    right = Predictor.predict
    last: list[Prediction] = []

    def wrong(self: Predictor, *message: Any) -> Prediction | Refusal:
        outcome = right(self, *message)
        if isinstance(outcome, Prediction):
            last[:] = [outcome]
            return outcome._replace(state=outcome.state * np.nan)
        if outcome is Refusal.REPEATED:
            raise ZeroDivisionError
        return last[0] if last and outcome is Refusal.IMPLAUSIBLE else outcome

    monkeypatch.setattr(Predictor, "predict", wrong)
    assert {"an output is not finite", "predicted from an invalid sample", "ZeroDivisionError raised"} <= set(
        fuzz(small_model, 6000, 0).violations
    )
