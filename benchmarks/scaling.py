"""What thousands of hours of logs would cost: ``python -m benchmarks.scaling``.

Extraction, training and evaluation are timed on two amounts of simulated logs (100 Hz), with one and with several
workers. The difference of the two is what an hour of log costs; what is left is the start. From these slopes follows what
10^3 and 10^5 hours cost. How many workers help is measured as far as this machine has cores. Beyond, work that is
independent (sessions) is taken to spread evenly, and a training is not.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from benchmarks.seasons import simulated_bags
from dynssm_ros.cli.console import console, errors
from dynssm_ros.errors import UserError
from dynssm_ros.files import write_json
from dynssm_ros.reporting.tables import Column, Table, Value
from dynssm_ros.signals.season import Season, Session

_RATE = 50  # Hz of the recordings
_EPOCHS = 1, 3  # whose difference is what an epoch costs
_MIB = 1024.0 / 1e6  # of the kB of the operating system in MB
_HOURS = 1e3, 1e5  # of a season that is asked about
_NIGHT_H, _CORES = 10.0, 100
_GRADIENT_BYTES = 2 * 4  # of each parameter, to and from each process: a ring passes every number on about twice


class Used(NamedTuple):
    """Of a command."""

    seconds: float
    """On the clock."""
    cpu: float
    """Of all its processes (s)."""
    memory: float
    """The most that one of its processes held (MB)."""


class Slope(NamedTuple):
    """Of a command, by the hours of log that it works on.

    Attributes:
        start: what it takes for none (s).
        clock: per hour of log (s).
        cpu: of all processes per hour of log (s).
        memory: the most that one process held, of the larger amount (MB).
    """

    start: float
    clock: float
    cpu: float
    memory: float


def used(words: Sequence[str]) -> Used:
    """Runs ``dynssm`` with ``words``.

    Raises:
        UserError: it fails.
    """
    command, begin = [sys.executable, "-m", "dynssm_ros.cli.main", *words], time.monotonic()
    with tempfile.TemporaryFile("w+") as told:
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=told)  # noqa: S603 - own command
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            told.seek(0)
            raise UserError(f"dynssm {' '.join(words)}: {told.read().strip()}")
    return Used(time.monotonic() - begin, usage.ru_utime + usage.ru_stime, usage.ru_maxrss * _MIB)


def slope(less: Used, more: Used, hours: float) -> Slope:
    """What ``hours`` more cost; ``less`` is of as many hours."""
    clock = (more.seconds - less.seconds) / hours
    return Slope(less.seconds - clock * hours, clock, (more.cpu - less.cpu) / hours, more.memory)


class Scaling:
    """Measures in a folder.

    Args:
        folder: for logs and results.
        count: of logs in the smaller amount; the larger has twice as many.
        model: that is trained.
    """

    def __init__(self, folder: Path, count: int, model: str) -> None:
        self._folder, self._count, self._model = folder, count, model
        self._bags = simulated_bags(folder, 2 * count)
        self._season = folder / "season_1_2"
        self._trained = folder

    def measure(self, workers: Sequence[int]) -> dict[str, Slope]:
        """Slopes by what was done."""
        found: dict[str, Slope] = {}

        def note(name: str, each: Slope) -> None:
            found[name] = each
            errors.print(f"{name}: {each.clock:.1f} s an hour, {each.memory:.0f} MB", markup=False)

        for n in workers:
            less, more = (self._extract(k, n) for k in (1, 2))
            note(f"extract, {_of(n)}", slope(less, more, self.hours))
        for n in workers:
            # an epoch more over all logs costs what they cost again
            first, last = (self._train(epochs, n) for epochs in _EPOCHS)
            note(f"train, an epoch, {_of(n)}", slope(first, last, 2 * self.hours * (_EPOCHS[1] - _EPOCHS[0])))
        less, more = (self._evaluate(k) for k in (1, 2))
        note(f"evaluate, {_of(1)}", slope(less, more, self.hours))
        return found

    @property
    def hours(self) -> float:
        """Of the smaller amount of logs."""
        return self._hours(1)

    def _sessions(self, times: int) -> list[Session]:
        """Of the smaller amount of logs, or of twice as many."""
        return Season.load(self._season).of_bags(self._bags[: times * self._count])

    def _hours(self, times: int) -> float:
        return sum(session.seconds for session in self._sessions(times)) / 3600.0

    def _files(self, times: int) -> list[Path]:
        season = Season.load(self._season)
        return [season.file(session.place) for session in self._sessions(times)]

    @property
    def megabytes(self) -> dict[str, float]:
        """On the disk, of an hour: of bags, and of recordings."""
        bags = sum(file.stat().st_size for bag in self._bags for file in bag.iterdir())
        recordings = sum(file.stat().st_size for file in self._files(2))
        return {"bags": bags / 1e6 / self._hours(2), "recordings": recordings / 1e6 / self._hours(2)}

    @property
    def parameters(self) -> int:
        """Of the model."""
        metrics = json.loads((self._folder / "model" / "results.json").read_text(encoding="utf-8"))
        return int(next(iter(metrics["models"].values()))["parameters"])

    def _extract(self, times: int, workers: int) -> Used:
        bags = [str(bag) for bag in self._bags[: times * self._count]]
        out = self._folder / f"season_{workers}_{times}"
        words = ["extract", *bags, "--signals", "default", "--rate", str(_RATE), "--car", "orca", "--track", "club"]
        return used([*words, "--out", str(out), "--jobs", str(workers)])

    def _train(self, epochs: int, workers: int) -> Used:
        words = ["train", str(self._season), "--vehicle", "orca", "--model", self._model, "--epochs", str(epochs)]
        out = self._folder / "models" / f"{epochs}_{workers}"
        self._trained = out
        return used([*words, "--out", str(out), *(["--processes", str(workers)] if workers > 1 else [])])

    def _evaluate(self, times: int) -> Used:
        words = ["evaluate", *map(str, self._files(times)), "--model", str(self._trained), "--stride", "10"]
        return used([*words, "--out", str(self._folder / "model")])


def _of(workers: int) -> str:
    return "1 worker" if workers == 1 else f"{workers} workers"


def arithmetic(found: dict[str, Slope], epochs: int, megabytes: dict[str, float]) -> Table:
    """What seasons of :data:`_HOURS` cost, from the slopes of one worker."""
    one = {name.split(",")[0]: each for name, each in found.items() if name.endswith(_of(1))}
    each_hour = {
        "bags (TB)": megabytes["bags"] / 1e6,
        "recordings (TB)": megabytes["recordings"] / 1e6,
        "extract (core h)": one["extract"].cpu / 3600.0,
        "evaluate (core h)": one["evaluate"].cpu / 3600.0,
        f"both on {_CORES} cores (h)": (one["extract"].cpu + one["evaluate"].cpu) / 3600.0 / _CORES,
        f"train {epochs} epochs (core h)": epochs * one["train"].cpu / 3600.0,
    }
    columns = (Column("a season of"), *(Column(f"{hours:.0f} h") for hours in _HOURS))
    return Table(columns, [[what, *(value * hours for hours in _HOURS)] for what, value in each_hour.items()])


def main(arguments: Sequence[str] | None = None) -> None:
    """Measures and prints the slopes and what follows from them."""
    parser = argparse.ArgumentParser(prog="benchmarks.scaling", description=__doc__)
    parser.add_argument("--logs", type=int, default=8, help="in the smaller amount, of 2 to 5 minutes each")
    parser.add_argument("--model", default="ddm_av21")
    parser.add_argument("--workers", default="1,2,4", help="counts, separated by commas")
    parser.add_argument("--epochs", type=int, default=20, help="of the training that is asked about")
    parser.add_argument("--json", type=Path, help="also write the result as JSON")
    given = parser.parse_args(arguments)
    try:
        with tempfile.TemporaryDirectory(prefix="dynssm-scaling-") as name:
            scaling = Scaling(Path(name), given.logs, given.model)
            found = scaling.measure(sorted({1, *map(int, given.workers.split(","))}))
            disk, parameters = scaling.megabytes, scaling.parameters
    except UserError as error:
        sys.exit(f"error: {error}")
    if given.json is not None:
        slopes = {what: each._asdict() for what, each in found.items()}
        write_json(given.json, {"slopes": slopes, "megabytes_an_hour": disk, "parameters": parameters})
    columns = ("work", "start (s)", "clock (s/h)", "CPU (s/h)", "memory (MB)")
    rows: list[list[Value]] = [[what, each.start, each.clock, each.cpu, each.memory] for what, each in found.items()]
    console.print(Table(tuple(map(Column, columns)), rows).rich())
    console.print(
        f"an hour of log: {disk['bags']:.0f} MB of bags, {disk['recordings']:.0f} MB of recordings; a step of the training "
        f"moves {_GRADIENT_BYTES * parameters / 1e6:.2f} MB to and from each process"
    )
    console.print(arithmetic(found, given.epochs, disk).rich())
    night = _NIGHT_H * _CORES * 3600.0
    for what, each in found.items():
        if what.endswith(_of(1)):
            console.print(f"a night of {_NIGHT_H:g} h on {_CORES} cores: {night / each.cpu:.3g} hours of log, {what}")


if __name__ == "__main__":
    main()
