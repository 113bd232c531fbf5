"""Kills commands at random instants: ``python -m benchmarks.endurance.kills --kills 100``.

Each command is run once to its end. Then it is started again and again where its older output lies, and killed (SIGKILL)
at an instant that is drawn between its start and the time that it took. What lies there afterwards must be the older
output, byte by byte, or a complete newer one. A training is not begun anew but goes on after each kill, and its weights
must be those of one that was never killed. In the end the command runs through once more, and nothing may be left beside
its output. Ends with status 1 otherwise.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from dynssm_ros.cli.console import console, progress_bar
from dynssm_ros.errors import UserError
from dynssm_ros.files import checksum, files_in

_WEIGHTS = "*.safetensors"


@dataclass(frozen=True)
class Command:
    """A command that writes an output."""

    name: str  # of the command
    arguments: tuple[str, ...]  # of ``dynssm``, without the output
    out: str  # name of the output
    resumes: bool = False  # whether it goes on after a kill; then the older output is taken away first


@dataclass
class Outcome:
    """What came of the kills of one command."""

    kills: int = 0  # processes that were killed before they ended
    older: int = 0  # after which the older output was there, or none if there was none
    newer: int = 0  # after which a complete newer one was
    faults: list[str] = field(default_factory=list)  # what must not happen, in words


def commands(folder: Path) -> list[Command]:
    """What is killed, over a drive and a model that :func:`prepare` made in ``folder``."""
    bag, laps, model = (str(folder / name) for name in ("bag", "laps.parquet", "model"))
    car = ("--vehicle", "orca")
    return [
        Command("extract", ("extract", bag, "--signals", "default", "--rate", "50"), "laps.parquet"),
        Command("train", ("train", laps, *car, "--model", "dynssm", "--epochs", "2"), "model", resumes=True),
        Command("evaluate", ("evaluate", laps, *car, "--model", model, "--model", "single_track"), "evaluation"),
        Command("replay", ("replay", bag, "--model", model), "predictions"),
        Command("diagnose", ("diagnose", laps, *car), "diagnosis"),
        Command("race", ("race", *car, "--track", "club", "--laps", "1", "--model", "single_track"), "race"),
    ]


def prepare(folder: Path) -> None:
    """Drives half a minute of laps and trains a model on them."""
    bag, laps = folder / "bag", folder / "laps.parquet"
    drive = ("--vehicle", "orca", "--track", "club", "--duration", "30", "--noise", "0.01,0.01,0.03")
    _run("simulate", *drive, "--out", bag)
    _run("extract", bag, "--signals", "default", "--rate", "50", "--out", laps)
    _run("train", laps, "--vehicle", "orca", "--model", "rls", "--epochs", "1", "--out", folder / "model")


def kill(command: Command, folder: Path, count: int, seed: int, tick: Callable[[], None] = lambda: None) -> Outcome:
    """Kills ``command`` ``count`` times in ``folder``, which it has for itself; calls ``tick`` after each."""
    random, outcome = np.random.default_rng(seed), Outcome()
    out = folder / command.out
    started = time.monotonic()
    _run(*command.arguments, "--out", out)
    took = time.monotonic() - started
    whole = _content(out)
    if command.resumes:
        _remove(out)
    before = _content(out)
    for number in range(count):
        if _kill_once([*command.arguments, "--out", str(out)], float(random.uniform(0, took))):
            outcome.kills += 1
        now = _content(out)
        if now == before:
            outcome.older += 1
        elif now.keys() == whole.keys() and _readable(out):
            outcome.newer += 1
            before = now
        else:
            outcome.faults.append(f"kill {number}: {out.name} holds {', '.join(now) or 'nothing'}")
        if command.resumes and out.exists():
            _compare_weights(whole, now, outcome)
            _remove(out)
            before = {}
        tick()
    _run(*command.arguments, "--out", out)
    _compare_weights(whole, _content(out), outcome)
    if beside := sorted(path.name for path in folder.iterdir() if path != out):
        outcome.faults.append(f"left beside {out.name}: {', '.join(beside)}")
    return outcome


def _kill_once(arguments: Sequence[str], after: float) -> bool:
    """Starts ``dynssm`` and kills it after so many seconds; whether it was still at work."""
    process = subprocess.Popen(_dynssm(arguments), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)  # noqa: S603
    try:
        process.wait(after)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
        return True
    return False


def _run(*arguments: str | Path) -> None:
    ended = subprocess.run(  # noqa: S603 - own command
        _dynssm([str(argument) for argument in arguments]), capture_output=True, text=True, check=False
    )
    if ended.returncode:
        raise UserError(f"dynssm {' '.join(map(str, arguments))}: {ended.stderr.strip()}")


def _dynssm(arguments: Sequence[str]) -> list[str]:
    return [sys.executable, "-m", "dynssm_ros.cli.main", *arguments]


def _content(path: Path) -> dict[str, str]:
    """Checksums of the files of an output by their names; empty if it is not there."""
    return {str(file.relative_to(path)): checksum(file) for file in files_in(path)}


def _readable(path: Path) -> bool:
    """Whether none of its files is empty, and what is called JSON is that."""
    try:
        for file in files_in(path):
            if file.suffix == ".json":
                json.loads(file.read_text(encoding="utf-8"))
    except ValueError:
        return False
    return all(file.stat().st_size for file in files_in(path))


def _compare_weights(whole: dict[str, str], now: dict[str, str], outcome: Outcome) -> None:
    for name, before in whole.items():
        if Path(name).match(_WEIGHTS) and now.get(name) != before:
            outcome.faults.append(f"{name}: other weights than those of a training that was not killed")


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def main(arguments: Sequence[str] | None = None) -> None:
    """Kills all commands in turn and says what came of it."""
    parser = argparse.ArgumentParser(prog="benchmarks.endurance.kills", description=__doc__)
    parser.add_argument("--kills", type=int, default=100, help="how many in all")
    parser.add_argument("--seed", type=int, default=0, help="of the instants")
    parser.add_argument("--only", default="", help="names of commands, separated by commas; all if empty")
    given = parser.parse_args(arguments)
    faults = 0
    with tempfile.TemporaryDirectory(prefix="dynssm-kills-") as name, progress_bar("killing") as progress:
        folder, wanted = Path(name), set(filter(None, given.only.split(",")))
        prepare(folder)
        chosen = [command for command in commands(folder) if not wanted or command.name in wanted]
        each = -(-given.kills // len(chosen))
        for index, command in enumerate(chosen):
            own = folder / f"{command.name}_killed"
            own.mkdir()
            done = kill(command, own, each, given.seed + index)
            progress(index + 1, len(chosen))
            faults += len(done.faults)
            console.print(
                f"{command.name}: {done.kills} of {each} killed; after {done.older} the older output was there, after "
                f"{done.newer} a newer one; {len(done.faults)} faults",
                *done.faults[:3], sep="\n  ", markup=False,
            )  # fmt: skip
    sys.exit(1 if faults else 0)


if __name__ == "__main__":
    main()
