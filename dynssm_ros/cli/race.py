"""``dynssm race``: closed-loop laps, with each model in the controller in turn."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

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
    write_results,
)
from dynssm_ros.cli.simulate import parse_noise
from dynssm_ros.extras import require


def race(
    vehicle: VehicleOption,
    track: CourseOption,
    model: Annotated[
        list[str],
        typer.Option(
            help="Model folder, true (the plant's own model), single_track, single_track_ewma, single_track_ekf, "
            "persistence, or a vehicle file whose coefficients the controller takes for the car's; repeat to compare.",
            metavar="NAME_OR_DIR",
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder for report.html and results.json.", file_okay=False)],
    plant: PlantOption = "rk4",
    objective: Annotated[
        Literal["tracking", "progress"],
        typer.Option(
            help="tracking: follow the line at its own speed, as in the literature; progress: get as far as possible "
            "between the borders, and end each horizon no faster than the line is there."
        ),
    ] = "tracking",
    laps: Annotated[int, typer.Option(help="Laps to drive.", min=1)] = 1,
    line: Annotated[
        str, typer.Option(help="Line to follow: centre, racing, or a file s_m,x_m,y_m,v_mps with its own speed.")
    ] = "racing",
    speed_scale: Annotated[
        float | None,
        typer.Option(
            help="Share of the car's limits in the line's speed; of a file, factor on it.",
            min=0.1,
            max=2.0,
            show_default="1; with --learn 0.7, to begin with",
        ),
    ] = None,
    learn: Annotated[
        bool,
        typer.Option(
            "--learn",
            help="Drive each section of the lap faster every lap, as far as the laps so far have shown it is safe.",
        ),
    ] = False,
    horizon: Annotated[
        int | None,
        typer.Option(
            help="Steps of T_s that are planned ahead.",
            min=2,
            max=100,
            show_default="as the car needs: orca 15, av21 40",
        ),
    ] = None,
    along_horizon: Annotated[
        bool, typer.Option("--along-horizon", help="Read the models anew at every step of the horizon.")
    ] = False,
    offset_free: Annotated[
        bool,
        typer.Option(
            "--offset-free", help="Follow what each model mispredicts at a fixed rate, not at one that the data choose."
        ),
    ] = False,
    as_is: Annotated[
        bool,
        typer.Option(
            "--as-is",
            help="Plan with what each model says, whether or not it has predicted better than the calibrated car.",
        ),
    ] = False,
    effect: EffectOption = None,
    scale: Annotated[float | None, typer.Option(help="Size of the track, for other cars than it was made for.")] = None,
    lap_length: Annotated[
        float | None,
        typer.Option(help="Or scale it to this length (m): 401 for Austin, 291 for IMS with the 1:43 car."),
    ] = None,
    start: Annotated[float, typer.Option(help="Where the car starts on the centre line (m).")] = 0.0,
    start_offset: Annotated[float, typer.Option(help="How far left of the line it starts (m).")] = 0.0,
    start_speed: Annotated[
        float | None,
        typer.Option(help="How fast it starts (m/s); 0: from standstill.", show_default="the line's own speed"),
    ] = None,
    noise: Annotated[
        str, typer.Option(help="Standard deviations of the measured v_x,v_y,omega (m/s, m/s, rad/s).")
    ] = "0,0,0",
    pose_noise: Annotated[str, typer.Option(help="Likewise of the measured x,y,theta (m, m, rad).")] = "0,0,0",
    delay: Annotated[
        float,
        typer.Option(
            help="From an instant until the command that answers it acts (ms), in whole sampling times; known to the "
            "controller.",
            min=0.0,
        ),
    ] = 0.0,
    seed: Annotated[int, typer.Option(help="Of the noise.", min=0)] = 0,
    animation: Annotated[
        bool, typer.Option("--animation", help="Also write race.gif, the cars on the track at equal times.")
    ] = False,
    json: JsonOption = None,
) -> None:
    """Drive laps in closed loop: a predictive controller with each model in turn, on a simulated car."""
    require("race", "race", "report")
    from dynssm_ros.reporting.animation import animate
    from dynssm_ros.reporting.race_report import race_json, race_report, race_table, summary

    with progress_bar("racing") as progress:
        races = api.race(
            vehicle, track, list(model), plant, objective, laps, line, speed_scale, horizon, along_horizon, offset_free,
            as_effects(effect), scale, lap_length, start, start_offset, start_speed, progress,
            parse_noise(noise), parse_noise(pose_noise, "--pose-noise"), delay / 1e3, seed, as_is, learn,
        )  # fmt: skip
    race_report(races).save(out / "report.html")
    if animation:
        animate(races, out / "race.gif")
    write_results(race_json(races), out, json)
    console.print(race_table(races).brief.rich())
    console.print(summary(races), markup=False, soft_wrap=True)
    console.print(f"{out / 'report.html'}: figures and how to read them", markup=False, soft_wrap=True)
