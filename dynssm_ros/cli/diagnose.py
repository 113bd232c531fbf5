"""``dynssm diagnose``: what the simulation gets wrong, the cause, the extended vehicle file, the gain."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dynssm_ros.cli.console import (
    CommandsOption,
    JsonOption,
    MinSpeedOption,
    VehicleOption,
    console,
    progress_bar,
    write_results,
)
from dynssm_ros.identification.diagnose import diagnose as find_causes
from dynssm_ros.reporting.diagnosis_report import diagnosis_report, in_words
from dynssm_ros.signals.recording import Recording, concatenate
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import load_vehicle, save_vehicle
from dynssm_ros.vehicle.single_track import Integrator


def diagnose(
    recordings: Annotated[list[Path], typer.Argument(help="Recordings of one car.", metavar="R.parquet...")],
    vehicle: VehicleOption,
    out: Annotated[Path, typer.Option(help="Folder for vehicle.yaml, report.html and results.json.", file_okay=False)],
    horizon: Annotated[float, typer.Option(help="Time that is simulated from a measured state on (s).", min=0.0)] = 0.5,
    holdout: Annotated[
        float,
        typer.Option(help="Share at the end that only measures the gain; whole laps if there are three.", max=0.8),
    ] = 0.25,
    min_speed: MinSpeedOption = None,
    integrator: Annotated[
        Integrator | None,
        typer.Option(help="How the model steps.", show_default="rk4, unless euler is clearly closer to the data"),
    ] = None,
    track: Annotated[
        str | None,
        typer.Option(
            help="Track along which places are counted: built-in name or file, in the recording's coordinates.",
            show_default="the first full lap in the recording",
        ),
    ] = None,
    commands: CommandsOption = None,
    json: JsonOption = None,
) -> None:
    """Find out what the simulation gets wrong about measured laps, and why; write the vehicle file that has it."""
    car = load_vehicle(vehicle)
    data = concatenate([Recording.load(path).with_commands(commands) for path in recordings])
    line = None if track is None else load_track(track).centre
    with progress_bar("diagnosing") as progress:
        steps = 0

        def say(words: str) -> None:
            nonlocal steps
            steps += 1
            progress(min(steps, 39), 40, words)

        result = find_causes(data, car, horizon, holdout, min_speed, integrator, line, say)
    path = out / "vehicle.yaml"
    save_vehicle(
        result.vehicle, path, f"{car.name}, extended by a diagnosis of {', '.join(data.info.source)}: {result.verdict}."
    )
    diagnosis_report(result).save(out / "report.html")
    write_results(result.to_json(str(path)), out, json)
    console.print(in_words(result), markup=False, soft_wrap=True)
    console.print(f"{path} written; {out / 'report.html'}: figures and how to read them", markup=False, soft_wrap=True)
