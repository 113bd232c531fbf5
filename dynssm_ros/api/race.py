"""Races: laps in closed loop, with each model in the controller in turn."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

from dynssm_ros.api.inputs import PathLike, track_of, vehicle_of
from dynssm_ros.api.settings import (
    EFFECTS,
    NOISE,
    PLANT_HELP,
    Effects,
    StandardDeviations,
    VerbSettings,
    keywords,
    setting,
)  # fmt: skip
from dynssm_ros.errors import SettingError
from dynssm_ros.extras import require
from dynssm_ros.progress import NamedProgress
from dynssm_ros.vehicle import Vehicle

if TYPE_CHECKING:
    from dynssm_ros.control.race import Race
    from dynssm_ros.track.tracks import Track


class RaceSettings(VerbSettings):
    """Settings of :func:`race`."""

    plant: str = setting("rk4", PLANT_HELP)
    objective: Literal["tracking", "progress"] = setting(
        "tracking",
        "tracking: follow the line at its own speed, as in the literature; progress: get as far as possible between "
        "the borders, and end each horizon no faster than corners and brakes ahead allow.",
    )
    laps: int = setting(1, "Laps to drive.", ge=1)
    line: str = setting("racing", "Line to follow: centre, racing, or a file s_m,x_m,y_m,v_mps with its own speed.")
    speed_scale: float | None = setting(
        None,
        "Share of the car's limits in the line's speed; of a file, factor on it.",
        otherwise="1; 0.7 to begin with for a car that learns",
        ge=0.1,
        le=2.0,
    )
    learn: bool = setting(
        False, "Drive each section of the lap faster every lap, as far as the laps so far have shown it is safe."
    )
    horizon: int | None = setting(
        None, "Steps of T_s that are planned ahead.", otherwise="as the car needs: orca 15, av21 40", ge=2, le=100
    )
    along_horizon: bool = setting(False, "Read the models anew at every step of the horizon.")
    offset_free: bool = setting(
        False, "Follow what each model mispredicts at a fixed rate, not at one that the data choose."
    )
    as_is: bool = setting(
        False, "Plan with what each model says, whether or not it has predicted better than the calibrated car."
    )
    effects: Effects = EFFECTS
    scale: float | None = setting(None, "Size of the track (factor), for other cars than it was made for.", gt=0.0)
    lap_length: float | None = setting(
        None, "Or scale it to this length (m): 401 for Austin, 291 for IMS with the 1:43 car.", gt=0.0
    )
    start: float = setting(0.0, "Where the car starts on the centre line (m).")
    start_offset: float = setting(0.0, "How far left of the line it starts (m).")
    start_speed: float | None = setting(
        None, "How fast it starts (m/s); 0: from standstill.", otherwise="the line's own speed"
    )
    noise: StandardDeviations = NOISE
    pose_noise: StandardDeviations = setting((0.0, 0.0, 0.0), "Likewise of the measured x,y,theta (m, m, rad).")
    delay: float = setting(
        0.0,
        "From an instant until the command that answers it acts (s), in whole sampling times; known to the controller.",
        milliseconds=True,
        ge=0.0,
    )
    seed: int = setting(0, "Of the noise.", ge=0)


@keywords(RaceSettings)
def race(
    vehicle: Vehicle | PathLike,
    track: Track | PathLike,
    models: Sequence[str],
    *,
    settings: RaceSettings,
    on_progress: NamedProgress | None = None,
) -> list[Race]:
    """Drives laps in closed loop: a predictive controller with each model in turn, on a simulated car.

    Args:
        vehicle: the car.
        track: where.
        models: ``true`` (the plant's own), vehicle files, model folders, or names of baselines.
        settings: all keywords as one object.
        on_progress: called with millimetres driven and the model's name.

    Example:
        >>> (lap,) = race("orca", "club", ["true"], speed_scale=0.8)
        >>> lap.completed, lap.outside
        (True, 0.0)
    """
    require("race", "race")
    from dynssm_ros.control.lap_learning import SAFE
    from dynssm_ros.control.race import Course, Start, race
    from dynssm_ros.control.race_models import load_prediction_model
    from dynssm_ros.control.reference import load_reference
    from dynssm_ros.control.settings import Settings
    from dynssm_ros.runtime.registry import disambiguated
    from dynssm_ros.simulation.sensing import Sensing

    s, car = settings, vehicle_of(vehicle)
    driven = car.with_effects(s.effects.items())
    road = _sized(track_of(track, closed=False), s)
    for text in models:
        if list(models).count(text) > 1:
            raise SettingError(f"model {text}: given twice; expected different models", "model")
    opened = {
        text: load_prediction_model(text, car, driven, s.plant, along_horizon=s.along_horizon, as_is=s.as_is)
        for text in models
    }
    for name, model in disambiguated(opened, lambda model: model.name).items():
        model.name = name
    scale = (SAFE if s.learn else 1.0) if s.speed_scale is None else s.speed_scale
    course = Course(
        driven, road, s.plant, load_reference(s.line, car, road, scale),
        Settings.of(car, s.objective, s.horizon, offset_free=s.offset_free, evidence=not s.as_is), s.laps,
        Start(s.start, s.start_offset, s.start_speed), Sensing(s.noise, s.pose_noise, s.delay, s.seed),
        car if s.learn else None,
    )  # fmt: skip
    races = []
    for k, model in enumerate(opened.values()):

        def report(done: int, total: int, words: str, k: int = k) -> None:
            if on_progress is not None:
                on_progress(k * total + done, len(opened) * total, words)

        races.append(race(course, model, report))
    return races


def _sized(track: Track, settings: RaceSettings) -> Track:
    """The track at the size asked for."""
    scale, length = settings.scale, settings.lap_length
    if scale is not None and length is not None:
        raise SettingError(f"scale {scale:g} and lap_length {length:g}; expected one of them", "scale", "lap_length")
    if length is not None:
        scale = length / track.length
    return track if scale is None else track.scaled(scale)
