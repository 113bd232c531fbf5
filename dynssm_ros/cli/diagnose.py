"""``dynssm diagnose``: what the simulation gets wrong, the cause, the extended vehicle file, the improvement."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Annotated

import typer

from dynssm_ros import api
from dynssm_ros.api.diagnose import DiagnoseSettings
from dynssm_ros.cli.console import progress_bar, say, write_results
from dynssm_ros.cli.options import JsonOption, VehicleOption, with_settings
from dynssm_ros.errors import ConfigurationError
from dynssm_ros.extras import require
from dynssm_ros.vehicle import save_vehicle


@with_settings(DiagnoseSettings)
def diagnose(
    *,
    vehicle: VehicleOption,
    out: Annotated[Path, typer.Option(help="Folder for vehicle.yaml, report.html and results.json.", file_okay=False)],
    settings: DiagnoseSettings,
    recordings: Annotated[
        list[Path] | None,
        typer.Argument(
            help="Recordings of one car, or a season. What only one of several has is named with it.",
            metavar="R.parquet...",
        ),
    ] = None,
    reference: Annotated[
        list[Path] | None, typer.Option(help="Recording as R.parquet, beside those that are suspect; repeat for more.")
    ] = None,
    suspect: Annotated[
        list[Path] | None,
        typer.Option(help="Recording in which something may have changed since the others; repeat for more."),
    ] = None,
    json: JsonOption = None,
) -> None:
    """Find out what the simulation gets wrong about measured laps, and why; write the vehicle file that has it."""
    require("diagnose", "train", "report")
    from dynssm_ros.reporting.diagnosis_report import diagnosis_report
    from dynssm_ros.reporting.diagnosis_words import as_text

    if not (given := [*(recordings or ()), *(reference or ())]):
        raise ConfigurationError("no recording given; expected R.parquet or --reference R.parquet")
    with progress_bar("diagnosing") as progress:
        steps = itertools.count(1)
        result = api.diagnose(
            given, vehicle, settings=settings, suspect=suspect or (),
            on_progress=lambda words: progress(min(next(steps), 40), 40, words),
        )  # fmt: skip
    path = out / "vehicle.yaml"
    about = f"{result.car.vehicle.name}, extended by a diagnosis of {result.protocol['Recording']}: {result.verdict}."
    save_vehicle(result.vehicle, path, about)
    diagnosis_report(result, result.anatomy, result.ahead).save(out / "report.html")
    write_results(result.to_json(str(path)), out, json)
    say(as_text(result, result.anatomy))
    say(f"{path} written; {out / 'report.html'}: figures and how to read them")
