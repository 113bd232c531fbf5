"""``dynssm simulate``: drives laps and writes what a recorder on the car would have written."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dynssm_ros import api
from dynssm_ros.api.simulate import SimulateSettings
from dynssm_ros.cli.console import progress_bar, say
from dynssm_ros.cli.options import CourseOption, JsonOption, VehicleOption, with_settings
from dynssm_ros.extras import require
from dynssm_ros.files import write_json

if TYPE_CHECKING:
    from dynssm_ros.simulation.laps import Run


@with_settings(SimulateSettings)
def simulate(
    vehicle: VehicleOption,
    track: CourseOption,
    out: Annotated[Path, typer.Option(help="rosbag2 folder to write (MCAP).")],
    settings: SimulateSettings,
    json: JsonOption = None,
) -> None:
    """Drive laps on a track and write them as a rosbag2 with the default topics."""
    require("simulate", "race")
    from dynssm_ros.simulation.laps import write_run

    with progress_bar("driving") as progress:
        run = api.simulate(vehicle, track, settings=settings, on_progress=progress)
    write_run(run, out)
    result = summary(run) | {"line": settings.line}
    if json is not None:
        write_json(json, result)
    say(
        f"{out}: {run.vehicle.name} on {run.track.name}, {result['laps']:.2f} laps in {result['duration_s']:.1f} s, "
        f"speed mean {result['mean_speed']:.2f} top {result['top_speed']:.2f} m/s, seed {settings.seed}"
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
