"""``dynssm export``: a car for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dynssm_ros import api
from dynssm_ros.api.export import ExportSettings
from dynssm_ros.cli.console import say
from dynssm_ros.cli.options import VehicleOption, with_settings


@with_settings(ExportSettings)
def export(
    vehicle: VehicleOption,
    out: Annotated[Path, typer.Option(help="Folder to write.", file_okay=False)],
    settings: ExportSettings,
) -> None:
    """Write the car down for other programs: C code, an acados model, parameters of simulators, a steering table."""
    made = api.export(vehicle, settings=settings)
    made.save(out)
    say(f"{out}: {', '.join(sorted(made.files))}")
