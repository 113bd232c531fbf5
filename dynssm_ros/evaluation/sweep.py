"""Sweeps: models trained with other settings and scored on laps that were left out, by Optuna.

A space names fields of a model file and what they may be. Settings are chosen by a tree-structured Parzen estimator, always
:data:`WAVE` at a time, so that several processes find what one finds. The state of a sweep is a file of Optuna's, and each
choice depends on that and the seed alone: what was interrupted goes on as if it had not been.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import optuna
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, IntDistribution
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import FrozenTrial, TrialState
from pydantic import Field, model_validator
from typing_extensions import Self

from dynssm_ros import configuration
from dynssm_ros.configuration import StrictModel
from dynssm_ros.errors import ConfigurationError, UserError
from dynssm_ros.evaluation.open_loop import Accuracy
from dynssm_ros.parallel import HERE, Workers, each
from dynssm_ros.progress import Progress

WAVE = 4
_STATE = "sweep.journal"
_RMSE, _FAILURE = "one_step_rmse", "failure"


class Choice(StrictModel):
    """What a field may be: a range, or values."""

    low: float | None = None
    high: float | None = None
    log: bool = Field(default=False, description="even on a logarithmic scale")
    step: float | None = Field(default=None, gt=0)
    values: tuple[bool | int | float | str, ...] = ()

    @model_validator(mode="after")
    def _is_one_of_both(self) -> Self:
        if bool(self.values) == (self.low is not None and self.high is not None):
            raise ValueError("expected either low and high, or values")
        if self.low is not None and self.high is not None and not self.low < self.high:
            raise ValueError(f"low {self.low:g}, high {self.high:g}: expected low < high")
        return self

    def contains(self, value: Any) -> bool:
        """Whether the field may be that."""
        if self.low is None or self.high is None:
            return value in self.values
        return isinstance(value, (int, float)) and self.low <= value <= self.high

    def distribution(self, own: Any) -> BaseDistribution:
        """For Optuna; whole numbers if the field's ``own`` value is one."""
        if self.low is None or self.high is None:
            return CategoricalDistribution(self.values)
        if isinstance(own, int):
            return IntDistribution(round(self.low), round(self.high), self.log, round(self.step or 1))
        return FloatDistribution(self.low, self.high, self.log, self.step)


class Space(StrictModel):
    """Fields of a model file, by dotted name, and what they may be."""

    choices: dict[str, Choice] = Field(min_length=1)

    @classmethod
    def load(cls, name_or_path: str | Path) -> Space:
        """Reads it from a file of ``config/sweeps`` or a path."""
        path = configuration.find_config("sweeps", name_or_path)
        return configuration.validate(cls, {"choices": configuration.read_yaml(path)}, path)


class Trial(NamedTuple):
    """Settings, and what became of them: the displacement is minimised."""

    number: int
    settings: dict[str, Any]
    errors: Accuracy | None
    failure: str


Objective = Callable[[int, Mapping[str, Any]], Accuracy]


class Sweep:
    """The state of a sweep in a folder.

    The ``own`` values of the model file are tried first. When the sweep goes on, all must be the same, and what it is
    ``about``. A :class:`ConfigurationError` says that it is another one, or that own values are not in the space.
    """

    def __init__(
        self, folder: Path, space: Space, own: Mapping[str, Any], seed: int = 0, about: Mapping[str, Any] | None = None
    ) -> None:
        self.seed = seed
        self.distributions = {name: choice.distribution(own[name]) for name, choice in space.choices.items()}
        for name, choice in space.choices.items():
            if not choice.contains(own[name]):
                raise ConfigurationError(
                    f"{name}: {own[name]} of the model file is not in the space; expected it there"
                )
        optuna.logging.set_verbosity(logging.WARNING)
        folder.mkdir(parents=True, exist_ok=True)
        storage = JournalStorage(JournalFileBackend(str(folder / _STATE)))
        self.study = optuna.create_study(storage=storage, study_name="sweep", load_if_exists=True)
        now = {"space": space.model_dump(mode="json"), "own": dict(own), "seed": seed, **(about or {})}
        before = self.study.user_attrs.get("about", now)
        other = next((name for name in now if now[name] != before.get(name)), None)
        if other is not None:
            raise ConfigurationError(f"{folder}: its trials have another {other}; expected the same, or another folder")
        self.study.set_user_attr("about", now)
        if not self.study.trials:
            self.study.enqueue_trial(dict(own))

    @property
    def trials(self) -> list[Trial]:
        """Those that are done, in the order in which they were chosen."""
        return [_trial(each) for each in self.study.trials if each.state in (TrialState.COMPLETE, TrialState.FAIL)]

    @property
    def best(self) -> Trial:
        """The one of the smallest displacement; a :class:`UserError` if all failed."""
        scored = [(trial.errors.ade, trial) for trial in self.trials if trial.errors is not None]
        if not scored:
            raise UserError(
                f"none of {len(self.trials)} trials has a score; the first ended with: {self.trials[0].failure}"
            )
        return min(scored, key=lambda each: each[0])[1]

    def to_json(self) -> dict[str, Any]:
        """The trials for programs."""
        trials = [trial._asdict() for trial in self.trials]
        for trial in trials:
            errors = trial.pop("errors")
            trial |= {"ade": errors and errors.ade, "one_step_rmse": errors and errors.rmse}
        return {"best": self.best.number, "trials": trials}

    def run(self, objective: Objective, count: int, workers: Workers = HERE, progress: Progress | None = None) -> None:
        """Goes on until there are ``count`` trials; a :class:`UserError` of the ``objective`` is a failed one."""
        while True:
            self._ask(count)
            open_ones = self.study.get_trials(states=[TrialState.RUNNING])
            if not open_ones:
                return
            tasks = [(objective, trial.number, trial.params) for trial in open_ones]
            for k, outcome in each(_outcome, tasks, workers):
                self._tell(open_ones[k], outcome)
                if progress is not None:
                    progress(len(self.trials), count)

    def _ask(self, count: int) -> None:
        """Chooses settings until a wave is complete, unless one is under way."""
        while (asked := len(self.study.get_trials(states=_CHOSEN))) < count:
            if asked % WAVE == 0 and self.study.get_trials(states=[TrialState.RUNNING]):
                return
            self.study.sampler = optuna.samplers.TPESampler(
                seed=1000 * self.seed + asked, n_startup_trials=2 * WAVE, constant_liar=True
            )
            self.study.ask(self.distributions)

    def _tell(self, trial: FrozenTrial, outcome: Accuracy | str) -> None:
        live = optuna.Trial(self.study, trial._trial_id)
        if isinstance(outcome, str):
            live.set_user_attr(_FAILURE, outcome)
            self.study.tell(trial.number, state=TrialState.FAIL)
        else:
            live.set_user_attr(_RMSE, list(outcome.rmse))
            self.study.tell(trial.number, outcome.ade)


_CHOSEN = (TrialState.RUNNING, TrialState.COMPLETE, TrialState.FAIL)


def _outcome(task: tuple[Objective, int, dict[str, Any]]) -> Accuracy | str:
    objective, number, settings = task
    try:
        return objective(number, settings)
    except UserError as error:
        return str(error)


def _trial(found: FrozenTrial) -> Trial:
    errors = None
    if found.state == TrialState.COMPLETE:
        assert found.value is not None
        errors = Accuracy(ade=found.value, rmse=tuple(found.user_attrs[_RMSE]))
    return Trial(found.number, dict(found.params), errors, found.user_attrs.get(_FAILURE, ""))
