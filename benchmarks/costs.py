"""Time and memory of the commands on long logs and on many: ``python -m benchmarks.costs``.

*Long logs*: a simulated drive of 10 and one of 60 minutes, all topics at 100 Hz, goes through the commands. For each the
processor's time and the most memory that its process held are taken from the operating system. What an hour of log costs is
the slope between the two: a command's start is left out. *Many logs*: simulated drives of 2 to 5 minutes are extracted by one
process and by several, in turn, then again into a folder that has them, and after one log has changed.
"""

from __future__ import annotations

import argparse
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from dynssm_ros.cli.console import console, errors, progress_bar
from dynssm_ros.errors import UserError
from dynssm_ros.files import write_json
from dynssm_ros.reporting.tables import Column, Table, Value
from dynssm_ros.simulation.laps import simulate, write_run
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import load_vehicle, save_vehicle

_RATE = 100  # Hz
_CAR, _TRACK, _NOISE = "av21", "road_course", "0.01,0.01,0.003"
_MEMORY = 20  # MB of rows that a training may hold
_KIB_IN_MB = 1024 / 1e6
_DRIVES = 8  # that are simulated; the others are copies, which cost the same


class Cost(NamedTuple):
    """What a command took."""

    clock: float  # time until it ended (s)
    cpu: float  # time on the processor, of all its threads and processes (s)
    memory: float  # the most that one of its processes held (MB)


def run(arguments: Sequence[str]) -> Cost:
    """Runs ``dynssm`` with ``arguments``.

    Raises:
        UserError: the command failed; carries its words.
    """
    command, begin = [sys.executable, "-m", "dynssm_ros.cli.main", *arguments], time.monotonic()
    with tempfile.TemporaryFile("w+") as words:
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=words)  # noqa: S603 - own command
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            words.seek(0)
            raise UserError(f"dynssm {' '.join(arguments)}: {words.read().strip()}")
    return Cost(time.monotonic() - begin, usage.ru_utime + usage.ru_stime, usage.ru_maxrss * _KIB_IN_MB)


def long_log(minutes: float) -> dict[str, Cost]:
    """Simulates a drive so long and takes the cost of each command that goes over it, by its name."""
    with tempfile.TemporaryDirectory(prefix="dynssm-costs-") as name, progress_bar(f"{minutes:g} min") as progress:
        folder = Path(name)
        bag, laps, model, car = (str(folder / name) for name in ("bag", "laps.parquet", "model", "car.yaml"))
        save_vehicle(load_vehicle(_CAR).model_copy(update={"sampling_time": 1 / _RATE}), folder / "car.yaml")
        drive = ("--vehicle", car, "--track", _TRACK, "--duration", f"{60 * minutes:g}", "--noise", _NOISE)
        run(("simulate", *drive, "--out", bag))
        vehicle, epoch = ("--vehicle", car), ("--vehicle", car, "--epochs", "1")
        commands = {
            "inspect": ("inspect", bag),
            "extract": ("extract", bag, "--signals", "default", "--rate", f"{_RATE}"),
            "calibrate": ("calibrate", laps, *vehicle),
            "train rls": ("train", laps, *vehicle, "--model", "rls"),
            "train dynssm, 1 epoch": ("train", laps, *epoch),
            f"the same with --memory {_MEMORY}": ("train", laps, *epoch, "--memory", f"{_MEMORY}"),
            "evaluate": ("evaluate", laps, *vehicle, "--model", model),
            "diagnose": ("diagnose", laps, *vehicle),
            "replay": ("replay", bag, "--model", model),
        }
        outputs = {"extract": laps, "calibrate": str(folder / "calibrated.yaml"), "train rls": model}
        costs = {}
        for index, (title, arguments) in enumerate(commands.items()):
            costs[title] = cost = run((*arguments, "--out", outputs.get(title, str(folder / f"out_{index}"))))
            errors.print(f"{minutes:g} min: {title}: {cost.cpu:.1f} s, {cost.memory:.0f} MB", markup=False)
            progress(index + 1, len(commands))
    return costs


def long_logs_table(costs: dict[float, dict[str, Cost]]) -> Table:
    """A row for each command: processor's time and memory by length of log (minutes), and what an hour more costs."""
    columns = [Column("command")]
    for minutes in costs:
        columns += [Column(title, unit, group=f"{minutes:g} min") for title, unit in (("CPU", "s"), ("memory", "MB"))]
    columns.append(Column("an hour more", "s"))
    shortest, longest = min(costs), max(costs)
    hours = (longest - shortest) / 60
    rows: list[list[Value]] = []
    for name in costs[shortest]:
        more = (costs[longest][name].cpu - costs[shortest][name].cpu) / hours if hours else None
        rows.append([name, *(value for each in costs.values() for value in each[name][1:]), more])
    return Table(tuple(columns), rows)


def many_logs(count: int, rounds: int, jobs: int) -> dict[str, list[float]]:
    """Times (s) of the extraction of so many logs, by what was done."""
    taken: dict[str, list[float]] = defaultdict(list)
    with tempfile.TemporaryDirectory(prefix="dynssm-costs-") as name:
        folder = Path(name)
        bags = simulated_bags(folder, count)
        words = ("extract", *map(str, bags), "--signals", "default", "--rate", "50", "--car", "orca", "--track", "club")

        def extract(title: str, out: Path, processes: int = 1) -> None:
            taken[title].append(run((*words, "--out", str(out), "--jobs", str(processes))).clock)
            errors.print(f"{title}: {taken[title][-1]:.1f} s", markup=False)

        for k in range(rounds):
            extract("1 process", folder / f"season_{k}")
            extract(f"{jobs} processes", folder / f"season_{k}_{jobs}", jobs)
        for _ in range(rounds):
            extract("unchanged", folder / "season_0")
        shutil.rmtree(bags[-1])
        shutil.copytree(bags[0], bags[-1])
        extract("one log changed", folder / "season_0")
    return dict(taken)


def simulated_bags(folder: Path, count: int) -> list[Path]:
    """So many logs of 2 to 5 minutes with all topics at 100 Hz."""
    car = load_vehicle("orca").model_copy(update={"sampling_time": 1 / _RATE})
    track, bags = load_track("club"), [folder / f"drive_{k}" for k in range(count)]
    with progress_bar("driving") as progress:
        for k, bag in enumerate(bags):
            if k < _DRIVES:
                write_run(simulate(car, track, duration=120.0 + 180.0 * k / _DRIVES, seed=k), bag)
            else:
                shutil.copytree(bags[k % _DRIVES], bag)
            progress(k + 1, count)
    return bags


def many_logs_table(taken: dict[str, list[float]]) -> Table:
    """Medians, and how many times as fast as one process."""
    medians = {name: statistics.median(each) for name, each in taken.items()}
    columns = (Column("extraction"), Column("median", "s"), Column("times as fast"))
    return Table(columns, [[name, median, medians["1 process"] / median] for name, median in medians.items()])


def main(arguments: Sequence[str] | None = None) -> None:
    """Measures and prints the tables."""
    parser = argparse.ArgumentParser(prog="benchmarks.costs", description=__doc__)
    parser.add_argument("--minutes", default="10,60", help="lengths of the long logs, separated by commas; empty: none")
    parser.add_argument("--logs", type=int, default=60, help="count of the many logs; 0: none")
    parser.add_argument("--jobs", type=int, default=2, help="processes to compare with one")
    parser.add_argument("--rounds", type=int, default=3, help="of the extraction of many logs")
    parser.add_argument("--json", type=Path, help="also write the result as JSON")
    given = parser.parse_args(arguments)
    try:
        costs = {float(each): long_log(float(each)) for each in filter(None, given.minutes.split(","))}
        taken = many_logs(given.logs, given.rounds, given.jobs) if given.logs else {}
    except UserError as error:
        sys.exit(f"error: {error}")
    if given.json is not None:
        by_minutes = {f"{minutes:g}": {k: v._asdict() for k, v in each.items()} for minutes, each in costs.items()}
        write_json(given.json, {"long_logs": by_minutes, "many_logs": taken})
    if costs:
        console.print(long_logs_table(costs).rich())
    if taken:
        console.print(many_logs_table(taken).rich())


if __name__ == "__main__":
    main()
