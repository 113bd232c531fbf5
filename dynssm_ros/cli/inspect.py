"""``dynssm inspect``: what is in a log, and a first signal map for it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dynssm_ros import api
from dynssm_ros.cli.console import console, progress_bar, say, warn
from dynssm_ros.cli.options import JsonOption
from dynssm_ros.errors import ConfigurationError
from dynssm_ros.extras import require
from dynssm_ros.files import replacing, write_json
from dynssm_ros.signals.season import Season, is_season


def inspect(
    bag: Annotated[
        Path,
        typer.Argument(
            help="Bag of ROS 2 or ROS 1, or table (CSV, Parquet, .mat, .npz); or a season, whose sessions are listed.",
            metavar="LOG",
        ),
    ],
    vehicle: Annotated[
        str | None,
        typer.Option(help="Vehicle, with whose wheelbase the scale of the steering follows: shipped name or file."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for signals.yaml and report.html, which shows the signals.")
    ] = None,
    json: JsonOption = None,
) -> None:
    """Show what is in a log: topics or columns, rates, gaps, clocks; suggest a signal map."""
    from dynssm_ros.reporting.inspection_tables import finding_table, inspection_json, season_table, topic_table

    if is_season(bag):
        if vehicle is not None or out is not None:
            raise ConfigurationError(f"{bag}: a season is listed alone; expected neither --vehicle nor --out")
        season = Season.load(bag)
        console.print(season_table(season).rich())
        if json is not None:
            write_json(json, season.to_json())
        return
    with progress_bar("reading") as progress:
        found = api.inspect(bag, vehicle, on_progress=progress)
    console.print(topic_table(found).brief.rich())
    for note in found.notes:
        say(f"note: {note}")
    if found.findings:
        console.print(finding_table(found.findings).brief.rich())
    for finding in found.findings:
        warn(finding.line)
    console.print(found.signal_map(), markup=False, soft_wrap=True, end="")
    if json is not None:
        write_json(json, inspection_json(found))
    if out is not None:
        require("inspect --out", "report")
        from dynssm_ros.reporting.inspection_report import inspection_report

        with replacing(out / "signals.yaml") as aside:
            aside.write_text(found.signal_map(), encoding="utf-8")
        inspection_report(found).save(out / "report.html")
        say(f"{out / 'signals.yaml'} written; {out / 'report.html'}: the signals over time")
