"""``dynssm diagnose``: what the simulation gets wrong, the cause, the extended vehicle file, the gain."""

from __future__ import annotations

import itertools
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
    VehicleOption,
    WhereOption,
    console,
    progress_bar,
    write_results,
)
from dynssm_ros.errors import ConfigurationError
from dynssm_ros.extras import require
from dynssm_ros.parallel import Workers
from dynssm_ros.signals.season import recording_files
from dynssm_ros.vehicle import save_vehicle
from dynssm_ros.vehicle.integrators import Integrator


def diagnose(
    vehicle: VehicleOption,
    out: Annotated[Path, typer.Option(help="Folder for vehicle.yaml, report.html and results.json.", file_okay=False)],
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
    horizon: Annotated[float, typer.Option(help="Time that is simulated from a measured state on (s).", min=0.0)] = 0.5,
    holdout: Annotated[
        float,
        typer.Option(help="Share at the end that only measures the gain; whole laps if there are three.", max=0.8),
    ] = 0.25,
    min_speed: MinSpeedOption = None,
    integrator: Annotated[
        Integrator | None,
        typer.Option(help="How the model steps.", show_default="the file's, else rk4; others if clearly closer"),
    ] = None,
    track: Annotated[
        str | None,
        typer.Option(
            help="Track along which places are counted: built-in name or file, in the recording's coordinates.",
            show_default="the first full lap in the recording",
        ),
    ] = None,
    exclude: Annotated[
        list[str] | None,
        typer.Option(help="Effect that is impossible there, such as crosswind in a hall; repeat for more."),
    ] = None,
    suspect: Annotated[
        list[Path] | None,
        typer.Option(help="Recording in which something may have changed since the others; repeat for more."),
    ] = None,
    commands: CommandsOption = None,
    json: JsonOption = None,
    where: WhereOption = None,
    jobs: JobsOption = None,
    backend: BackendOption = "processes",
    address: AddressOption = None,
) -> None:
    """Find out what the simulation gets wrong about measured laps, and why; write the vehicle file that has it."""
    require("diagnose", "train", "report")
    from dynssm_ros.reporting.diagnosis_report import as_text, diagnosis_report

    if not (given := [*(recordings or ()), *(reference or ())]):
        raise ConfigurationError("no recording given; expected R.parquet or --reference R.parquet")
    given = recording_files(given, where)
    with progress_bar("diagnosing") as progress:
        steps = itertools.count(1)
        result = api.diagnose(
            given, vehicle, horizon, holdout, min_speed, integrator, track, commands,
            lambda words: progress(min(next(steps), 39), 40, words), exclude or (), suspect or (),
            Workers(jobs, backend, address),
        )  # fmt: skip
    path = out / "vehicle.yaml"
    about = f"{result.car.vehicle.name}, extended by a diagnosis of {result.protocol['Recording']}: {result.verdict}."
    save_vehicle(result.vehicle, path, about)
    diagnosis_report(result).save(out / "report.html")
    write_results(result.to_json(str(path)), out, json)
    console.print(as_text(result), markup=False, soft_wrap=True)
    console.print(f"{path} written; {out / 'report.html'}: figures and how to read them", markup=False, soft_wrap=True)
