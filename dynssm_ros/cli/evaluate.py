"""``dynssm evaluate``: models on a recording, one step ahead and over a horizon."""

from __future__ import annotations

from operator import attrgetter
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from dynssm_ros.cli.console import (
    CommandsOption,
    JsonOption,
    MinSpeedOption,
    console,
    progress_bar,
    told_apart,
    write_results,
)
from dynssm_ros.errors import ConfigurationError
from dynssm_ros.evaluation.open_loop import Evaluation, shared_commands
from dynssm_ros.evaluation.open_loop import evaluate as evaluate_models
from dynssm_ros.files import replacing
from dynssm_ros.reporting.evaluation_report import markdown, open_loop_report, summary_table, verdict
from dynssm_ros.reporting.tables import percent
from dynssm_ros.runtime.models import WindowModel, load_model
from dynssm_ros.signals.recording import Recording
from dynssm_ros.signals.signal_map import Commands
from dynssm_ros.track.lap_position import first_lap
from dynssm_ros.track.lines import ClosedLine
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import Vehicle, load_vehicle

TrackOption = Annotated[
    str | None,
    typer.Option(
        help="Track along which errors are placed: built-in name or file, in the recording's coordinates.",
        show_default="the first full lap in the recording",
    ),
]


def evaluate(
    recording: Annotated[Path, typer.Argument(help="Recording to score on (Parquet).", metavar="R.parquet")],
    model: Annotated[
        list[str],
        typer.Option(
            help="Model folder, persistence, single_track or single_track_ewma (need --vehicle); repeat to compare.",
            metavar="NAME_OR_DIR",
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder for report.html, results.json and results.md.", file_okay=False)],
    vehicle: Annotated[
        str | None, typer.Option(help="Vehicle of single_track: name of a shipped one (orca, av21, ...) or a file.")
    ] = None,
    holdout: Annotated[
        float | None, typer.Option(help="Score only this last fraction of the recording, as one block.", max=1.0)
    ] = None,
    commands: CommandsOption = None,
    min_speed: MinSpeedOption = None,
    horizon: Annotated[
        float | None,
        typer.Option(help="Length of the rollouts (s).", show_default="0.3 up to T_s = 0.02 s, else 0.6", min=0.0),
    ] = None,
    stride: Annotated[int, typer.Option(help="Start a rollout at every n-th row.", min=1)] = 1,
    track: TrackOption = None,
    json: JsonOption = None,
) -> None:
    """Score models on a recording: one-step errors, rollouts, displacement, latency; with an HTML report.

    Folders of one model that was trained with several seeds become one row: mean and standard deviation.
    """
    log = Recording.load(recording)
    car = None if vehicle is None else load_vehicle(vehicle)
    models = _load_models(model, car)
    line = first_lap(log) if track is None else _centre_line(track, log)
    log, split = _hold_out(_with_commands(log, commands, models), holdout)
    with progress_bar("evaluating") as progress:
        evaluation = evaluate_models(
            log,
            models,
            name=recording.name,
            split=split,
            min_speed=min_speed,
            horizon_s=horizon,
            stride=stride,
            line=line,
            progress=progress,
        )
    _write(evaluation, out, json)
    console.print(summary_table(evaluation).brief.rich())
    console.print(verdict(evaluation), markup=False, soft_wrap=True)
    console.print(f"{out / 'report.html'}: figures and how to read them", markup=False, soft_wrap=True)


def _write(evaluation: Evaluation, out: Path, json: Path | None) -> None:
    """Writes the report, then what programs read."""
    open_loop_report(evaluation).save(out / "report.html")
    with replacing(out / "results.md") as aside:
        aside.write_text(markdown(evaluation), encoding="utf-8")
    write_results(evaluation.to_json(), out, json)


def _load_models(names: list[str], vehicle: Vehicle | None) -> dict[str, WindowModel]:
    """Opens the models; where two folders hold models of the same name, the folders tell them apart."""
    return told_apart({name: load_model(name, vehicle) for name in names}, attrgetter("name"))


def _with_commands(log: Recording, commands: Commands | None, models: dict[str, WindowModel]) -> Recording:
    """The recording under the protocol asked for, else the one that the models were trained with."""
    wanted = commands or shared_commands(models)
    if commands is None and wanted not in (None, log.info.commands):
        console.print(
            f"note: commands '{wanted}' as the models were trained, not the recording's '{log.info.commands}'"
        )
    return log.with_commands(wanted)


def _centre_line(name: str, log: Recording) -> ClosedLine:
    """The centre line of a track on which the recording was driven."""
    track = load_track(name)
    if not log.has_pose:
        raise ConfigurationError(f"--track {name}: the recording holds no positions (x, y) to place on it")
    _, lateral = track.project(np.stack([log["x"], log["y"]], axis=1))
    away, width = float(np.median(np.abs(lateral))), float(np.mean(track.width_left + track.width_right))
    if away > width:
        raise ConfigurationError(
            f"--track {name}: the recording lies {away:.3g} m (median) from its centre line; expected the same "
            f"coordinates, so at most the track's width of {width:.3g} m"
        )
    return track.centre


def _hold_out(log: Recording, fraction: float | None) -> tuple[Recording, str]:
    """The part of the recording to score, and its description."""
    if fraction is None:
        return log, "whole recording"
    if fraction <= 0:
        raise ConfigurationError(f"--holdout {fraction:g}: expected a fraction above 0 and up to 1")
    return log.split_last(fraction)[1], f"last {percent(fraction)} of the recording, as one block"
