"""Scoring models on a recording: the same rows for all of them, one step ahead and over a horizon."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from pydantic import Field

from dynssm_ros.arrays import Indices, Vector
from dynssm_ros.configuration import StrictModel
from dynssm_ros.errors import ArtifactError, RecordingError
from dynssm_ros.evaluation.coefficients import CoefficientTally
from dynssm_ros.evaluation.metrics import (
    Tick,
    by_channel,
    coverage,
    drive_through,
    explained,
    finite,
    latency_us,
    predict_rows,
    rmse,
    silent,
)
from dynssm_ros.evaluation.regimes import Regime, driving_regimes, liveliest, regime_rmse
from dynssm_ros.evaluation.residuals.errors import OneStepErrors
from dynssm_ros.evaluation.residuals.learner import LeftToLearn, left_to_learn
from dynssm_ros.evaluation.rollout import Rollout, score_rollouts
from dynssm_ros.evaluation.score import Group, Score, grouped
from dynssm_ros.parallel import HERE, Workers, each
from dynssm_ros.runtime.contract import WindowModel, WindowPrediction
from dynssm_ros.runtime.online import Learned
from dynssm_ros.signals.recording import Recording
from dynssm_ros.signals.signal_map import STATE_SIGNALS, Commands
from dynssm_ros.track.lap_position import first_lap
from dynssm_ros.track.lines import Line
from dynssm_ros.vehicle import Vehicle
from dynssm_ros.vehicle.kinematics import PATH_HORIZON_S

_DRAWN_S = 12.0  # of the drive that trajectories are drawn of
_COEFFICIENT_ROWS = 20_000  # of which coefficients are kept to be drawn, 17 numbers each; twice that is the most


@dataclass(frozen=True)
class Evaluation:
    """Scores of several models on the same rows of a recording.

    Attributes:
        recording: what was scored on, after selection and with the commands in use.
        name: of the recording, for people; so is ``split``, the part of it that was scored.
        min_speed: slower stretches were left out (m/s).
        rows: last row of each window; the predicted rows are ``rows + 1``.
        drawn: rows where rollouts start that are drawn: one after the other, in the liveliest seconds.
        regimes: how these rows were driven.
        scores: by label, in the order in which the models were given.
        line: closed line that the position on the lap is counted along, if there is one.
        left: by group, what a strong learner still takes off the errors of its first model, by channel; empty if not asked.
    """

    recording: Recording
    name: str
    split: str
    min_speed: float
    rows: Indices
    drawn: Indices
    regimes: tuple[Regime, ...]
    scores: dict[str, Score]
    line: Line | None
    left: dict[str, dict[str, LeftToLearn]] = field(default_factory=dict)

    @property
    def with_left_to_learn(self) -> Evaluation:
        """The same with :attr:`left`, by boosted trees; a model that diverges, or a short drive, has none."""
        found = {}
        for name, group in self.groups.items():
            errors = OneStepErrors(name, self.recording, self.rows, group.first.state - self.measured)
            found[name] = left_to_learn(errors, importance=False) if np.isfinite(errors.values).all() else {}
        return replace(self, left=found)

    @property
    def groups(self) -> dict[str, Group]:
        """The scores, those of one model with several seeds joined."""
        return grouped(self.scores)

    @cached_property
    def not_tests(self) -> list[str]:
        """A sentence for each model that, or whose car, was fitted to a third or more of what it is scored on, and one on
        rows that were interpolated.
        """
        laps, found = set(self.recording.fingerprints), []
        for name, group in self.groups.items():
            card, vehicle = group.first.model.card, group.first.model.vehicle
            before = None if vehicle is None else vehicle.before
            known = {"was trained": card.laps if card else (), "has a car calibrated": before.laps if before else ()}
            shares = {how: len(laps & {*theirs}) / len(laps) for how, theirs in known.items()}
            how = " and ".join(f"{how} on {100 * share:.0f} %" for how, share in shares.items() if 3 * share >= 1)
            if how:
                found.append(f"{name} {how} of what it is scored on: expected other laps, or those that were held out")
        between = {name: share for name, share in self.recording.info.interpolated.items() if name in STATE_SIGNALS}
        if between:
            told = ", ".join(f"{100 * share:.0f} % of {name}" for name, share in between.items())
            found.append(f"{told} lies between slower samples: expected a recording at their rate (see its notes)")
        return found

    @property
    def steps(self) -> int:
        """Length of the rollouts in steps."""
        return len(self._rollout.time)

    @property
    def every(self) -> int:
        """Coefficients are kept of every so-many-th of :attr:`rows`."""
        return max(1, len(self.rows) // _COEFFICIENT_ROWS)

    @property
    def current(self) -> Vector:
        """Measured states of :attr:`rows`, shape ``(N, 3)``."""
        return self.recording.states(self.rows)

    @property
    def measured(self) -> Vector:
        """Measured states of the predicted rows, shape ``(N, 3)``."""
        return self.recording.states(self.rows + 1)

    @property
    def persistence_rmse(self) -> Vector:
        """RMSE of the prediction that nothing changes: the RMS of the increments, shape ``(3,)``."""
        return rmse(self.measured - self.current)

    @property
    def horizon_s(self) -> float:
        """Length of the rollouts (s)."""
        return float(self._rollout.time[-1])

    @property
    def starts(self) -> int:
        """Number of rollouts."""
        return self._rollout.starts

    @property
    def _rollout(self) -> Rollout:
        return next(iter(self.scores.values())).rollout

    def to_json(self) -> dict[str, Any]:
        """``results.json``: the contract's fields, and more."""
        return {
            "recording": self.name,
            "commands": self.recording.info.commands,
            "horizon_s": round(self.horizon_s, 9),
            "models": {name: group.to_json(self.regimes) for name, group in self.groups.items()},
            "split": self.split,
            "sampling_time": self.recording.T_s,
            "min_speed": finite(self.min_speed),
            "rows": len(self.rows),
            "starts": self.starts,
            "persistence_rmse": by_channel(self.persistence_rmse),
            "not_tests": self.not_tests,
            "left_to_learn": {
                name: {channel: each.to_json() for channel, each in found.items()} for name, found in self.left.items()
            },
            "findings": [finding.model_dump() for finding in self.recording.info.findings],
        }


class Accuracy(StrictModel, allow_inf_nan=True):
    """Of a model on a recording, in short."""

    ade: float = Field(description="mean distance of rollouts from the measured path (m)")
    rmse: tuple[float, float, float] = Field(description="of one step: v_x, v_y (m/s), omega (rad/s)")


def accuracies(recording: Recording, models: Mapping[str, WindowModel]) -> dict[str, Accuracy]:
    """Displacement and one-step errors alone, with a rollout from every fifth row."""
    scores = evaluate(recording, models, stride=5, calls=1).scores
    return {name: Accuracy(ade=score.rollout.ade, rmse=tuple(score.rmse)) for name, score in scores.items()}


def evaluate(
    recording: Recording,
    models: Mapping[str, WindowModel],
    *,
    name: str = "",
    split: str = "whole recording",
    min_speed: float | None = None,
    horizon_s: float = PATH_HORIZON_S,
    stride: int = 1,
    calls: int = 200,
    line: Line | None = None,
    progress: Callable[[int, int], None] | None = None,
    workers: Workers = HERE,
) -> Evaluation:
    """Scores ``models`` on ``recording``.

    Args:
        recording: with the commands in use.
        models: by the name to show; not empty.
        name: of the recording, for people; its sources if empty.
        split: which part of it this is, for people.
        min_speed: stretches below are left out (m/s); if ``None``, the largest ``minimum_speed`` of the models' cars.
        horizon_s: length of the rollouts (s).
        stride: a rollout starts at every ``stride``-th usable row.
        calls: single predictions timed per model.
        line: closed line that the position on the lap is counted along; the recording's first full lap if ``None``.
        progress: told of the predictions done and all that will be made; with several workers once for each model.
        workers: where models are scored; their latency is taken here, one after the other.

    Raises:
        ArtifactError: a model is for another sampling time or command protocol.
        RecordingError: the recording holds no usable window.
    """
    for model in models.values():
        check_fit(model, recording)
    steps = horizon_steps(horizon_s, recording.T_s)
    H, speed = window_and_speed(models.values(), min_speed)
    rows = recording.window_ends(H, 1, speed)
    name = name or ", ".join(recording.info.source)
    starts = _rollout_starts(recording, H, steps, speed, told=f"{name} ({split})")[::stride]
    regimes = driving_regimes(recording.rows(rows), recording.info.set_point)
    drawn = _drawn_starts(recording, rows, steps)
    score_of = partial(_score, recording=recording, rows=rows, regimes=regimes, starts=starts, drawn=drawn, steps=steps)
    found = _scored(models, score_of, len(rows) + len(starts) * steps, progress, workers)
    scores = {
        label: replace(found[label], latency_us=latency_us(model, recording.windows(rows[:50], model.H), calls))
        for label, model in models.items()
    }
    return Evaluation(
        recording=recording,
        name=name,
        split=split,
        min_speed=speed,
        rows=rows,
        drawn=drawn,
        regimes=regimes,
        scores=scores,
        line=first_lap(recording) if line is None else line,
    )


def _rollout_starts(recording: Recording, H: int, steps: int, speed: float, *, told: str) -> Indices:
    """Rows after which rollouts of ``steps`` can start.

    Raises:
        RecordingError: there is none; the recording goes by what is ``told`` of it.
    """
    starts = recording.window_ends(H, steps, speed)
    if len(starts) == 0:
        raise RecordingError(
            f"recording {told}: no stretch of {H + steps} rows (window {H}, horizon {steps}) without a gap at {speed:g} m/s "
            f"or more among its {len(recording)} rows"
        )
    return starts


def _drawn_starts(recording: Recording, rows: Indices, steps: int) -> Indices:
    """Rows from which the rollouts start that figures show, one after the other where most happens."""
    time = (recording.time[rows + 1] - recording.time[0]) / 1e9
    lively = rows[liveliest(time, recording.states(rows + 1), max(_DRAWN_S, steps * recording.T_s))]
    return lively[: len(lively) - steps + 1 : steps]


def _scored(
    models: Mapping[str, WindowModel],
    score_of: partial[Score],
    predictions: int,
    progress: Callable[[int, int], None] | None,
    workers: Workers,
) -> dict[str, Score]:
    """The scores of the models, each of which makes ``predictions``; ``progress`` as of :func:`evaluate`."""
    done = 0

    def tick(made: int) -> None:
        nonlocal done
        done += made
        if progress is not None:
            progress(done, len(models) * predictions)

    labels = list(models)
    found: dict[str, Score] = {}
    task = score_of if workers.elsewhere else partial(score_of, tick=tick)
    for k, score in each(task, list(models.values()), workers):
        found[labels[k]] = replace(score, model=models[labels[k]])
        if workers.elsewhere:
            tick(predictions)
    return found


def _score(
    model: WindowModel,
    *,
    recording: Recording,
    rows: Indices,
    regimes: tuple[Regime, ...],
    starts: Indices,
    drawn: Indices,
    steps: int,
    tick: Tick = silent,
) -> Score:
    """What a model is worth, but for the time that it takes; see :func:`evaluate`."""
    measured = recording.states(rows + 1)
    with np.errstate(over="ignore", invalid="ignore"):  # a model that diverges is a result: null, not a warning
        predicted, rollouts, knowledge = _OneStep(model.vehicle, measured), [], []
        for drive, (ends, begins, shown) in drive_through(model, recording, (rows, starts, drawn)):
            for prediction in predict_rows(model, recording, ends, tick=tick, drive=drive):
                predicted.add(prediction)
            if len(begins):
                part = score_rollouts(model, recording, begins, steps, tick=tick, drive=drive)
                rollouts.append(part)
            if drive is not None:
                knowledge.append(drive.at(shown))
        errors = predicted.state - measured
        increments = measured - recording.states(rows)
        return Score(
            model=model,
            known=Learned.joined(knowledge) if knowledge else None,
            state=predicted.state,
            theta=predicted.theta,
            rmse=rmse(errors),
            max_error=np.abs(errors).max(axis=0),
            explained=explained(increments, increments + errors),
            coverage_90=predicted.coverage,
            regime_rmse=regime_rmse(regimes, errors),
            coefficients=predicted.coefficients.statistics,
            rollout=Rollout.joined(rollouts),
            latency_us=np.empty(0),
        )


class _OneStep:
    """One-step predictions that come batch by batch; the state alone is kept of every row.

    Args:
        vehicle: of the model, if it has one.
        measured: states of the predicted rows, shape ``(N, 3)``.
    """

    def __init__(self, vehicle: Vehicle | None, measured: Vector):
        self._measured, self._every = measured, max(1, len(measured) // _COEFFICIENT_ROWS)
        self._rows = 0
        self._thetas: list[Vector] = []
        self._inside: list[Vector] = []  # errors of each batch that are inside the stated interval, ``(3,)``
        self.state = np.empty_like(measured)
        self.coefficients = CoefficientTally(vehicle)

    def add(self, prediction: WindowPrediction) -> None:
        """Takes the predictions of the next rows in."""
        rows = slice(self._rows, self._rows + len(prediction.state))
        self.state[rows] = prediction.state
        if prediction.theta is not None:
            self._thetas.append(prediction.theta[-rows.start % self._every :: self._every].copy())
            self.coefficients.add(prediction.theta)
        if prediction.variance is not None:
            share = coverage(prediction.state - self._measured[rows], prediction.variance)
            self._inside.append(len(prediction.state) * share)
        self._rows = rows.stop

    @property
    def theta(self) -> Vector | None:
        """Coefficients of the rows of which they are kept, shape ``(M, 17)``; ``None`` if the model has none."""
        return np.concatenate(self._thetas) if self._thetas else None

    @property
    def coverage(self) -> Vector | None:
        """Share of errors inside the stated 90 % interval, shape ``(3,)``; ``None`` if the model states no variances."""
        return np.sum(self._inside, axis=0) / self._rows if self._inside else None


def window_and_speed(models: Iterable[WindowModel], min_speed: float | None) -> tuple[int, float]:
    """Rows that the longest window of ``models`` has, and the speed (m/s) below which they are not scored."""
    together = list(models)
    speeds = [model.vehicle.minimum_speed for model in together if model.vehicle is not None]
    return max(model.H for model in together), max(speeds, default=0.0) if min_speed is None else min_speed


def horizon_steps(horizon_s: float, T_s: float) -> int:
    """Number of steps in a horizon of ``horizon_s`` seconds, at least one."""
    return max(1, round(horizon_s / T_s))


def shared_commands(models: Mapping[str, WindowModel]) -> Commands | None:
    """The command protocol that the models were trained with; ``None`` if any will do.

    Different ones are an :class:`ArtifactError`.
    """
    trained = {label: model.commands for label, model in models.items() if model.commands is not None}
    if len(set(trained.values())) > 1:
        listed = ", ".join(f"{label}: {commands}" for label, commands in trained.items())
        raise ArtifactError(f"models trained with different commands ({listed}); expected the same for one evaluation")
    return next(iter(trained.values()), None)


def check_fit(model: WindowModel, recording: Recording) -> None:
    """Raises an :class:`ArtifactError` if a model is for another sampling time or command protocol than a recording's."""
    where = f"model {model.name} on recording {', '.join(recording.info.source)}"
    if model.T_s > 0 and not math.isclose(model.T_s, recording.T_s, rel_tol=1e-3):
        raise ArtifactError(
            f"{where}: sampling time {recording.T_s:g} s, but the model is for {model.T_s:g} s; "
            f"extract the bag at {1 / model.T_s:g} Hz"
        )
    if model.commands not in (None, recording.info.commands):
        raise ArtifactError(
            f"{where}: commands '{recording.info.commands}', but the model was trained with '{model.commands}'"
        )
