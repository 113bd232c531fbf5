"""``dynssm residuals``: the patterns that one-step errors have."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dynssm_ros import api
from dynssm_ros.api.residuals import ResidualsSettings
from dynssm_ros.cli.console import progress_bar, publish
from dynssm_ros.cli.options import JsonOption, RecordingsArgument, VehicleOption, with_settings
from dynssm_ros.extras import require


@with_settings(ResidualsSettings)
def residuals(
    *,
    recordings: RecordingsArgument,
    vehicle: VehicleOption,
    out: Annotated[Path, typer.Option(help="Folder for report.html and results.json.", file_okay=False)],
    settings: ResidualsSettings,
    model: Annotated[
        list[str] | None,
        typer.Option(
            help="Model folder or name of a baseline; repeat for more. If not given, rls learns along the drive.",
            metavar="NAME_OR_DIR",
        ),
    ] = None,
    json: JsonOption = None,
) -> None:
    """Show which patterns the one-step errors of physics and model have, and what can still be learned."""
    require("residuals", "report")
    from dynssm_ros.reporting.residuals_report import as_text, residuals_report

    name = ", ".join(recording.name for recording in recordings)
    with progress_bar("taking errors apart") as progress:
        found = api.residuals(recordings, vehicle, model or (), settings=settings, name=name, on_progress=progress)
    publish(residuals_report(found), found.to_json(), out, json, as_text(found))
