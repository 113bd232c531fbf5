"""``dynssm vehicle new``: a first vehicle file."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Literal

import typer

from dynssm_ros import api
from dynssm_ros.api.new_vehicle import NEEDED, NewVehicleSettings
from dynssm_ros.cli.console import say
from dynssm_ros.cli.options import with_settings


@with_settings(NewVehicleSettings)
def vehicle(
    what: Annotated[Literal["new"], typer.Argument(help="new: writes a first vehicle file.", metavar="new")],
    out: Annotated[Path, typer.Option(help="Vehicle file to write (CAR.yaml); its name is the car's.", dir_okay=False)],
    settings: NewVehicleSettings,
) -> None:
    """Write a first, commented vehicle file from mass, axle loads, wheelbase and kind of tyre; asks for what is missing."""
    if sys.stdin.isatty():
        asked = {
            name: typer.prompt(str(NewVehicleSettings.model_fields[name].description).rstrip("."), type=float)
            for name in NEEDED
            if getattr(settings, name) is None
        }
        settings = NewVehicleSettings.of(settings.model_dump(exclude_unset=True) | asked)
    draft = api.new_vehicle(out.stem, settings=settings)
    draft.save(out)
    car = draft.vehicle.constants
    say(
        f"{out}: {car.m:g} kg, l_f {car.l_f:g} m, l_r {car.l_r:g} m, like {settings.like}; a guess until it is calibrated"
    )
    say(f"next: dynssm calibrate LAPS.parquet --vehicle {out} --out calibrated.yaml")
