"""``dynssm calibrate``: nominal parameters by nonlinear least squares, with confidence."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table

from dynssm_ros import api
from dynssm_ros.api.calibrate import CalibrateSettings
from dynssm_ros.cli.console import console, progress_bar
from dynssm_ros.cli.options import JsonOption, RecordingsArgument, VehicleOption, with_settings
from dynssm_ros.files import write_json
from dynssm_ros.vehicle import COEFFICIENT_UNITS, COEFFICIENTS, save_vehicle

if TYPE_CHECKING:
    from dynssm_ros.identification.result.calibration import Calibration


@with_settings(CalibrateSettings)
def calibrate(
    recordings: RecordingsArgument,
    vehicle: VehicleOption,
    out: Annotated[Path, typer.Option(help="Vehicle file to write.", dir_okay=False)],
    settings: CalibrateSettings,
    json: JsonOption = None,
) -> None:
    """Fit the nominal parameters of a vehicle to measured laps, within their bounds."""
    with progress_bar("calibrating") as progress:
        result = api.calibrate(recordings, vehicle, settings=settings, on_progress=progress)
    save_vehicle(
        result.vehicle,
        out,
        f"Calibrated on {', '.join(map(str, recordings))} (simulations of {result.horizon:g} s, "
        f"{result.vehicle.integrator} steps, {result.rows} rows, seed {settings.seed}).",
    )
    if json is not None:
        write_json(json, as_json(result))
    console.print(coefficient_table(result))
    before, after = result.rmse_before, result.rmse_after
    for name, unit, was, now in zip(("v_x", "v_y", "omega"), ("m/s", "m/s", "rad/s"), before, after, strict=True):
        console.print(f"one-step RMSE {name}: {was:.3g} -> {now:.3g} {unit}")
    if result.on_bound:
        console.print(
            f"on a bound: {', '.join(result.on_bound)} - the data want more than the vehicle file admits",
            soft_wrap=True,
        )
    for combination in result.unidentified:
        terms = " ".join(f"{weight:+g} {name}" for name, weight in combination.items())
        console.print(f"not determined by these data: {terms} (in units of what was known before)", soft_wrap=True)
    console.print(f"{out} written", soft_wrap=True)


def coefficient_table(result: Calibration) -> Table:
    """Nominal values with standard deviations and bounds."""
    table = Table("coefficient", "value", "std", "bounds", "unit")
    for k, name in enumerate(COEFFICIENTS):
        lower, upper = result.vehicle.coefficients[name].bounds
        mark = " *" if name in result.on_bound else ""
        table.add_row(
            name + mark,
            f"{result.theta[k]:.4g}",
            f"{result.std[k]:.1g}",
            f"{lower:g} .. {upper:g}",
            COEFFICIENT_UNITS[name],
        )
    return table


def as_json(result: Calibration) -> dict[str, Any]:
    """The calibration for programs."""
    channels = ("v_x", "v_y", "omega")
    return {
        "coefficients": {
            name: {"value": float(result.theta[k]), "std": float(result.std[k]), "unit": COEFFICIENT_UNITS[name]}
            for k, name in enumerate(COEFFICIENTS)
        },
        "on_bound": list(result.on_bound),
        "unidentified": list(result.unidentified),
        "rmse_before": dict(zip(channels, result.rmse_before.tolist(), strict=True)),
        "rmse_after": dict(zip(channels, result.rmse_after.tolist(), strict=True)),
        "rows": result.rows,
        "horizon_s": result.horizon,
    }
