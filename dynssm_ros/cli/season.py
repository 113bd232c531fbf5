"""``dynssm season``: a season in review, on one page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dynssm_ros import api
from dynssm_ros.api.season import SeasonSettings
from dynssm_ros.cli.console import progress_bar, publish
from dynssm_ros.cli.options import JsonOption, VehicleOption, with_settings
from dynssm_ros.extras import require


@with_settings(SeasonSettings)
def season(
    *,
    folder: Annotated[
        Path, typer.Argument(help="Season, as `extract` writes it, or a folder in it.", metavar="SEASON")
    ],
    vehicle: VehicleOption,
    out: Annotated[Path, typer.Option(help="Folder for report.html and results.json.", file_okay=False)],
    settings: SeasonSettings,
    model: Annotated[
        list[str] | None,
        typer.Option(help="Model folder to score beside the simple models; repeat for more.", metavar="NAME_OR_DIR"),
    ] = None,
    json: JsonOption = None,
) -> None:
    """Review a season: each model in each session, coefficients over time, causes that come and go, alarms."""
    require("season", "train", "race", "report")
    from dynssm_ros.evaluation.season_review import alarms
    from dynssm_ros.reporting.season_report import alarm_table, season_json, season_report, session_table

    with progress_bar("reviewing") as progress:
        reviews = api.review_season(folder, model or [], vehicle, out, settings=settings, on_progress=progress)
    raised, stretch = alarms(reviews), settings.stretch
    protocol = {
        "Season": str(folder),
        "Vehicle": vehicle,
        "Models": ", ".join(model or []) or "the simple ones alone",
        "Coefficients": "of whole sessions" if stretch is None else f"of stretches of {stretch:g} s",
        "Each session": "alone; online layers start from their prior",
    }
    report, tables = season_report(reviews, raised, protocol), (session_table(reviews, raised), alarm_table(raised))
    publish(report, season_json(reviews, raised), out, json, *tables)
