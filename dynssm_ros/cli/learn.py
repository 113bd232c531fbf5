"""``dynssm learn``: logs to a car, a diagnosis, a model and one report."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dynssm_ros import api
from dynssm_ros.api.learn import LearnSettings
from dynssm_ros.cli.console import say
from dynssm_ros.cli.options import VehicleOption, with_settings
from dynssm_ros.errors import ConfigurationError


@with_settings(LearnSettings)
def learn(
    logs: Annotated[
        list[Path],
        typer.Argument(help="Logs of one car: bags of ROS 2 or ROS 1, or tables.", metavar="LOG..."),
    ],
    vehicle: VehicleOption,
    out: Annotated[Path, typer.Option(help="Folder for index.html and what each step writes.", file_okay=False)],
    settings: LearnSettings,
) -> None:
    """Go the whole way: inspect, extract, calibrate, diagnose, train, evaluate; one report. The same command continues."""
    found = api.learn(logs, vehicle, out, settings=settings, on_progress=say)
    say(f"{out / 'index.html'}: what came of each step, and the figures")
    if found.failure:
        raise ConfigurationError(f"{found.records[-1].name} failed: {found.failure}")
