"""Simulation: laps of a simulated car around a track."""

from __future__ import annotations

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
from dynssm_ros.extras import require
from dynssm_ros.progress import Progress
from dynssm_ros.signals.recording import Recording
from dynssm_ros.vehicle import Vehicle

if TYPE_CHECKING:
    from dynssm_ros.simulation.laps import Run
    from dynssm_ros.track.tracks import Track


class SimulateSettings(VerbSettings):
    """Settings of :func:`simulate`."""

    duration: float | None = setting(None, "Time to drive (s).", otherwise="60, if there are no laps either", gt=0.0)
    laps: float | None = setting(None, "Laps to drive (number), instead of a duration.", gt=0.0)
    plant: str = setting("euler", PLANT_HELP)
    line: Literal["centre", "racing"] = setting(
        "centre", "What the driver follows: the centre line or the racing line."
    )
    seed: int = setting(0, "Of the driver's variation and the noise.", ge=0)
    aggressiveness: float = setting(0.95, "Share of the car's limits in use.", ge=0.1, le=1.2)
    variation: float = setting(0.5, "How much speed and line vary.", ge=0.0, le=1.0)
    noise: StandardDeviations = NOISE
    effects: Effects = EFFECTS
    scale: float = setting(1.0, "Size of the track (factor), for other cars than it was made for.", gt=0.0)


@keywords(SimulateSettings)
def simulate(
    vehicle: Vehicle | PathLike,
    track: Track | PathLike,
    *,
    settings: SimulateSettings,
    on_progress: Progress | None = None,
) -> Run:
    """Drives a simulated car around a track.

    Args:
        vehicle: the car.
        track: ``oval``, ``road_course``, ``club``, ``club_b``, or a file ``x_m,y_m,w_tr_right_m,w_tr_left_m``.
        settings: all keywords as one object.
        on_progress: called with simulated milliseconds or metres.

    Example:
        >>> run = simulate("orca", "club", duration=2.0, effects={"front_grip": {"factor": 0.9}})
        >>> run.state.shape
        (101, 3)
    """
    require("simulate", "race")
    from dynssm_ros.simulation.laps import simulate
    from dynssm_ros.track.driver import Style
    from dynssm_ros.track.racing_line import line_of

    car, s = vehicle_of(vehicle).with_effects(settings.effects.items()), settings
    course = track_of(track, closed=False).scaled(s.scale)
    duration = 60.0 if s.duration is None and s.laps is None else s.duration
    return simulate(
        car, course, duration=duration, laps=s.laps, plant=s.plant, seed=s.seed,
        style=Style(s.aggressiveness, s.variation), line=line_of(s.line, car, course), noise=s.noise,
        progress=on_progress,
    )  # fmt: skip


def recorded(run: Run) -> Recording:
    """A simulated drive as a recording, as if it had been written to a bag and extracted.

    Example:
        >>> len(recorded(simulate("orca", "club", duration=1.0)))
        51
    """
    from dynssm_ros.simulation.laps import as_recording

    return as_recording(run)
