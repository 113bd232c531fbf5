"""Evaluation: what models are worth on recordings."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dynssm_ros.api.inputs import Log, PathLike, centre_line, joined, opened, several, vehicle_in_windows
from dynssm_ros.api.settings import MIN_SPEED, CommandsSettings, WorkerSettings, keywords, setting
from dynssm_ros.errors import DataWarning
from dynssm_ros.extras import require
from dynssm_ros.progress import Progress
from dynssm_ros.signals.recording import Recording
from dynssm_ros.vehicle import Vehicle
from dynssm_ros.vehicle.kinematics import PATH_HORIZON_S

if TYPE_CHECKING:
    from dynssm_ros.evaluation.open_loop import Evaluation
    from dynssm_ros.runtime.contract import WindowModel


class EvaluateSettings(CommandsSettings, WorkerSettings):
    """Settings of :func:`evaluate`."""

    holdout: float | None = setting(
        None,
        "Score only this last fraction of each recording, as one block.",
        otherwise="what the models and their cars left out of it, else the whole recording",
        gt=0.0,
        le=1.0,
    )
    min_speed: float | None = MIN_SPEED
    horizon: float = setting(PATH_HORIZON_S, "Length of the rollouts (s).", ge=0.0)
    stride: int = setting(1, "Start a rollout at every n-th row.", ge=1)
    left_to_learn: bool = setting(
        False, "Say what boosted trees still take off the one-step errors of each model; some seconds a model."
    )
    track: Any = setting(
        None,
        "Track along which errors are placed: built-in name or file, in the recording's coordinates.",
        otherwise="the first full lap in the recording",
    )


@keywords(EvaluateSettings)
def evaluate(
    recordings: Log | Sequence[Log],
    models: Sequence[WindowModel | PathLike] | Mapping[str, WindowModel],
    vehicle: Vehicle | PathLike | None = None,
    *,
    settings: EvaluateSettings,
    name: str = "",
    on_progress: Progress | None = None,
) -> Evaluation:
    """Scores models on recordings: one-step errors, rollouts, displacement, coverage, latency.

    Args:
        recordings: to score on, of one car, in the order of driving; online layers learn on from one to the next.
        models: folders, names of baselines, or models.
        vehicle: of the single-track baselines.
        settings: all keywords as one object.
        name: of the recording, for people; that of its file, or its sources, if not given.
        on_progress: called with predictions made.

    Example:
        >>> laps = recorded(simulate("orca", "club", duration=10.0))
        >>> scores = evaluate(laps, ["persistence", "single_track"], "orca").scores
        >>> bool(scores["single_track"].rmse[0] < 1e-9)
        True
    """
    require("evaluate", "race", *(["residuals"] if settings.left_to_learn else []))
    from dynssm_ros.evaluation.open_loop import evaluate, shared_commands
    from dynssm_ros.runtime.registry import open_models, with_offline
    from dynssm_ros.track.lap_position import first_lap

    s, known = settings, models
    if not isinstance(known, Mapping):
        known = open_models(known, None if vehicle is None else vehicle_in_windows(vehicle))
    car = next((model.vehicle for model in known.values() if model.vehicle is not None), None)
    logs = opened(recordings, car)
    log = joined(logs)
    line = first_lap(log) if s.track is None else centre_line(s.track, log)
    shares = [_scored_share(each, known.values(), s.holdout) for each in logs]
    last = [each.split_last(share)[1] for each, share in zip(logs, shares, strict=True)]
    log, split = joined(last, s.commands or shared_commands(known)), _in_words(shares)
    if not name:
        name = ", ".join(Path(each).name for each in several(recordings) if isinstance(each, (str, Path)))
    found = evaluate(
        log, with_offline(known), name=name, split=split, min_speed=s.min_speed, horizon_s=s.horizon, stride=s.stride,
        line=line, progress=on_progress, workers=s.workers,
    )  # fmt: skip
    if s.left_to_learn:
        found = found.with_left_to_learn
    for note in found.not_tests:
        warnings.warn(note, DataWarning, stacklevel=3)
    return found


def _scored_share(recording: Recording, models: Iterable[WindowModel], holdout: float | None) -> float:
    """Share at the end of a recording that is scored: the least that models left out, 1 if none did."""
    if holdout is not None:
        return holdout
    cars = [model.vehicle for model in models if model.vehicle is not None]
    return min((car.held_out[recording.beginning] for car in cars if recording.beginning in car.held_out), default=1.0)


def _in_words(shares: Sequence[float]) -> str:
    words = [f"last {100 * share:.3g} %" if share < 1 else "whole recording" for share in shares]
    if len(set(words)) > 1:
        return f"of the recordings in turn: {'; '.join(words)}"
    one = "the recording" if len(words) == 1 else "each recording"
    return words[0] if shares[0] == 1 else f"{words[0]} of {one}, as one block"
