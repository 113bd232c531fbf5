"""The anatomy of one-step errors: patterns that are more than chance, the largest first, for several models.

In each channel the pattern that explains most is taken off and the rest is looked at again, so that one cause is one pattern
and not one for each signal that goes with it. All tests of a drive together find something where nothing is in at most
:data:`~dynssm_ros.evaluation.residuals.evidence.FALSE_ALARMS` of the drives: by Bonferroni over models and channels, by Holm
within.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.errors import RecordingError
from dynssm_ros.evaluation.metrics import by_channel, rmse
from dynssm_ros.evaluation.open_loop import check_fit, window_and_speed
from dynssm_ros.evaluation.residuals.delays import delays, other_steps
from dynssm_ros.evaluation.residuals.errors import BLOCK_S, OneStepErrors, PhysicsResponse, one_step_errors
from dynssm_ros.evaluation.residuals.evidence import FALSE_ALARMS, FEWEST_BLOCKS, holm
from dynssm_ros.evaluation.residuals.learner import LeftToLearn, learner_patterns, left_to_learn
from dynssm_ros.evaluation.residuals.patterns import Pattern
from dynssm_ros.evaluation.residuals.periods import autocorrelation, periods
from dynssm_ros.evaluation.residuals.regimes import Situation, regimes, situations
from dynssm_ros.evaluation.residuals.sizes import signal_faults, spikes, statistics
from dynssm_ros.runtime.contract import WindowModel
from dynssm_ros.signals.recording import Recording
from dynssm_ros.signals.signal_map import STATE_SIGNALS
from dynssm_ros.track.lap_position import first_lap
from dynssm_ros.track.lines import Line

LEAST_SHARE = 0.005
"""Share of a channel's squared error from which on a pattern is reported: less is a quarter of a percent of the RMSE."""
_MOST = 6  # patterns of a channel
_AS_GOOD = 0.9  # of the largest share, from which on the pattern with the fewest fitted numbers is taken
_NEAR = 0.1  # of a period that was found, within which another is the same one, which came and went
_OF_SIZE = 2  # tests of spikes
_EXACT = 1e-5  # of the increments: errors below are rounding
_AUTOCORRELATION_S = 2.0


@dataclass(frozen=True)
class ModelAnatomy:
    """What the errors of one model consist of.

    Attributes:
        errors: one step ahead.
        patterns: that are more than chance, the largest share first.
        left_to_learn: by channel; empty if it was not asked for or the drive is too short.
        statistics: of the errors by channel.
        autocorrelation: of the errors by channel, for lags of 0 to 2 s.
        tests: how many patterns were looked for.
    """

    errors: OneStepErrors
    patterns: tuple[Pattern, ...]
    left_to_learn: dict[str, LeftToLearn]
    statistics: dict[str, dict[str, float]]
    autocorrelation: dict[str, Vector] = field(repr=False)
    tests: int = 0

    @property
    def rmse(self) -> Vector:
        """One-step RMSE, ``(3,)`` (m/s, m/s, rad/s)."""
        return rmse(self.errors.values)

    def to_json(self) -> dict[str, Any]:
        """For ``results.json``."""
        return {
            "rmse": by_channel(self.rmse),
            "patterns": [pattern.to_json() for pattern in self.patterns],
            "left_to_learn": {channel: each.to_json() for channel, each in self.left_to_learn.items()},
            "statistics": {
                channel: {k: round(v, 9) for k, v in each.items()} for channel, each in self.statistics.items()
            },
        }


@dataclass(frozen=True)
class Anatomy:
    """The anatomy of the errors of several models on the same rows of a recording.

    Attributes:
        name: of the recording, for people.
        recording: that was driven, with the commands in use.
        models: by label.
        false_alarms: chance that anything is reported of a drive without a pattern.
        least_share: of a channel's squared error, from which on a pattern is reported.
    """

    name: str
    recording: Recording
    models: dict[str, ModelAnatomy]
    false_alarms: float = FALSE_ALARMS
    least_share: float = LEAST_SHARE

    def to_json(self) -> dict[str, Any]:
        """``results.json``."""
        first = next(iter(self.models.values()))
        return {
            "recording": self.name,
            "commands": self.recording.info.commands,
            "sampling_time": self.recording.T_s,
            "rows": len(first.errors),
            "false_alarms": self.false_alarms,
            "least_share": self.least_share,
            "models": {label: each.to_json() for label, each in self.models.items()},
        }


def anatomy(
    recording: Recording,
    models: Mapping[str, WindowModel],
    physics: WindowModel | None = None,
    *,
    name: str = "",
    min_speed: float | None = None,
    line: Line | None = None,
    learn: bool = True,
    progress: Callable[[int, int, str], None] | None = None,
) -> Anatomy:
    """Takes the one-step errors of models apart.

    Args:
        recording: with the commands in use.
        models: by the name to show; not empty.
        physics: single-track model of the car, by which delays, steps and rounded signals are judged; or they are not.
        name: of the recording, for people.
        min_speed: stretches below are left out (m/s); if ``None``, the largest ``minimum_speed`` of the models' cars.
        line: closed line along which the place on the lap is counted; the first full lap if ``None``.
        learn: whether boosted trees are asked what can still be learned.
        progress: told of the models done, of all, and of what is being done.

    Raises:
        RecordingError: no usable window.
    """
    for model in models.values():
        check_fit(model, recording)
    H, speed = window_and_speed([*models.values(), *([] if physics is None else [physics])], min_speed)
    rows = recording.window_ends(H, 1, speed)
    if (len(rows) * recording.T_s) < FEWEST_BLOCKS * BLOCK_S:
        raise RecordingError(
            f"recording {name or ', '.join(recording.info.source)}: {len(rows)} steps after a whole window of {H} rows at "
            f"{speed:g} m/s or more; expected {FEWEST_BLOCKS * BLOCK_S:g} s of them, so that chance can be judged"
        )
    line = first_lap(recording) if line is None else line
    found: dict[str, ModelAnatomy] = {}
    response = None if physics is None else PhysicsResponse.of(physics, recording, rows)
    sorted_by: list[Situation] = []
    for k, (label, model) in enumerate(models.items()):
        if progress is not None:
            progress(k, len(models), label)
        wheelbase = None if model.vehicle is None else model.vehicle.constants.wheelbase
        errors = one_step_errors(model, recording, rows, line=line, wheelbase=wheelbase)
        sorted_by = sorted_by or situations(errors)
        found[label] = model_anatomy(errors, sorted_by, response, learn=learn, models=len(models))
    return Anatomy(name or ", ".join(recording.info.source), recording, found)


def model_anatomy(
    errors: OneStepErrors,
    sorted_by: Sequence[Situation],
    physics: PhysicsResponse | None = None,
    *,
    learn: bool = True,
    models: int = 1,
) -> ModelAnatomy:
    """Takes the errors of one model apart; see :func:`anatomy`.

    Where the data clearly ask for another integrator this is the first pattern, and the others are of errors with it.

    Args:
        errors: of the model.
        sorted_by: the quantities of :func:`situations`.
        physics: how its predictions would change; without it delays, steps and rounded signals are not judged.
        learn: whether boosted trees are asked.
        models: that are looked at together, among which the chance of a false alarm is shared.
    """
    slopes = None if physics is None else physics.slopes
    level = FALSE_ALARMS / (models * len(STATE_SIGNALS))
    if physics is not None and (steps := other_steps(errors, physics, level / len(STATE_SIGNALS))) is not None:
        assert physics.otherwise is not None
        closer = replace(errors, values=errors.values + physics.otherwise)
        rest = model_anatomy(closer, sorted_by, PhysicsResponse(physics.slopes), learn=learn, models=models)
        return replace(rest, patterns=(steps, *rest.patterns))
    learned = left_to_learn(errors) if learn else {}
    by_learner = learner_patterns(learned)
    faults = list(signal_faults(errors, slopes))
    scale = np.maximum(rmse(np.diff(errors.recording.states(errors.rows), axis=0)), 1e-300)
    patterns: list[Pattern] = []
    tests = 0
    for c, channel in enumerate(STATE_SIGNALS):
        if rmse(errors.values[:, c, None])[0] < _EXACT * scale[c]:
            continue
        beside = [each for each in (*faults, *by_learner) if each.channel == channel]
        fitted, values, most = _fitted(errors, c, sorted_by, physics, level=level, others=len(beside) + _OF_SIZE)
        tests = max(tests, most)
        left = float(np.sum(values**2) / np.sum(errors.values[:, c] ** 2))
        of_size = list(spikes(errors, values, c, slopes))
        patterns += [*fitted, *_beyond_chance(of_size, level, left, tests), *_beyond_chance(beside, level, 1.0, tests)]
    lags = round(_AUTOCORRELATION_S / errors.T_s)
    return ModelAnatomy(
        errors,
        tuple(sorted(patterns, key=lambda each: -each.share)),
        learned,
        {channel: statistics(errors.values[:, c]) for c, channel in enumerate(STATE_SIGNALS)},
        {channel: autocorrelation(errors.values[:, c], errors.run, lags) for c, channel in enumerate(STATE_SIGNALS)},
        tests,
    )


def _fitted(
    errors: OneStepErrors,
    c: int,
    sorted_by: Sequence[Situation],
    physics: PhysicsResponse | None,
    *,
    level: float,
    others: int,
) -> tuple[list[Pattern], Vector, int]:
    """Patterns of a channel that are fitted one after the other, the largest first; what they leave, and most tests at once.

    Args:
        errors: of the model.
        c: number of the channel.
        sorted_by: the quantities of :func:`situations`.
        physics: how its predictions would change, if that is known.
        level: chance of a false alarm among all tests of the channel.
        others: tests that are made beside.
    """
    values = errors.values[:, c].copy()
    total = float(np.sum(values**2))
    found: list[Pattern] = []
    tests = 0
    for _ in range(_MOST):
        looked = list(_tried(errors, values, c, sorted_by, physics))
        tests = max(tests, len(looked) + others)
        sure = _beyond_chance(looked, level, float(np.sum(values**2)) / total, others)
        sure = [each for each in sure if not any(_same_period(each, other) for other in found)]
        if not sure:
            break
        most = max(each.share for each in sure)
        best = min((each for each in sure if each.share >= _AS_GOOD * most), key=lambda each: each.terms)
        found.append(best)
        if best.fitted is not None:
            values -= best.fitted
    return found, values, tests


def _same_period(one: Pattern, other: Pattern) -> bool:
    """Whether both come back after about the same time, or about the same way."""
    both = [key for key in ("period_s", "period_m") if key in one.size and key in other.size]
    return any(bool(np.isclose(one.size[key], other.size[key], _NEAR, 0.0)) for key in both)


def _beyond_chance(looked: Sequence[Pattern], level: float, left: float, others: int) -> list[Pattern]:
    """Patterns that are sure and large enough, with their shares of all that the channel errs.

    Args:
        looked: what was looked for.
        level: chance of a false alarm among all tests of the channel.
        left: share of the channel's squared error in which they were looked for.
        others: tests of the channel that are not among them.
    """
    sure = holm([*(each.p for each in looked), *[1.0] * others], level)
    found = [replace(each, share=left * each.share) for each, yes in zip(looked, sure, strict=False) if yes]
    return [each for each in found if each.share >= LEAST_SHARE]


def _tried(
    errors: OneStepErrors, values: Vector, channel: int, sorted_by: Sequence[Situation], physics: PhysicsResponse | None
) -> Iterator[Pattern]:
    name = STATE_SIGNALS[channel]
    yield from periods(errors, values, name)
    yield from regimes(errors, values, name, list(sorted_by))
    if physics is not None:
        yield from delays(errors, values, channel, physics.slopes)
