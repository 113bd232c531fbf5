"""``dynssm calibrate``: nominal parameters by nonlinear least squares, with confidence."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dynssm_ros import api
from dynssm_ros.api.calibrate import CalibrateSettings
from dynssm_ros.cli.console import console, progress_bar, say
from dynssm_ros.cli.options import JsonOption, RecordingsArgument, VehicleOption, with_settings
from dynssm_ros.files import write_json
from dynssm_ros.signals.signal_map import STATE_SIGNALS
from dynssm_ros.vehicle import save_vehicle


@with_settings(CalibrateSettings)
def calibrate(
    recordings: RecordingsArgument,
    vehicle: VehicleOption,
    out: Annotated[Path, typer.Option(help="Vehicle file to write.", dir_okay=False)],
    settings: CalibrateSettings,
    json: JsonOption = None,
) -> None:
    """Fit the nominal parameters of a vehicle to measured laps, within their bounds."""
    from dynssm_ros.reporting.calibration_table import calibration_json, calibration_table

    with progress_bar("calibrating") as progress:
        result = api.calibrate(recordings, vehicle, settings=settings, on_progress=progress)
    save_vehicle(
        result.vehicle,
        out,
        f"Calibrated on {', '.join(map(str, recordings))} (simulations of {result.horizon:g} s, "
        f"{result.vehicle.integrator} steps, {result.rows} rows, seed {settings.seed}).",
    )
    if json is not None:
        write_json(json, calibration_json(result))
    console.print(calibration_table(result))
    for name, was, now in zip(STATE_SIGNALS, result.rmse_before, result.rmse_after, strict=True):
        unit = "rad/s" if name == "omega" else "m/s"
        say(f"one-step RMSE {name}: {was:.3g} -> {now:.3g} {unit}")
    if result.on_bound:
        say(f"on a bound: {', '.join(result.on_bound)} - the data want more than the vehicle file admits")
    for combination in result.unidentified:
        terms = " ".join(f"{weight:+g} {name}" for name, weight in combination.items())
        say(f"not determined by these data: {terms} (in units of what was known before)")
    say(f"{out} written")
