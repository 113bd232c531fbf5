"""Inputs of the verbs: vehicles, signal maps, recordings and tracks by name, by path, or as the object."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dynssm_ros.errors import DataWarning, RecordingError, SettingError
from dynssm_ros.runtime.plausibility import implausible_rows
from dynssm_ros.signals.consistency import checked
from dynssm_ros.signals.recording import Recording, concatenate
from dynssm_ros.signals.season import recording_files
from dynssm_ros.signals.signal_map import Commands, SignalMap, load_signal_map
from dynssm_ros.signals.spans import Drive
from dynssm_ros.vehicle import Vehicle, load_vehicle

if TYPE_CHECKING:
    from dynssm_ros.runtime.contract import WindowModel
    from dynssm_ros.track.tracks import Track

PathLike = str | Path
Log = Recording | PathLike
"""A recording, the Parquet file of one, or the folder of a season or of a part of it."""


def load_model(name_or_dir: PathLike, vehicle: Vehicle | PathLike | None = None) -> WindowModel:
    """Opens a trained model's folder, or one of the baselines ``persistence``, ``single_track``, ``single_track_ewma`` and
    ``single_track_ekf``.

    Example:
        >>> model = load_model("single_track", "orca")
        >>> model.H, model.T_s
        (1, 0.02)
    """
    from dynssm_ros.runtime.registry import load_model

    return load_model(name_or_dir, None if vehicle is None else vehicle_in_windows(vehicle))


def vehicle_of(vehicle: Vehicle | PathLike) -> Vehicle:
    """The car."""
    return vehicle if isinstance(vehicle, Vehicle) else load_vehicle(vehicle)


def vehicle_in_windows(vehicle: Vehicle | PathLike) -> Vehicle:
    """The car as a model of windows can have it; a :class:`DataWarning` names effects that are left out."""
    car = vehicle_of(vehicle)
    for effect in car.active_effects:
        if effect.needs:
            warnings.warn(
                f"vehicle {car.name}: {effect.NAME} reads {', '.join(effect.needs)}, which windows of rows do not tell, "
                "so that it is left to the online layer",
                DataWarning, stacklevel=3,
            )  # fmt: skip
    return car.in_windows


def signal_map_of(signals: SignalMap | PathLike, commands: Commands | None = None) -> SignalMap:
    """The signal map, with another source of the commands if given."""
    signal_map = signals if isinstance(signals, SignalMap) else load_signal_map(signals)
    return signal_map.with_commands(commands)


def track_of(track: Track | PathLike, *, closed: bool = True) -> Track:
    """The track, ``closed`` or of any kind; a :class:`DataWarning` names what was mended of a file's points.

    Raises:
        TrackError: no track, or an open road where a ``closed`` one is needed.
    """
    from dynssm_ros.track.tracks import Track, load_track

    found = track if isinstance(track, Track) else load_track(track)
    for words in found.notes if found is not track else ():
        warnings.warn(f"track {found.name}: {words}", DataWarning, stacklevel=3)
    return found.require_closed() if closed else found


def opened(logs: Log | Sequence[Log], car: Vehicle | None, *, strict: bool = False) -> list[Recording]:
    """Recordings, all of a season's folder; a :class:`DataWarning` names what of them the car cannot have done.

    Raises:
        RecordingError: ``strict``, and their signals contradict each other.
    """
    found = []
    for log in files(logs):
        recording = log if isinstance(log, Recording) else Recording.load(log)
        if car is not None:
            recording.require_set_point(car.inputs.set_point, f"vehicle {car.name}")
        if car is not None and math.isclose(car.sampling_time, recording.T_s):  # else the command ends with that
            for words in implausible_rows(recording, car):
                warnings.warn(f"{name_of(log)}: {words}", DataWarning, stacklevel=3)
        if car is None or math.isclose(car.sampling_time, recording.T_s):
            recording = checked(recording, None if car is None else car.constants.wheelbase)
            warn_of_findings(recording, name_of(log), strict=strict)
        found.append(recording)
    return found


def warn_of_findings(recording: Recording, name: str = "", *, strict: bool) -> None:
    """A :class:`DataWarning` for each contradiction between the signals of a recording, and for a car that never drives.

    Raises:
        RecordingError: ``strict``, and there is one.
    """
    drive = Drive.of(recording)
    fastest = f"v_x, v_y are up to {drive.speed.max(initial=0.0):.2g} m/s, noise around 0"
    stands = [f"the car stands throughout: {fastest}; expected a drive"] if drive.stands else []
    for told in (*stands, *(finding.line for finding in recording.info.findings)):
        words = f"{name or name_of(recording)}: {told}"
        if strict:
            raise RecordingError(words)
        warnings.warn(words, DataWarning, stacklevel=4)


def joined(
    recordings: Sequence[Recording], commands: Commands | None = None, shares: Mapping[str, float] | None = None
) -> Recording:
    """Recordings one after the other, each without its last share in ``shares``; see :func:`held_out`."""
    held = shares or {}
    return concatenate(
        [each.with_commands(commands).split_last(held.get(each.beginning, 0.0))[0] for each in recordings]
    )


def held_out(logs: Iterable[Recording | str], holdout: float | None, car: Vehicle) -> dict[str, float]:
    """Share at the end of each recording, or of its :attr:`Recording.beginning`, that is left out.

    It is ``holdout`` if given, else what the vehicle file says was left out of this recording before, else 0.
    """
    begins = [log.beginning if isinstance(log, Recording) else log for log in logs]
    return {each: car.held_out.get(each, 0.0) if holdout is None else holdout for each in begins}


def files(logs: Log | Sequence[Log]) -> Iterator[Log]:
    """Recordings or their files, those of seasons one by one."""
    for log in several(logs):
        yield from [log] if isinstance(log, Recording) else recording_files([log])


def several(logs: Log | Sequence[Log]) -> list[Log]:
    """One or more recordings as a list."""
    return [logs] if isinstance(logs, (Recording, str, Path)) else list(logs)


def name_of(log: Log) -> str:
    """A recording's sources, or its path."""
    return ", ".join(log.info.source) if isinstance(log, Recording) else str(log)


def centre_line(track: Track | PathLike, log: Recording) -> Any:
    """The centre line of a track on which the recording was driven."""
    import numpy as np

    road = track_of(track)
    if not log.has_pose:
        raise SettingError(f"track {track}: the recording holds no positions (x, y) to place on it", "track")
    _, lateral = road.project(np.stack([log["x"], log["y"]], axis=1))
    away, width = float(np.median(np.abs(lateral))), float(np.mean(road.width_left + road.width_right))
    if away > width:
        raise SettingError(
            f"track {track}: the recording lies {away:.3g} m (median) from its centre line; expected the same "
            f"coordinates, so at most the track's width of {width:.3g} m",
            "track",
        )
    return road.centre
