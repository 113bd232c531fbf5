"""Sweeps: the best is found, what was interrupted goes on, and several processes find what one finds."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from dynssm_ros.errors import ConfigurationError, UserError
from dynssm_ros.evaluation.open_loop import Accuracy
from dynssm_ros.evaluation.sweep import WAVE, Space, Sweep, Trial
from dynssm_ros.parallel import Workers

SPACE = Space.model_validate(
    {
        "choices": {
            "rate": {"low": 1e-4, "high": 1.0, "log": True},
            "width": {"low": 1, "high": 64},
            "kind": {"values": ["a", "b"]},
        }
    }
)
OWN = {"rate": 0.5, "width": 60, "kind": "b"}


def bowl(number: int, settings: Mapping[str, Any]) -> Accuracy:
    """Least at a rate of 0.01, a width of 20 and kind a; widths above 62 fail."""
    if settings["width"] > 62:
        raise UserError("too wide")
    off = abs(settings["rate"] - 0.01) / 0.01 + abs(settings["width"] - 20) / 20 + (settings["kind"] != "a")
    return Accuracy(ade=0.1 + off, rmse=(off, off, off))


def test_the_best_is_found_beginning_with_the_file_as_it_is(tmp_path: Path) -> None:
    sweep = Sweep(tmp_path, SPACE, OWN)
    sweep.run(bowl, 60)
    assert len(sweep.trials) == 60
    assert sweep.trials[0].settings == OWN
    assert sweep.best.settings["kind"] == "a"
    assert sweep.best.errors is not None
    assert sweep.trials[0].errors is not None
    assert sweep.best.errors.ade < 0.02 * sweep.trials[0].errors.ade


def test_what_was_interrupted_finds_the_same_and_done_trials_are_not_done_again(tmp_path: Path) -> None:
    whole = Sweep(tmp_path / "whole", SPACE, OWN)
    whole.run(bowl, 3 * WAVE)
    done: list[int] = []

    def stopping(number: int, settings: Mapping[str, Any]) -> Accuracy:
        if len(done) == WAVE + 2:
            raise KeyboardInterrupt
        done.append(number)
        return bowl(number, settings)

    with pytest.raises(KeyboardInterrupt):
        Sweep(tmp_path / "cut", SPACE, OWN).run(stopping, 3 * WAVE)
    cut = Sweep(tmp_path / "cut", SPACE, OWN)
    assert [trial.number for trial in cut.trials] == done
    later: list[int] = []

    def counting(number: int, settings: Mapping[str, Any]) -> Accuracy:
        later.append(number)
        return bowl(number, settings)

    cut.run(counting, 3 * WAVE)
    assert sorted([*done, *later]) == list(range(3 * WAVE))
    assert cut.trials == whole.trials


def test_more_trials_go_on_from_those_that_are_there(tmp_path: Path) -> None:
    Sweep(tmp_path / "bit", SPACE, OWN).run(bowl, WAVE)
    bit = Sweep(tmp_path / "bit", SPACE, OWN)
    bit.run(bowl, 2 * WAVE)
    whole = Sweep(tmp_path / "whole", SPACE, OWN)
    whole.run(bowl, 2 * WAVE)
    assert bit.trials == whole.trials


@pytest.mark.slow
def test_several_processes_find_what_one_finds(tmp_path: Path) -> None:
    found: list[list[Trial]] = []
    for name, workers in (("one", Workers()), ("two", Workers(2))):
        sweep = Sweep(tmp_path / name, SPACE, OWN)

        def objective(number: int, settings: Mapping[str, Any]) -> Accuracy:  # the module's own has no name elsewhere
            return Accuracy(ade=settings["rate"], rmse=(0.0, 0.0, 0.0))

        sweep.run(objective, 2 * WAVE, workers)
        found.append(sweep.trials)
    assert found[0] == found[1]


def test_a_trial_that_fails_is_listed_with_its_reason(tmp_path: Path) -> None:
    sweep = Sweep(tmp_path, SPACE, OWN)
    counted = itertools.count()

    def failing(number: int, settings: Mapping[str, Any]) -> Accuracy:
        if next(counted) == 1:
            raise UserError("no better than the mean")
        return bowl(number, settings | {"width": 20})

    sweep.run(failing, WAVE)
    assert [trial.failure for trial in sweep.trials] == ["", "no better than the mean", "", ""]
    lost = Sweep(tmp_path / "lost", SPACE, OWN | {"width": 63})
    lost.run(bowl, 1)
    with pytest.raises(UserError, match="none of 1 trials has a score; the first ended with: too wide"):
        _ = lost.best


@pytest.mark.parametrize(
    ("own", "reason"),
    [({"rate": 2.0}, "rate: 2.0 of the model file is not in the space"), ({"kind": "c"}, "kind: c of the model file")],
)
def test_the_files_own_values_are_in_the_space(tmp_path: Path, own: dict[str, Any], reason: str) -> None:
    with pytest.raises(ConfigurationError, match=reason):
        Sweep(tmp_path, SPACE, OWN | own)


def test_trials_of_another_sweep_are_not_mixed_in(tmp_path: Path) -> None:
    Sweep(tmp_path, SPACE, OWN, about={"model": "dynssm"}).run(bowl, 1)
    with pytest.raises(ConfigurationError, match="its trials have another model; expected the same"):
        Sweep(tmp_path, SPACE, OWN, about={"model": "rls"})
    with pytest.raises(ConfigurationError, match="its trials have another seed"):
        Sweep(tmp_path, SPACE, OWN, seed=1, about={"model": "dynssm"})


@pytest.mark.parametrize(
    ("choice", "reason"),
    [
        ({}, "expected either low and high, or values"),
        ({"low": 1.0, "high": 2.0, "values": [1]}, "expected either"),
        ({"low": 2.0, "high": 1.0}, "expected low < high"),
    ],
)
def test_a_choice_is_a_range_or_values(tmp_path: Path, choice: dict[str, Any], reason: str) -> None:
    file = tmp_path / "space.yaml"
    file.write_text(f"training.learning_rate: {choice}")
    with pytest.raises(ConfigurationError, match=reason):
        Space.load(file)
