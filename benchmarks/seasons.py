"""What several processes bring to a season of logs: ``python -m benchmarks.seasons``.

Simulated drives of 2 to 5 minutes with all topics at 100 Hz, and the real logs that are there, are extracted with one process
and with several, in turn, each time into a new folder. Then again into one that has them all, and after one log has changed.
Times are those of whole commands.
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
from dynssm_ros.reporting.tables import Column, Table
from dynssm_ros.simulation.laps import simulate, write_run
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import load_vehicle

_RATE = 100  # Hz
_DRIVES = 8  # that are simulated; the others are copies, which cost the same
_OPTIONS = {
    "av21": "--signals av21 --rate 25",
    "dart": "--signals default --rate 50 --commands none",
    "orca": "--signals default --rate 50",
}  # by the folder of the car's real logs


class LogGroup(NamedTuple):
    """Logs that one command takes."""

    bags: list[Path]
    options: tuple[str, ...]


def groups(folder: Path, data: Path, count: int) -> list[LogGroup]:
    """Real logs, as far as they are there, and simulated ones until there are ``count``."""
    there = {car: sorted(path.parent for path in data.glob(f"{car}/*/metadata.yaml")) for car in _OPTIONS}
    there["orca"] += simulated_bags(folder, count - sum(map(len, there.values())))
    return [
        LogGroup(bags, (*_OPTIONS[car].split(), "--car", car, "--track", "any")) for car, bags in there.items() if bags
    ]


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


def seconds(found: Sequence[LogGroup], out: Path, jobs: int) -> float:
    """How long the commands take that extract all groups into the season ``out``."""
    begin = time.monotonic()
    for group in found:
        bags = [str(bag) for bag in group.bags]
        words = ["extract", *bags, *group.options, "--out", str(out), "--jobs", str(jobs)]
        command = [sys.executable, "-m", "dynssm_ros.cli.main", *words]
        ended = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603 - own command
        if ended.returncode:
            raise UserError(f"dynssm {' '.join(words)}: {ended.stderr.strip()}")
    return time.monotonic() - begin


def measure(data: Path, count: int, rounds: int, jobs: int) -> dict[str, list[float]]:
    """Times (s) by what was done."""
    taken: dict[str, list[float]] = defaultdict(list)
    with tempfile.TemporaryDirectory(prefix="dynssm-season-") as name:
        folder = Path(name)
        found = groups(folder, data, count)
        for k in range(rounds):
            for workers in (1, jobs):
                out = folder / f"season_{k}_{workers}"
                taken[_processes(workers)].append(seconds(found, out, workers))
                errors.print(f"{_processes(workers)}: {taken[_processes(workers)][-1]:.1f} s", markup=False)
        for _ in range(rounds):
            taken["unchanged"].append(seconds(found[-1:], out, 1))
        changed = found[-1].bags[-1]
        shutil.rmtree(changed)
        shutil.copytree(found[-1].bags[-2], changed)
        taken["one log changed"].append(seconds(found[-1:], out, 1))
    return dict(taken)


def _processes(jobs: int) -> str:
    return "1 process" if jobs == 1 else f"{jobs} processes"


def main(arguments: Sequence[str] | None = None) -> None:
    """Measures and prints the table."""
    parser = argparse.ArgumentParser(prog="benchmarks.seasons", description=__doc__)
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("DYNSSM_DATA", "../shared/data")))
    parser.add_argument("--logs", type=int, default=60)
    parser.add_argument("--jobs", type=int, default=2, help="processes to compare with one")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--json", type=Path, help="also write the result as JSON")
    given = parser.parse_args(arguments)
    try:
        taken = measure(given.data, given.logs, given.rounds, given.jobs)
    except UserError as error:
        sys.exit(f"error: {error}")
    if given.json is not None:
        write_json(given.json, taken)
    one = statistics.median(taken[_processes(1)])
    columns = (Column("extraction"), Column("median", "s"), Column("times as fast"))
    console.print(
        Table(columns, [[name, m := statistics.median(each), one / m] for name, each in taken.items()]).rich()
    )


if __name__ == "__main__":
    main()
