"""``dynssm evaluate``: models on a recording, one step ahead and over a horizon."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dynssm_ros import api
from dynssm_ros.api.evaluate import EvaluateSettings
from dynssm_ros.api.inputs import vehicle_in_windows
from dynssm_ros.cli.console import progress_bar, publish, say
from dynssm_ros.cli.options import JsonOption, RecordingsArgument, with_settings
from dynssm_ros.extras import require
from dynssm_ros.files import replacing
from dynssm_ros.signals.recording import Recording
from dynssm_ros.signals.season import recording_files


@with_settings(EvaluateSettings)
def evaluate(
    *,
    recordings: RecordingsArgument,
    model: Annotated[
        list[str],
        typer.Option(
            help="Model folder, persistence, single_track, single_track_ewma or single_track_ekf (which need "
            "--vehicle); repeat to compare.",
            metavar="NAME_OR_DIR",
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder for report.html, results.json and results.md.", file_okay=False)],
    settings: EvaluateSettings,
    vehicle: Annotated[
        str | None, typer.Option(help="Vehicle of single_track: name of a shipped one (orca, av21, ...) or a file.")
    ] = None,
    json: JsonOption = None,
) -> None:
    """Score models on a recording: one-step errors, rollouts, displacement, latency; with an HTML report.

    Folders of one model that was trained with several seeds become one row: mean and standard deviation.
    """
    require("evaluate", "report")
    from dynssm_ros.evaluation.open_loop import shared_commands
    from dynssm_ros.reporting.evaluation_report import markdown, open_loop_report, summary_table, verdict
    from dynssm_ros.runtime.registry import open_models

    models = open_models(model, None if vehicle is None else vehicle_in_windows(vehicle))
    logs = [Recording.load(recording) for recording in recording_files(recordings)]
    wanted, recorded = shared_commands(models), {log.info.commands for log in logs}
    if settings.commands is None and wanted is not None and recorded != {wanted}:
        others = "', '".join(sorted(recorded - {wanted}))
        say(f"note: commands '{wanted}' as the models were trained, not the recording's '{others}'")
    name = ", ".join(recording.name for recording in recordings)
    with progress_bar("evaluating") as progress:
        evaluation = api.evaluate(logs, models, vehicle, settings=settings, name=name, on_progress=progress)
    with replacing(out / "results.md") as aside:
        aside.write_text(markdown(evaluation), encoding="utf-8")
    publish(
        open_loop_report(evaluation), evaluation.to_json(), out, json, summary_table(evaluation), verdict(evaluation)
    )
