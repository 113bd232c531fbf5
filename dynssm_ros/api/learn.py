"""Learning in one go: logs to a car, a diagnosis, a model and one report. Each step is a command of its own."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dynssm_ros import __version__
from dynssm_ros.api.inputs import PathLike
from dynssm_ros.api.settings import CommandsSettings, keywords, setting
from dynssm_ros.configuration import find_config
from dynssm_ros.errors import ConfigurationError, UserError
from dynssm_ros.extras import require
from dynssm_ros.files import content_key, digest, forced, require_no_input, require_replaceable, write_json
from dynssm_ros.progress import OnProgress
from dynssm_ros.signals.map_differences import differences
from dynssm_ros.signals.signal_map import load_signal_map
from dynssm_ros.vehicle import load_vehicle

if TYPE_CHECKING:
    from dynssm_ros.reporting.learning_report import StepRecord

STATE = "learn.json"
_MARKS = ("warning: ", "note: ")
_WIDTH = "120"  # of what a step prints, which is no terminal


class LearnSettings(CommandsSettings):
    """Settings of :func:`learn`."""

    signals: str | None = setting(
        None, "Signal map: name of a shipped one or a file.", otherwise="inspect's suggestion for the first log"
    )
    rate: float | None = setting(
        None, "Rate of the recordings (Hz).", otherwise="that of the vehicle file", ge=1.0, le=1000.0
    )
    holdout: float = setting(0.25, "Share at the end of each recording that only tests.", ge=0.05, le=0.8)
    model: str = setting("rls", "Model: name of a shipped one (rls, dynssm, ridge, ...) or a file.")
    track: str | None = setting(
        None, "Track along which places are counted: built-in name or file.", otherwise="the first full lap"
    )
    exclude: tuple[str, ...] = setting(
        (), "Effect that is impossible there, such as crosswind in a hall; repeat for more."
    )
    jobs: int | None = setting(None, "Pieces of work at a time.", otherwise="one", ge=1)


@dataclass(frozen=True)
class LearningStep:
    """A command, what it reads and what it writes."""

    name: str
    command: tuple[str, ...]
    inputs: tuple[Path, ...]
    outputs: tuple[Path, ...]

    @property
    def words(self) -> str:
        """As one types it."""
        return shlex.join(("dynssm", *self.command))

    @property
    def key(self) -> str:
        """Changes with the command, with what it reads and with the version of the package."""
        return content_key([__version__, self.command, [digest(path) for path in self.inputs]])


@dataclass(frozen=True)
class Learning:
    """What became of each step.

    Attributes:
        out: folder with ``index.html`` and a folder or file of each step.
        records: of the steps, in order; the last one may have failed.
    """

    out: Path
    records: tuple[StepRecord, ...] = field(default=())

    @property
    def failure(self) -> str:
        """The error of the step that failed, empty if none did."""
        return next((record.failure for record in self.records if record.failure), "")


@keywords(LearnSettings)
def learn(
    logs: PathLike | Sequence[PathLike],
    vehicle: PathLike,
    out: PathLike,
    *,
    settings: LearnSettings,
    on_progress: OnProgress | None = None,
) -> Learning:
    """Goes from logs to a car, a diagnosis, a model and its test; writes ``OUT/index.html``, which begins with the verdicts.

    A step whose output is there and whose command and inputs are as they were is not run again. After a failed step the
    report says how far it came; the same call continues.

    Args:
        logs: of one car, each extracted for itself.
        vehicle: name of a shipped vehicle, or a file.
        out: folder to write.
        settings: all keywords as one object.
        on_progress: called with each line that a step prints.

    Raises:
        ConfigurationError: no log, a file that is not there, or a folder that something else wrote.

    Example:
        >>> found = learn("laps_bag", "orca", "learned")  # doctest: +SKIP
        >>> found.failure  # doctest: +SKIP
        ''
    """
    require("learn", "train", "race", "report")
    from dynssm_ros.reporting.learning_report import StepRecord, learning_report

    folder, told = Path(out), on_progress or (lambda words: None)
    require_no_input(folder)
    require_replaceable(
        folder,
        os.path.isfile(folder / STATE) or (os.path.isdir(folder) and not any(folder.iterdir())),
        "a folder of dynssm learn",
    )
    known: dict[str, Any] = json.loads((folder / STATE).read_text())["steps"] if os.path.isfile(folder / STATE) else {}
    given = [logs] if isinstance(logs, (str, Path)) else logs
    steps = list(plan(list(map(Path, given)), str(vehicle), folder, settings))
    records: list[StepRecord] = []
    for number, step in enumerate(steps, 1):
        told(f"[{number}/{len(steps)}] {step.words}")
        key, before = step.key, known.get(step.words)
        if before and before["key"] == key and not before["failure"] and all(map(os.path.exists, step.outputs)):
            told("as before")
            record = StepRecord.model_validate(before)
        else:
            record = _done(step, key, told)
        known[step.words] = record.model_dump(mode="json")
        write_json(folder / STATE, {"steps": known})
        if step.name == "inspect" and not record.failure:  # not kept: maps may be corrected, and are not written anew
            record = _with_maps(record, step.outputs[0], steps[0].outputs[0], str(vehicle), settings.signals, told=told)
        records.append(record)
        if record.failure:
            break
    learning_report(folder, records, settings.holdout).save(folder / "index.html")
    return Learning(folder, tuple(records))


def plan(logs: Sequence[Path], vehicle: str, out: Path, settings: LearnSettings) -> Iterator[LearningStep]:
    """The steps, in order."""
    s, car, names = settings, find_config("vehicles", vehicle), _names(logs)
    if not logs:
        raise ConfigurationError("no log given; expected LOG...")
    for log in logs:
        if not os.path.exists(log):
            raise ConfigurationError(f"{log}: no such log")
    words: tuple[str, ...]
    rate = f"{s.rate or 1 / load_vehicle(vehicle).sampling_time:g}"
    for log, name in zip(logs, names, strict=True):
        seen = out / "inspection" / name
        words = ("inspect", str(log), "--vehicle", vehicle, "--out", str(seen), "--json", str(seen / "inspection.json"))
        yield LearningStep("inspect", words, (log, car), (seen / "signals.yaml", seen / "inspection.json"))
    signals = s.signals or str(out / "inspection" / names[0] / "signals.yaml")
    chosen = find_config("signals", signals) if s.signals else Path(signals)
    commands = () if s.commands is None else ("--commands", s.commands)
    recordings = [out / "recordings" / f"{name}.parquet" for name in names]
    for log, recording in zip(logs, recordings, strict=True):
        words = ("extract", str(log), "--signals", signals, "--rate", rate, *commands, "--out", str(recording))
        yield LearningStep("extract", words, (log, chosen), (recording,))
    laps, track = tuple(map(str, recordings)), () if s.track is None else ("--track", s.track)
    roads = (Path(s.track),) if s.track and os.path.isfile(s.track) else ()
    excluded = [word for effect in s.exclude for word in ("--exclude", effect)]
    jobs = () if s.jobs is None else ("--jobs", str(s.jobs))
    fitted, found = out / "car.yaml", out / "diagnosis" / "vehicle.yaml"
    figures = out / "calibration.json"
    words = (
        "calibrate", *laps, "--vehicle", vehicle, "--holdout", f"{s.holdout:g}", *track, "--out", str(fitted),
        "--json", str(figures),
    )  # fmt: skip
    yield LearningStep("calibrate", words, (*recordings, car, *roads), (fitted, figures))
    words = ("diagnose", *laps, "--vehicle", str(fitted), *track, *excluded, *jobs, "--out", str(out / "diagnosis"))
    yield LearningStep("diagnose", words, (*recordings, fitted, *roads), (found, out / "diagnosis" / "results.json"))
    model = out / "model"
    words = ("train", *laps, "--model", s.model, "--vehicle", str(found), "--out", str(model))
    yield LearningStep("train", words, (*recordings, found, find_config("models", s.model)), (model,))
    rivals = ("--model", "single_track", "--model", "persistence", "--vehicle", str(found))
    words = ("evaluate", *laps, "--model", str(model), *rivals, *track, *jobs, "--out", str(out / "evaluation"))
    yield LearningStep("evaluate", words, (*recordings, model, found, *roads), (out / "evaluation" / "results.json",))


def _with_maps(
    record: StepRecord, suggested: Path, first: Path, vehicle: str, signals: str | None, *, told: OnProgress
) -> StepRecord:
    """The record of an inspection with what its map says beside the car and the map of the first log."""
    words = _compared(suggested, first, signals)
    for line in words:
        told(line)
    failure = _misfit(first, vehicle, signals) if suggested == first else ""
    return record.model_copy(update={"notes": (*record.notes, *words), "failure": failure})


def _misfit(suggested: Path, vehicle: str, signals: str | None) -> str:
    """Why what a signal map gives is not what the car takes, found before anything else is done; empty if it is."""
    from dynssm_ros.signals.recording import require_set_point

    try:
        of, car = load_signal_map(signals or suggested), load_vehicle(vehicle)
        require_set_point(f"signal map {of.name}", of.set_point, car.inputs.set_point, f"vehicle {car.name}")
    except UserError as error:
        return str(error)
    return ""


def _compared(suggested: Path, first: Path, signals: str | None) -> list[str]:
    """A warning for each signal for which a log suggests something else than the first one, whose map all take."""
    if signals is not None or suggested == first:
        return []
    try:
        told = differences(load_signal_map(first), load_signal_map(suggested))
    except UserError:  # an incomplete map is told where it is needed
        return []
    log, taken = suggested.parent.name, first.parent.name
    remedy = f"taken for all logs is {first}: correct it, or leave out the log that is wrong"
    return [
        f"warning: {log}: {name}: {here} suits this log, {there} suits {taken}; {remedy}" for name, here, there in told
    ]


def _names(logs: Sequence[Path]) -> list[str]:
    """Of the logs' files and folders; a number tells those of one name apart."""
    stems = [log.stem if os.path.isfile(log) else log.absolute().name for log in logs]
    return [f"{stem}_{k}" if stems.count(stem) > 1 else stem for k, stem in enumerate(stems, 1)]


def _done(step: LearningStep, key: str, told: OnProgress) -> StepRecord:
    """What became of a step that was run."""
    from dynssm_ros.reporting.learning_report import StepRecord

    lines, begin = list[str](), time.monotonic()

    def on_line(line: str) -> None:
        lines.append(line)
        told(line)

    status = _in_a_process([*(["--force"] if forced() else []), *step.command], on_line)
    errors = [line.removeprefix("error: ") for line in lines if line.startswith("error: ")]
    return StepRecord(
        name=step.name, command=step.words,
        outputs=tuple(map(str, step.outputs)), key=key, seconds=round(time.monotonic() - begin, 1),
        notes=tuple(line for line in lines if line.startswith(_MARKS)),
        failure="" if status == 0 else (errors or [f"{step.name} ended with status {status}"])[-1],
    )  # fmt: skip


def _in_a_process(command: Sequence[str], on_line: OnProgress) -> int:
    """Runs a command of ``dynssm``, calls with each line that it prints, returns its exit status."""
    words = [sys.executable, "-m", "dynssm_ros.cli.main", *command]
    with subprocess.Popen(  # noqa: S603 - own command
        words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=os.environ | {"COLUMNS": _WIDTH}
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            on_line(line.rstrip())
    return process.returncode
