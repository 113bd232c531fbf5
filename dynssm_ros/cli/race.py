"""``dynssm race``: closed-loop laps, with each model in the controller in turn."""

from __future__ import annotations

from operator import attrgetter
from pathlib import Path
from typing import Annotated

import typer

from dynssm_ros.cli.console import JsonOption, VehicleOption, console, progress_bar, told_apart, write_results
from dynssm_ros.control.prediction_model import PredictionModel
from dynssm_ros.control.race import Course, Race, Start
from dynssm_ros.control.race import race as drive
from dynssm_ros.control.race_models import load_prediction_model
from dynssm_ros.control.reference import load_reference
from dynssm_ros.control.settings import Objective, Settings
from dynssm_ros.errors import ConfigurationError
from dynssm_ros.reporting.animation import animate
from dynssm_ros.reporting.race_report import race_json, race_report, race_table, summary
from dynssm_ros.simulation.plant import PlantKind
from dynssm_ros.track.tracks import Track, load_track
from dynssm_ros.vehicle import Vehicle, load_vehicle
from dynssm_ros.vehicle.effects import parse_effect


def race(
    vehicle: VehicleOption,
    track: Annotated[
        str, typer.Option(help="Track: oval, road_course, club, club_b, or a file x_m,y_m,w_tr_right_m,w_tr_left_m.")
    ],
    model: Annotated[
        list[str],
        typer.Option(
            help="Model folder, true (the plant's own model), single_track, single_track_ewma, persistence, or a vehicle "
            "file whose coefficients the controller takes for the car's; repeat to compare.",
            metavar="NAME_OR_DIR",
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder for report.html and results.json.", file_okay=False)],
    plant: Annotated[
        PlantKind,
        typer.Option(
            help="euler: one step per T_s, as in the published data; rk4: steps of 1 ms; double_track: four wheels."
        ),
    ] = "rk4",
    objective: Annotated[
        Objective,
        typer.Option(
            help="tracking: follow the line at its own speed, as in the literature; progress: get as far as possible "
            "between the borders, and end each horizon no faster than the line is there."
        ),
    ] = "tracking",
    laps: Annotated[int, typer.Option(help="Laps to drive.", min=1)] = 1,
    line: Annotated[
        str, typer.Option(help="Line to follow: centre, racing, or a file s_m,x_m,y_m,v_mps with its own speed.")
    ] = "racing",
    pace: Annotated[
        float,
        typer.Option(help="Share of the car's limits in the line's speed; of a file, factor on it.", min=0.1, max=2.0),
    ] = 1.0,
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
        typer.Option("--offset-free", help="Follow what each model mispredicts, and add it to what the model says."),
    ] = False,
    effect: Annotated[
        list[str] | None,
        typer.Option(
            help="Physics that the plant has and no model but true knows; repeatable.", metavar="NAME[:k=v,...]"
        ),
    ] = None,
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
    animation: Annotated[
        bool, typer.Option("--animation", help="Also write race.gif, the cars on the track at equal times.")
    ] = False,
    json: JsonOption = None,
) -> None:
    """Drive laps in closed loop: a predictive controller with each model in turn, on a simulated car."""
    car = load_vehicle(vehicle)
    driven = car.with_effects(map(parse_effect, effect or []))
    course_track = _sized(load_track(track), scale, lap_length)
    models = _load(model, car, driven, plant, along_horizon)
    reference = load_reference(line, car, course_track, pace)
    settings = Settings.of(car, objective, horizon, offset_free)
    course = Course(driven, course_track, plant, reference, settings, laps, Start(start, start_offset, start_speed))
    _written(_driven(course, models), out, animation, json)


def _written(races: list[Race], out: Path, animation: bool, json: Path | None) -> None:
    """The outcome as files, and in short on the terminal."""
    race_report(races).save(out / "report.html")
    if animation:
        animate(races, out / "race.gif")
    write_results(race_json(races), out, json)
    console.print(race_table(races).brief.rich())
    console.print(summary(races), markup=False, soft_wrap=True)
    console.print(f"{out / 'report.html'}: figures and how to read them", markup=False, soft_wrap=True)


def _driven(course: Course, model: list[PredictionModel]) -> list[Race]:
    """A race of each."""
    races = []
    with progress_bar("racing") as progress:
        for k, each in enumerate(model):

            def update(done: int, total: int, words: str, k: int = k) -> None:
                progress(k * total + done, len(model) * total, words)

            races.append(drive(course, each, update))
    return races


def _sized(track: Track, scale: float | None, lap_length: float | None) -> Track:
    """The track at the size asked for."""
    if scale is not None and lap_length is not None:
        raise ConfigurationError(f"--scale {scale:g} and --lap-length {lap_length:g}; expected one of them")
    if lap_length is not None:
        scale = lap_length / track.length
    return track if scale is None else track.scaled(scale)


def _load(
    given: list[str], known: Vehicle, driven: Vehicle, plant: PlantKind, along_horizon: bool
) -> list[PredictionModel]:
    """Opens the models; where two have the same name, what was given tells them apart.

    Raises:
        ConfigurationError: the same was given twice.
    """
    opened = {text: load_prediction_model(text, known, driven, plant, along_horizon) for text in given}
    for text in opened:
        if given.count(text) > 1:
            raise ConfigurationError(f"--model {text}: given twice; expected different models")
    for name, each in told_apart(opened, attrgetter("name")).items():
        each.name = name
    return list(opened.values())
