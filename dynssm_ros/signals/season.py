"""A season: the recordings of many logs as one partitioned Parquet data set, by car, track and session.

    season/
      _season.json                                      the manifest: bag, checksum, settings, quality of each session
      car=av21/track=putnam/session=run4_2/recording.parquet

Each file is a recording like any other, and pyarrow, pandas, DuckDB or Spark read the whole folder with its partitions.
Logs that are as they were are not read again; one that cannot be read is listed with its reason and stops nothing.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from pydantic import Field, ValidationError

from dynssm_ros.configuration import StrictModel, describe
from dynssm_ros.errors import RecordingError
from dynssm_ros.files import real_path, write_json
from dynssm_ros.signals.recording import Recording

MANIFEST, FILE = "_season.json", "recording.parquet"


class Session(StrictModel):
    """A log of the season, and what became of it."""

    car: str
    track: str
    session: str
    bag: str = Field(description="where the log was")
    files: dict[str, tuple[int, int]] = Field(description="of the log: size and time of change (ns)")
    checksum: str = Field(description="SHA-256 of the log's files and their names")
    settings: str = Field(description="SHA-256 of signal map, rate, options and version")
    signal_map: str
    rate: float
    start: str = Field(default="", description="of the first row, UTC")
    rows: int = 0
    seconds: float = 0.0
    segments: int = 0
    notes: tuple[str, ...] = Field(default=(), description="what was recovered, dropped or bridged")
    failure: str = Field(default="", description="why there is no recording; empty if there is one")

    @property
    def place(self) -> tuple[str, str, str]:
        """Car, track and session: no two are at the same."""
        return self.car, self.track, self.session


class Manifest(StrictModel):
    """Content of ``_season.json``."""

    version: int = Field(default=1, ge=1, le=1, description="format version")
    sessions: tuple[Session, ...] = ()


class Season:
    """The data set in a folder."""

    def __init__(self, path: str | Path, sessions: Iterable[Session] = ()) -> None:
        self.path = Path(path)
        self.sessions = {each.place: each for each in sessions}

    @classmethod
    def load(cls, path: str | Path) -> Season:
        """Reads its manifest.

        Raises:
            RecordingError: there is none, or it is damaged.
        """
        file = Path(path) / MANIFEST
        try:
            manifest = Manifest.model_validate_json(file.read_bytes())
        except OSError as error:
            raise RecordingError(f"{path}: no season; `dynssm extract --out` makes one from bags") from error
        except ValidationError as error:
            raise RecordingError(f"{file}: not understood: {describe(error)}") from error
        return cls(path, manifest.sessions)

    def to_json(self) -> dict[str, Any]:
        """Its manifest."""
        sessions = tuple(self.sessions[place] for place in sorted(self.sessions))
        return Manifest(sessions=sessions).model_dump(mode="json")

    def save(self) -> None:
        """Writes its manifest, atomically."""
        write_json(self.path / MANIFEST, self.to_json())

    def of_bags(self, bags: Sequence[Path]) -> list[Session]:
        """The sessions of some logs."""
        places = {address(bag) for bag in bags}
        return [each for each in self.sessions.values() if each.bag in places]

    def file(self, place: tuple[str, str, str]) -> Path:
        """The recording of the session at a place."""
        car, track, session = place
        return self.path / f"car={car}" / f"track={track}" / f"session={session}" / FILE

    def chosen(self, folder: str | Path | None = None) -> list[Session]:
        """Sessions with a recording, all or those in a folder of the season, in the order of driving.

        Raises:
            RecordingError: there is none.
        """
        within = real_path(folder or self.path)
        there = [each for each in self.sessions.values() if not each.failure]
        found = [each for each in there if real_path(self.file(each.place)).is_relative_to(within)]
        if not found:
            raise RecordingError(f"{folder or self.path}: none of {len(there)} sessions; `dynssm inspect` lists them")
        return sorted(found, key=lambda each: (each.start, each.place))

    def files(self, folder: str | Path | None = None) -> list[Path]:
        """Where the recordings of :meth:`chosen` sessions lie."""
        return [self.file(session.place) for session in self.chosen(folder)]

    def recordings(self, folder: str | Path | None = None) -> Iterator[Recording]:
        """The recordings of :meth:`chosen` sessions, one by one."""
        return map(Recording.load, self.files(folder))


def address(bag: Path) -> str:
    """By which the manifest names a log."""
    return str(real_path(bag))


def is_season(path: str | Path) -> bool:
    """Whether a folder holds a season."""
    return os.path.isfile(Path(path) / MANIFEST)


def season_part(folder: str | Path) -> tuple[Season, list[Session]]:
    """The season that a folder is or is a part of, and its sessions in there, in the order of driving.

    Raises:
        RecordingError: there is no session with a recording.
    """
    path = Path(folder)
    root = next((each for each in (path, *real_path(path).parents) if is_season(each)), path)
    season = Season.load(root)
    return season, season.chosen(path)


def recording_files(paths: Sequence[str | Path]) -> list[Path]:
    """Recordings as they are, and in place of each folder of a season those of its sessions.

    Raises:
        RecordingError: a folder has no session with a recording.
    """
    found = []
    for path in map(Path, paths):
        if os.path.isdir(path):
            season, sessions = season_part(path)
            found += [season.file(session.place) for session in sessions]
        else:
            found.append(path)
    return found
