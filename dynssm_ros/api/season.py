"""Seasons: many race logs to one data set, and its sessions in review."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from dynssm_ros.api.extract import ExtractSettings
from dynssm_ros.api.inputs import PathLike, signal_map_of, vehicle_in_windows, vehicle_of
from dynssm_ros.api.settings import WorkerSettings, keywords, setting
from dynssm_ros.errors import SettingError
from dynssm_ros.extras import require
from dynssm_ros.parallel import each
from dynssm_ros.progress import Progress
from dynssm_ros.signals.season import Season, Session, season_part
from dynssm_ros.signals.signal_map import SignalMap
from dynssm_ros.vehicle import Vehicle

if TYPE_CHECKING:
    from dynssm_ros.evaluation.season_review import Review


class ExtractSeasonSettings(ExtractSettings, WorkerSettings):
    """Settings of :func:`extract_season`."""

    car: str | None = setting(None, "Of a season: which car drove.")
    track: str | None = setting(None, "Of a season: where.")


@keywords(ExtractSeasonSettings)
def extract_season(
    bags: Sequence[PathLike],
    out: PathLike,
    signals: SignalMap | PathLike = "default",
    *,
    settings: ExtractSeasonSettings,
    on_progress: Progress | None = None,
) -> tuple[Season, list[Session]]:
    """Turns race logs into a season, one recording for each; those that are as they were are not read again.

    Args:
        bags: logs as of :func:`dynssm_ros.extract`. One that cannot be read is listed with its reason.
        out: folder of the season; sessions of other logs stay.
        signals: signal map: which field of which topic, or which column, is which signal.
        settings: all keywords as one object; workers of a cluster find logs and folder by the same paths.
        on_progress: called with the logs that are done.

    Returns:
        The season, and those of its sessions that were extracted now.

    Example:
        >>> logs = ["run_1", "run_2"]
        >>> season, new = extract_season(logs, "season", car="av21", track="putnam")  # doctest: +SKIP
        >>> [session.session for session in season.chosen()]  # doctest: +SKIP
        ['run_1', 'run_2']
    """
    from dynssm_ros.signals.season_extraction import extract_season, logs_of

    s = settings
    if s.car is None or s.track is None:
        raise SettingError("a season needs car and track; expected both", "car", "track")
    signal_map = signal_map_of(signals, s.commands)
    logs = logs_of([Path(bag) for bag in bags], s.car, s.track, signal_map, rate=s.rate, drop_bad=s.drop_bad)
    return extract_season(logs, out, s.workers, on_progress)


class SeasonSettings(WorkerSettings):
    """Settings of :func:`review_season`."""

    stretch: float | None = setting(
        None, "Length of the stretches that coefficients are of (s).", otherwise="whole sessions", ge=10.0
    )


@keywords(SeasonSettings)
def review_season(
    season: Season | PathLike,
    models: Sequence[PathLike],
    vehicle: Vehicle | PathLike,
    out: PathLike,
    *,
    settings: SeasonSettings,
    on_progress: Progress | None = None,
) -> list[Review]:
    """Looks at each session of a season: scores models, calibrates the car, and says what its simulation gets wrong.

    Args:
        season: its folder, or that of a part of it.
        models: folders or names; the calibrated car, and the same with an average of its errors, are scored beside them.
        vehicle: the car as it is known: simple models are of it, calibration and diagnosis start from it.
        out: folder for what is found in each session, which is not looked at again while it is as it was.
        settings: all keywords as one object; workers of a cluster find all folders by the same paths.
        on_progress: called with the sessions that are done.

    Returns:
        In the order of driving.

    Example:
        >>> for alarm in alarms(review_season("season", ["model"], "av21.yaml", "review")):  # doctest: +SKIP
        ...     print(alarm.review.session, alarm.words)
    """
    require("season", "train", "race")
    from dynssm_ros.evaluation.season_review import SIMPLE, review_again

    whole, chosen = (season, season.chosen()) if isinstance(season, Season) else season_part(season)
    names = [*dict.fromkeys([*map(str, models), *SIMPLE])]
    car = vehicle_of(vehicle)
    vehicle_in_windows(car)  # says once what models of windows leave out of it
    task = partial(review_again, names, car, Path(out), settings.stretch)
    sessions = [(session, whole.file(session.place)) for session in chosen]
    found: dict[int, Review] = {}
    for k, review in each(task, sessions, settings.workers):
        found[k] = review
        if on_progress is not None:
            on_progress(len(found), len(sessions))
    return [found[k] for k in sorted(found)]
