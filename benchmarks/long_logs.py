"""What a long log costs: ``python -m benchmarks.long_logs``.

A simulated drive of 10 and one of 60 minutes, all topics at 100 Hz, goes through the commands. For each the time on the
processor and the most memory that its process held are taken from the operating system. A command whose memory is flat
holds about the same on both.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from dynssm_ros.cli.console import console, errors, progress_bar
from dynssm_ros.errors import UserError
from dynssm_ros.files import write_json
from dynssm_ros.reporting.tables import Column, Table, Value
from dynssm_ros.vehicle import load_vehicle, save_vehicle

_RATE = 100  # Hz
_CAR, _TRACK, _NOISE = "av21", "road_course", "0.01,0.01,0.003"
_KIB_IN_MB = 1024 / 1e6
_FIRST = ("extract", "train rls")  # whose outputs others need


class Cost(NamedTuple):
    """What a command took."""

    cpu: float
    """Time on the processor, of all its threads (s)."""
    memory: float
    """The most that it held (MB)."""


def commands(folder: Path) -> dict[str, tuple[str, ...]]:
    """What goes over a log, in order, by name; each writes to ``folder``."""
    bag, laps, model, car = (str(folder / name) for name in ("bag", "laps.parquet", "model", "car.yaml"))
    vehicle = ("--vehicle", car)
    return {
        "inspect": ("inspect", bag, "--out", str(folder / "inspected")),
        "extract": ("extract", bag, "--signals", "default", "--rate", f"{_RATE}", "--out", laps),
        "calibrate": ("calibrate", laps, *vehicle, "--out", str(folder / "calibrated.yaml")),
        "train rls": ("train", laps, *vehicle, "--model", "rls", "--out", model),
        "train dynssm, 1 epoch": ("train", laps, *vehicle, "--epochs", "1", "--out", str(folder / "dynssm")),
        "evaluate": ("evaluate", laps, *vehicle, "--model", model, "--out", str(folder / "evaluation")),
        "diagnose": ("diagnose", laps, *vehicle, "--out", str(folder / "diagnosis")),
        "replay": ("replay", bag, "--model", model, "--out", str(folder / "predictions")),
    }


def measure(minutes: float, wanted: Sequence[str] = ()) -> dict[str, Cost]:
    """Drives so long and takes the cost of each command (of those that are ``wanted``, if any are), by its name.

    Raises:
        UserError: a command failed; carries its words.
    """
    with tempfile.TemporaryDirectory(prefix="dynssm-long-") as name, progress_bar(f"{minutes:g} min") as progress:
        folder = Path(name)
        car = load_vehicle(_CAR).model_copy(update={"sampling_time": 1 / _RATE})
        save_vehicle(car, folder / "car.yaml")
        drive = ("--vehicle", str(folder / "car.yaml"), "--track", _TRACK, "--duration", f"{60 * minutes:g}")
        _run(("simulate", *drive, "--noise", _NOISE, "--out", str(folder / "bag")))
        costs, chosen = {}, commands(folder)
        for index, (title, arguments) in enumerate(chosen.items()):
            if not wanted or title in _FIRST or title.split()[0] in wanted:
                costs[title] = cost = _run(arguments)
                errors.print(f"{minutes:g} min: {title}: {cost.cpu:.1f} s, {cost.memory:.0f} MB", markup=False)
            progress(index + 1, len(chosen))
    return costs


def comparison(costs: dict[float, dict[str, Cost]]) -> Table:
    """A row for each command, columns for each length of log (minutes)."""
    columns = [Column("command")]
    for minutes in costs:
        columns += [Column(title, unit, group=f"{minutes:g} min") for title, unit in (("CPU", "s"), ("memory", "MB"))]
    names = next(iter(costs.values()))
    rows: list[list[Value]] = [[name, *(value for each in costs.values() for value in each[name])] for name in names]
    return Table(tuple(columns), rows)


def _run(arguments: Sequence[str]) -> Cost:
    command = [sys.executable, "-m", "dynssm_ros.cli.main", *arguments]
    with tempfile.TemporaryFile("w+") as words:
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=words)  # noqa: S603 - own command
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            words.seek(0)
            raise UserError(f"dynssm {' '.join(arguments)}: {words.read().strip()}")
    return Cost(usage.ru_utime + usage.ru_stime, usage.ru_maxrss * _KIB_IN_MB)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measures all lengths and prints the table."""
    parser = argparse.ArgumentParser(prog="benchmarks.long_logs", description=__doc__)
    parser.add_argument("--minutes", default="10,60", help="lengths of the logs, separated by commas")
    parser.add_argument("--only", default="", help="commands, separated by commas; all if empty")
    parser.add_argument("--json", type=Path, help="also write the result as JSON")
    given = parser.parse_args(arguments)
    try:
        costs = {
            float(each): measure(float(each), list(filter(None, given.only.split(","))))
            for each in given.minutes.split(",")
        }
    except UserError as error:
        sys.exit(f"error: {error}")
    if given.json is not None:
        write_json(
            given.json,
            {f"{minutes:g}": {name: cost._asdict() for name, cost in each.items()} for minutes, each in costs.items()},
        )
    console.print(comparison(costs).rich())


if __name__ == "__main__":
    main()
