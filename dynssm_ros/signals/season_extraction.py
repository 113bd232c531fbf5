"""Race logs to a season: what is new or changed is read, on several processes if wanted."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from pathlib import Path

from dynssm_ros import __version__
from dynssm_ros.errors import ConfigurationError, SettingError, UserError
from dynssm_ros.files import content_key, digest, files_in, real_path, require_replaceable
from dynssm_ros.parallel import HERE, Workers, each
from dynssm_ros.progress import Progress
from dynssm_ros.signals.extraction import extract
from dynssm_ros.signals.season import Season, Session, address, is_season
from dynssm_ros.signals.signal_map import SignalMap

_NAME = re.compile(r"[\w.+-]+")


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
        return content_key([self.signal_map.model_dump(mode="json"), self.rate, self.drop_bad, __version__])


def logs_of(
    bags: Sequence[Path], car: str, track: str, signal_map: SignalMap, *, rate: float, drop_bad: bool
) -> list[Log]:
    """Bags as sessions that are named after them, and after their folder too where two have the same name.

    Raises:
        ConfigurationError: a name that is no folder's, or two bags that cannot be told apart.
    """
    names = [bag.name if os.path.isdir(bag) else bag.stem for bag in bags]
    names = [
        f"{real_path(bag).parent.name}-{name}" if names.count(name) > 1 else name
        for bag, name in zip(bags, names, strict=True)
    ]
    for what, name in (("car", car), ("track", track), *(("session", name) for name in names)):
        if not _NAME.fullmatch(name):
            raise SettingError(f"{what} '{name}': expected letters, digits and . _ + - alone", what)
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise ConfigurationError(f"session '{twice}': two bags of that name; expected different names or folders")
    return [Log(bag, car, track, name, signal_map, rate, drop_bad) for bag, name in zip(bags, names, strict=True)]


def extract_season(
    logs: Sequence[Log], out: str | Path, workers: Workers = HERE, progress: Progress | None = None
) -> tuple[Season, list[Session]]:
    """Extracts the logs that are new or changed into the season in the folder ``out``; others of it stay, and what is
    done stays done.

    Args:
        logs: of the season.
        out: its folder.
        workers: where logs are read; those of a cluster find them, and the folder, by the same paths.
        progress: told of each log that is done.

    Returns:
        The season, and those of its sessions that were extracted now.

    Raises:
        UserError: ``out`` is something else; the names of a log are those of others.
    """
    out = Path(out)
    require_replaceable(out, is_season(out) or (os.path.isdir(out) and not os.listdir(out)), "a season")
    season = Season.load(out) if is_season(out) else Season(out)
    logs = [_placed(season, log) for log in logs]
    out.mkdir(parents=True, exist_ok=True)
    wanted = [log for log in logs if not _is_as_it_was(season, log)]
    wanted.sort(
        key=lambda log: -sum(size for size, _ in _states(log.bag).values())
    )  # so that all processes end together
    done: list[Session] = []
    tasks = [(log, season.file(log.place)) for log in wanted]
    for _, session in each(_extracted, tasks, workers):
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
    known = next((each.session for each in here if each.bag == address(log.bag)), None)
    if known is not None:
        return replace(log, session=known)
    taken = {each.session: each.checksum for each in here}
    for name in (log.session, f"{real_path(log.bag).parent.name}-{log.session}"):
        if name not in taken or taken[name] == digest(log.bag):  # the same log, elsewhere
            return replace(log, session=name)
    raise UserError(f"{log.bag}: {season.path} has a session '{log.session}' of another log; expected another name")


def _is_as_it_was(season: Season, log: Log) -> bool:
    """Whether a log need not be read: same settings, and files of the same size and time, or else of the same content."""
    before = season.sessions.get(log.place)
    if (
        before is None
        or before.settings != log.settings
        or not (before.failure or os.path.isfile(season.file(log.place)))
    ):
        return False
    files = _states(log.bag)
    if files != before.files and digest(log.bag) != before.checksum:
        return False
    season.sessions[log.place] = before.model_copy(update={"files": files, "bag": address(log.bag)})
    return True


def _extracted(task: tuple[Log, Path]) -> Session:
    """Reads a log and writes its recording; a failure is part of the outcome."""
    log, target = task
    about = Session(
        car=log.car, track=log.track, session=log.session, bag=address(log.bag), files=_states(log.bag),
        checksum=digest(log.bag), settings=log.settings, signal_map=log.signal_map.name, rate=log.rate,
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
        "notes": (*recording.info.notes, *(finding.line for finding in recording.info.findings)),
    }
    return about.model_copy(update=found)


def _states(bag: Path) -> dict[str, tuple[int, int]]:
    """Size and time of change (ns) of the files of a bag, by their names in it; empty if there are none."""
    states = {str(file.relative_to(bag)): file.stat() for file in files_in(bag)}
    return {name: (state.st_size, state.st_mtime_ns) for name, state in states.items()}
