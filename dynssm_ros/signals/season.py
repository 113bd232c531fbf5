"""A season: the recordings of many logs as one partitioned Parquet data set, by car, track and session.

    season/
      _season.json                                      the manifest: bag, checksum, settings, quality of each session
      car=av21/track=putnam/session=run4_2/recording.parquet

Each file is a recording like any other, and pyarrow, pandas, DuckDB or Spark read the whole folder with its partitions.
Logs that are as they were are not read again; one that cannot be read is listed with its reason and stops nothing.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from pathlib import Path

from pydantic import Field, ValidationError

from dynssm_ros import __version__
from dynssm_ros.configuration import StrictModel, describe
from dynssm_ros.errors import ConfigurationError, RecordingError, UserError
from dynssm_ros.files import require_replaceable, write_json
from dynssm_ros.parallel import each
from dynssm_ros.progress import Progress
from dynssm_ros.signals.extraction import extract
from dynssm_ros.signals.recording import Recording
from dynssm_ros.signals.signal_map import SignalMap
from dynssm_ros.signals.where import condition

MANIFEST, FILE = "_season.json", "recording.parquet"
_NAME = re.compile(r"[\w.+-]+")
_CHUNK = 1 << 20  # bytes of a log that are summed at once


class Session(StrictModel):
    """A log of the season, and what became of it.

    What ``--where`` can ask for: car, track, session, start, rate, rows, seconds, segments.
    """

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


@dataclass(frozen=True)
class Log:
    """A log that is to be part of a season, and how it is read."""

    bag: Path
    car: str
    track: str
    session: str
    signal_map: SignalMap
    rate: float
    drop_bad: bool = False

    @property
    def place(self) -> tuple[str, str, str]:
        """As of :class:`Session`."""
        return self.car, self.track, self.session

    @property
    def settings(self) -> str:
        """See :class:`Session`."""
        content = [self.signal_map.model_dump(mode="json"), self.rate, self.drop_bad, __version__]
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


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

    def save(self) -> None:
        """Writes its manifest, atomically."""
        sessions = tuple(self.sessions[place] for place in sorted(self.sessions))
        write_json(self.path / MANIFEST, Manifest(sessions=sessions).model_dump(mode="json"))

    def of_bags(self, bags: Sequence[Path]) -> list[Session]:
        """The sessions of some logs."""
        places = {_address(bag) for bag in bags}
        return [each for each in self.sessions.values() if each.bag in places]

    def file(self, of: Session | Log) -> Path:
        """The recording of a session."""
        return self.path / f"car={of.car}" / f"track={of.track}" / f"session={of.session}" / FILE

    def chosen(self, where: str | None = None) -> list[Session]:
        """Sessions with a recording that meet a condition (see :mod:`dynssm_ros.signals.where`), in the order of driving.

        Raises:
            ConfigurationError: the condition is none.
            RecordingError: no session meets it.
        """
        fits = condition(where, [name for name in Session.model_fields if name in _ASKED]) if where else None
        there = [each for each in self.sessions.values() if not each.failure]
        found = [each for each in there if fits is None or fits(each.model_dump())]
        if not found:
            asked = f" --where {where!r}" if where else ""
            raise RecordingError(f"{self.path}{asked}: none of {len(there)} sessions; `dynssm inspect` lists them")
        return sorted(found, key=lambda each: (each.start, each.place))

    def recordings(self, where: str | None = None) -> Iterator[Recording]:
        """The recordings of :meth:`chosen` sessions, one by one."""
        for session in self.chosen(where):
            yield Recording.load(self.file(session))


_ASKED = ("car", "track", "session", "start", "rate", "rows", "seconds", "segments")


def is_season(path: str | Path) -> bool:
    """Whether a folder holds a season."""
    return (Path(path) / MANIFEST).is_file()


def logs_of(
    bags: Sequence[Path], car: str, track: str, signal_map: SignalMap, rate: float, drop_bad: bool
) -> list[Log]:
    """Bags as sessions that are named after them, and after their folder too where two have the same name.

    Raises:
        ConfigurationError: a name that is no folder's, or two bags that cannot be told apart.
    """
    names = [bag.name if bag.is_dir() else bag.stem for bag in bags]
    names = [
        f"{bag.resolve().parent.name}-{name}" if names.count(name) > 1 else name
        for bag, name in zip(bags, names, strict=True)
    ]
    for what, name in (("--car", car), ("--track", track), *(("session", name) for name in names)):
        if not _NAME.fullmatch(name):
            raise ConfigurationError(f"{what} '{name}': expected letters, digits and . _ + - alone")
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise ConfigurationError(f"session '{twice}': two bags of that name; expected different names or folders")
    return [Log(bag, car, track, name, signal_map, rate, drop_bad) for bag, name in zip(bags, names, strict=True)]


def extract_season(
    logs: Sequence[Log], out: str | Path, jobs: int = 1, progress: Progress | None = None
) -> tuple[Season, list[Session]]:
    """Extracts the logs that are new or changed into the season in a folder; others of it stay.

    The manifest is written after each log, so what is done stays done.

    Args:
        logs: of the season.
        out: its folder.
        jobs: processes.
        progress: told of each log that is done.

    Returns:
        The season, and those of its sessions that were extracted now.

    Raises:
        UserError: ``out`` is something else; the names of a log are those of others.
    """
    out = Path(out)
    require_replaceable(out, is_season(out) or (out.is_dir() and not any(out.iterdir())), "a season")
    season = Season.load(out) if is_season(out) else Season(out)
    logs = [_placed(season, log) for log in logs]
    out.mkdir(parents=True, exist_ok=True)
    wanted = [log for log in logs if not _is_as_it_was(season, log)]
    done: list[Session] = []
    tasks = [(log, season.file(log)) for log in wanted]
    for _, session in each(_extracted, tasks, jobs):
        season.sessions[session.place] = session
        season.save()
        done.append(session)
        if progress is not None:
            progress(len(done), len(wanted))
    season.save()
    return season, done


def _placed(season: Season, log: Log) -> Log:
    """The log with the name of its session: that which it has, else its own, else with its folder's in front.

    Raises:
        UserError: these are the names of other logs.
    """
    here = [each for each in season.sessions.values() if each.place[:2] == log.place[:2]]
    known = next((each.session for each in here if each.bag == _address(log.bag)), None)
    if known is not None:
        return replace(log, session=known)
    taken = {each.session: each.checksum for each in here}
    for name in (log.session, f"{log.bag.resolve().parent.name}-{log.session}"):
        if name not in taken or taken[name] == checksum(log.bag):  # the same log, elsewhere
            return replace(log, session=name)
    raise UserError(f"{log.bag}: {season.path} has a session '{log.session}' of another log; expected another name")


def _address(bag: Path) -> str:
    return str(bag.resolve())


def _is_as_it_was(season: Season, log: Log) -> bool:
    """Whether a log need not be read: same settings, and files of the same size and time, or else of the same content."""
    before = season.sessions.get(log.place)
    if before is None or before.settings != log.settings or not (before.failure or season.file(before).is_file()):
        return False
    files = _files(log.bag)
    if files != before.files and checksum(log.bag) != before.checksum:
        return False
    season.sessions[log.place] = before.model_copy(update={"files": files, "bag": _address(log.bag)})
    return True


def _extracted(task: tuple[Log, Path]) -> Session:
    """Reads a log and writes its recording; a failure is part of the outcome."""
    log, target = task
    about = Session(
        car=log.car, track=log.track, session=log.session, bag=_address(log.bag), files=_files(log.bag),
        checksum=checksum(log.bag), settings=log.settings, signal_map=log.signal_map.name, rate=log.rate,
    )  # fmt: skip
    try:
        recording = extract([log.bag], log.signal_map, log.rate, log.drop_bad)
        target.parent.mkdir(parents=True, exist_ok=True)
        recording.save(target)
    except UserError as error:
        target.unlink(missing_ok=True)  # an older recording is not this log's any more
        return about.model_copy(update={"failure": str(error)})
    start = datetime.fromtimestamp(int(recording.time[0]) / 1e9, timezone.utc)
    found = {
        "start": start.isoformat(timespec="seconds"),
        "rows": len(recording),
        "seconds": round(recording.duration, 3),
        "segments": int(recording.segment[-1]) + 1,
        "notes": recording.info.notes,
    }
    return about.model_copy(update=found)


def _files(bag: Path) -> dict[str, tuple[int, int]]:
    """Size and time of change (ns) of the files of a bag, by their names in it; empty if there are none."""
    files = sorted(bag.rglob("*")) if bag.is_dir() else [bag]
    found = {}
    for file in files:
        if file.is_file():
            status = os.stat(file)
            found[str(file.relative_to(bag)) if bag.is_dir() else file.name] = (status.st_size, status.st_mtime_ns)
    return found


def checksum(bag: Path) -> str:
    """SHA-256 of the files of a bag and their names."""
    total = hashlib.sha256()
    for name in _files(bag):
        total.update(f"{name}\0".encode())
        with open(bag / name if bag.is_dir() else bag, "rb") as file:
            while chunk := file.read(_CHUNK):
                total.update(chunk)
    return total.hexdigest()
