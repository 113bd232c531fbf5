"""``dynssm evaluate``: models on a recording, one step ahead and over a horizon."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dynssm_ros import api
from dynssm_ros.cli.console import (
    AddressOption,
    BackendOption,
    CommandsOption,
    JobsOption,
    JsonOption,
    MinSpeedOption,
    WhereOption,
    console,
    progress_bar,
    write_results,
)
from dynssm_ros.extras import require
from dynssm_ros.files import replacing
from dynssm_ros.parallel import Workers
from dynssm_ros.signals.recording import Recording
from dynssm_ros.signals.season import recording_files
from dynssm_ros.vehicle.kinematics import PATH_HORIZON_S

TrackOption = Annotated[
    str | None,
    typer.Option(
        help="Track along which errors are placed: built-in name or file, in the recording's coordinates.",
        show_default="the first full lap in the recording",
    ),
]


def evaluate(
    recordings: Annotated[
        list[Path],
        typer.Argument(
            help="Recordings of one car to score on, in the order of driving, or a season.", metavar="R.parquet..."
        ),
    ],
    model: Annotated[
        list[str],
        typer.Option(
            help="Model folder, persistence, single_track, single_track_ewma or single_track_ekf (which need "
            "--vehicle); repeat to compare.",
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
    horizon: Annotated[float, typer.Option(help="Length of the rollouts (s).", min=0.0)] = PATH_HORIZON_S,
    stride: Annotated[int, typer.Option(help="Start a rollout at every n-th row.", min=1)] = 1,
    track: TrackOption = None,
    json: JsonOption = None,
    where: WhereOption = None,
    jobs: JobsOption = None,
    backend: BackendOption = "processes",
    address: AddressOption = None,
) -> None:
    """Score models on a recording: one-step errors, rollouts, displacement, latency; with an HTML report.

    Folders of one model that was trained with several seeds become one row: mean and standard deviation.
    """
    require("evaluate", "report")
    from dynssm_ros.evaluation.open_loop import shared_commands
    from dynssm_ros.reporting.evaluation_report import markdown, open_loop_report, summary_table, verdict

    models = api.open_models(list(model), vehicle)
    logs = [Recording.load(recording) for recording in recording_files(recordings, where)]
    wanted, recorded = shared_commands(models), {log.info.commands for log in logs}
    if commands is None and wanted is not None and recorded != {wanted}:
        others = "', '".join(sorted(recorded - {wanted}))
        console.print(f"note: commands '{wanted}' as the models were trained, not the recording's '{others}'")
    with progress_bar("evaluating") as progress:
        evaluation = api.evaluate(
            logs, models, vehicle, holdout, commands, min_speed, horizon, stride, track, progress,
            ", ".join(recording.name for recording in recordings) + (f" where {where}" if where else ""),
            Workers(jobs, backend, address),
        )  # fmt: skip
    open_loop_report(evaluation).save(out / "report.html")
    with replacing(out / "results.md") as aside:
        aside.write_text(markdown(evaluation), encoding="utf-8")
    write_results(evaluation.to_json(), out, json)
    console.print(summary_table(evaluation).brief.rich())
    console.print(verdict(evaluation), markup=False, soft_wrap=True)
    console.print(f"{out / 'report.html'}: figures and how to read them", markup=False, soft_wrap=True)
