"""``dynssm simulate``: drives laps and writes what a recorder on the car would have written."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from dynssm_ros.cli.console import JsonOption, VehicleOption, console, progress_bar
from dynssm_ros.errors import UserError
from dynssm_ros.files import write_json
from dynssm_ros.simulation.laps import Run, write_run
from dynssm_ros.simulation.laps import simulate as simulate_run
from dynssm_ros.simulation.plant import PlantKind
from dynssm_ros.track.driver import Style
from dynssm_ros.track.racing_line import LineKind, line_of
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import load_vehicle
from dynssm_ros.vehicle.effects import parse_effect


def simulate(
    vehicle: VehicleOption,
    track: Annotated[
        str, typer.Option(help="Track: oval, road_course, club, club_b, or a file x_m,y_m,w_tr_right_m,w_tr_left_m.")
    ],
    out: Annotated[Path, typer.Option(help="rosbag2 folder to write (MCAP).")],
    duration: Annotated[float | None, typer.Option(help="Time to drive (s); 60 if neither this nor --laps.")] = None,
    laps: Annotated[float | None, typer.Option(help="Laps to drive, instead of a duration.")] = None,
    plant: Annotated[
        PlantKind,
        typer.Option(
            help="euler: one step per T_s, as in the published data; rk4: steps of 1 ms; double_track: four wheels."
        ),
    ] = "euler",
    line: Annotated[
        LineKind, typer.Option(help="What the driver follows: the centre line or the racing line.")
    ] = "centre",
    seed: Annotated[int, typer.Option(help="Of the driver's variation and the noise.", min=0)] = 0,
    aggressiveness: Annotated[float, typer.Option(help="Share of the car's limits in use.", min=0.1, max=1.2)] = 0.95,
    variation: Annotated[float, typer.Option(help="How much speed and line vary.", min=0.0, max=1.0)] = 0.5,
    noise: Annotated[
        str, typer.Option(help="Standard deviations of the measured v_x,v_y,omega (m/s, m/s, rad/s).")
    ] = "0,0,0",
    effect: Annotated[
        list[str] | None,
        typer.Option(help="Physics that the vehicle file does not have; repeatable.", metavar="NAME[:k=v,...]"),
    ] = None,
    scale: Annotated[float, typer.Option(help="Size of the track, for other cars than it was made for.")] = 1.0,
    json: JsonOption = None,
) -> None:
    """Drive laps on a track and write them as a rosbag2 with the default topics."""
    car = load_vehicle(vehicle).with_effects(map(parse_effect, effect or []))
    course = load_track(track).scaled(scale)
    if duration is None and laps is None:
        duration = 60.0
    with progress_bar("driving") as progress:
        run = simulate_run(
            car,
            course,
            duration,
            laps,
            plant,
            seed,
            Style(aggressiveness, variation),
            line_of(line, car, course),
            noise=parse_noise(noise),
            progress=progress,
        )
    write_run(run, out)
    result = summary(run) | {"line": line}
    if json is not None:
        write_json(json, result)
    console.print(
        f"{out}: {car.name} on {course.name}, {result['laps']:.2f} laps in {result['duration_s']:.1f} s, "
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


def parse_noise(text: str) -> tuple[float, float, float]:
    """``v_x,v_y,omega`` to three standard deviations.

    Raises:
        UserError: not three numbers of at least 0.
    """
    try:
        v_x, v_y, omega = (float(part) for part in text.split(","))
    except ValueError as error:
        raise UserError(f"--noise {text}; expected three numbers, as in 0.02,0.01,0.002") from error
    if not all(0 <= std < float("inf") for std in (v_x, v_y, omega)):
        raise UserError(f"--noise {text}; expected finite numbers of at least 0")
    return v_x, v_y, omega
