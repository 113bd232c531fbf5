"""``dynssm race``: closed-loop laps, with each model in the controller in turn."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dynssm_ros import api
from dynssm_ros.api.race import RaceSettings
from dynssm_ros.cli.console import progress_bar, publish
from dynssm_ros.cli.options import CourseOption, JsonOption, VehicleOption, with_settings
from dynssm_ros.extras import require


@with_settings(RaceSettings)
def race(
    *,
    vehicle: VehicleOption,
    track: CourseOption,
    model: Annotated[
        list[str],
        typer.Option(
            help="Model folder, true (the plant's own model), single_track, single_track_ewma, single_track_ekf, "
            "persistence, or a vehicle file whose coefficients the controller takes for the car's; repeat to compare.",
            metavar="NAME_OR_DIR",
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder for report.html and results.json.", file_okay=False)],
    settings: RaceSettings,
    animation: Annotated[
        bool, typer.Option("--animation", help="Also write race.gif, the cars on the track at equal times.")
    ] = False,
    json: JsonOption = None,
) -> None:
    """Drive laps in closed loop: a predictive controller with each model in turn, on a simulated car."""
    require("race", "race", "report")
    from dynssm_ros.reporting.animation import animate
    from dynssm_ros.reporting.race_report import race_json, race_report, race_table, summary

    with progress_bar("racing") as progress:
        races = api.race(vehicle, track, model, settings=settings, on_progress=progress)
    if animation:
        animate(races, out / "race.gif")
    publish(race_report(races), race_json(races), out, json, race_table(races), summary(races))
