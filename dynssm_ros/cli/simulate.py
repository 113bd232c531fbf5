"""``dynssm simulate``: drives laps and writes what a recorder on the car would have written."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from dynssm_ros import api
from dynssm_ros.cli.console import (
    CourseOption,
    EffectOption,
    JsonOption,
    PlantOption,
    VehicleOption,
    as_effects,
    console,
    progress_bar,
)
from dynssm_ros.errors import UserError
from dynssm_ros.extras import require
from dynssm_ros.files import write_json

if TYPE_CHECKING:
    from dynssm_ros.simulation.laps import Run


def simulate(
    vehicle: VehicleOption,
    track: CourseOption,
    out: Annotated[Path, typer.Option(help="rosbag2 folder to write (MCAP).")],
    duration: Annotated[float | None, typer.Option(help="Time to drive (s); 60 if neither this nor --laps.")] = None,
    laps: Annotated[float | None, typer.Option(help="Laps to drive, instead of a duration.")] = None,
    plant: PlantOption = "euler",
    line: Annotated[
        Literal["centre", "racing"], typer.Option(help="What the driver follows: the centre line or the racing line.")
    ] = "centre",
    seed: Annotated[int, typer.Option(help="Of the driver's variation and the noise.", min=0)] = 0,
    aggressiveness: Annotated[float, typer.Option(help="Share of the car's limits in use.", min=0.1, max=1.2)] = 0.95,
    variation: Annotated[float, typer.Option(help="How much speed and line vary.", min=0.0, max=1.0)] = 0.5,
    noise: Annotated[
        str, typer.Option(help="Standard deviations of the measured v_x,v_y,omega (m/s, m/s, rad/s).")
    ] = "0,0,0",
    effect: EffectOption = None,
    scale: Annotated[float, typer.Option(help="Size of the track, for other cars than it was made for.")] = 1.0,
    json: JsonOption = None,
) -> None:
    """Drive laps on a track and write them as a rosbag2 with the default topics."""
    require("simulate", "race")
    from dynssm_ros.simulation.laps import write_run

    with progress_bar("driving") as progress:
        run = api.simulate(
            vehicle, track, duration, laps, plant, line, seed, aggressiveness, variation, parse_noise(noise),
            as_effects(effect), scale, progress,
        )  # fmt: skip
    write_run(run, out)
    result = summary(run) | {"line": line}
    if json is not None:
        write_json(json, result)
    console.print(
        f"{out}: {run.vehicle.name} on {run.track.name}, {result['laps']:.2f} laps in {result['duration_s']:.1f} s, "
        f"speed mean {result['mean_speed']:.2f} top {result['top_speed']:.2f} m/s, seed {seed}",
        soft_wrap=True,
    )


def summary(run: Run) -> dict[str, Any]:
    """The run in a few values, for programs."""
    return {
        "vehicle": run.vehicle.name,
        "effects": [entry.model_dump() for entry in run.vehicle.effects],
        "track": run.track.name,
        "plant": run.plant,
        "seed": run.seed,
        "duration_s": run.duration,
        "laps": run.laps,
        "lap_times_s": run.lap_times.tolist(),
        "mean_speed": float(run.state[:, 0].mean()),
        "top_speed": float(run.state[:, 0].max()),
    }


def parse_noise(text: str, option: str = "--noise") -> tuple[float, float, float]:
    """Three standard deviations that an option has, as ``v_x,v_y,omega``.

    Raises:
        UserError: not three numbers of at least 0.
    """
    try:
        v_x, v_y, omega = (float(part) for part in text.split(","))
    except ValueError as error:
        raise UserError(f"{option} {text}; expected three numbers, as in 0.02,0.01,0.002") from error
    if not all(0 <= std < float("inf") for std in (v_x, v_y, omega)):
        raise UserError(f"{option} {text}; expected finite numbers of at least 0")
    return v_x, v_y, omega
