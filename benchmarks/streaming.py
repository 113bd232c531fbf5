"""What ``train --memory`` holds, and what it costs: ``python -m benchmarks.streaming``.

Simulated logs with noise, so many that their rows take one, three and ten times the memory that is allowed, are trained
on with and without ``--memory``, each in a process of its own. The most that each held is taken from the operating system;
the models are compared on a drive that none has seen.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from benchmarks.scaling import used
from dynssm_ros.cli.console import console, errors, progress_bar
from dynssm_ros.errors import UserError
from dynssm_ros.evaluation.open_loop import evaluate
from dynssm_ros.files import write_json
from dynssm_ros.reporting.tables import Column, Table, Value
from dynssm_ros.runtime.registry import load_model
from dynssm_ros.signals.recording import Recording
from dynssm_ros.simulation.laps import as_recording, simulate
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import load_vehicle, save_vehicle

_RATE, _SECONDS, _DRIVES = 100, 200.0, 6  # Hz and length of a log; drives that are simulated, others are copies
_NOISE = (0.01, 0.01, 0.03)
_BYTES = 200  # of a row, as training counts them


class Cost(NamedTuple):
    """Of a training."""

    memory: float
    """The most that its process held (MB)."""
    seconds: float
    rmse: tuple[float, float, float]
    """One-step errors on the drive that was left out: v_x, v_y (m/s), omega (rad/s)."""


def logs(folder: Path, count: int) -> list[Path]:
    """So many recordings, and ``left_out.parquet``."""
    car = load_vehicle("orca").model_copy(update={"sampling_time": 1 / _RATE})
    save_vehicle(car, folder / "car.yaml")
    track, files = load_track("club"), [folder / f"log_{k}.parquet" for k in range(count)]
    with progress_bar("driving") as progress:
        for k, file in enumerate(files):
            if k < _DRIVES:
                as_recording(simulate(car, track, _SECONDS, plant="double_track", seed=k, noise=_NOISE)).save(file)
            else:
                shutil.copy(files[k % _DRIVES], file)
            progress(k + 1, count)
    other = load_track("club_b")
    as_recording(simulate(car, other, 60.0, plant="double_track", seed=99, noise=_NOISE)).save(
        folder / "left_out.parquet"
    )
    return files


def train(files: Sequence[Path], folder: Path, model: str, epochs: int, memory: float | None) -> Cost:
    """Trains in a process of its own, and scores the model."""
    out = folder / "model"
    words = [
        "train",
        *map(str, files),
        "--vehicle",
        str(folder / "car.yaml"),
        "--model",
        model,
        "--epochs",
        str(epochs),
    ]
    words += ["--out", str(out), *(() if memory is None else ("--memory", f"{memory:g}"))]
    cost = used(words)
    trained = load_model(out)
    score = evaluate(Recording.load(folder / "left_out.parquet"), {"model": trained}, stride=50, calls=1).scores[
        "model"
    ]
    v_x, v_y, omega = map(float, score.rmse)
    shutil.rmtree(out)
    return Cost(cost.memory, cost.seconds, (v_x, v_y, omega))


def main(arguments: Sequence[str] | None = None) -> None:
    """Measures all sizes and prints the table."""
    parser = argparse.ArgumentParser(prog="benchmarks.streaming", description=__doc__)
    parser.add_argument("--model", default="ddm_orca")
    parser.add_argument("--memory", type=float, default=20.0, help="MB")
    parser.add_argument("--epochs", type=int, default=2)
    parser.add_argument(
        "--times", default="1,3,10", help="sizes of the data in units of the memory, separated by commas"
    )
    parser.add_argument("--json", type=Path, help="also write the result as JSON")
    given = parser.parse_args(arguments)
    times = [float(each) for each in given.times.split(",")]
    count = [max(1, round(each * given.memory * 1e6 / _BYTES / (_RATE * _SECONDS))) for each in times]
    rows: list[list[Value]] = []
    try:
        with tempfile.TemporaryDirectory(prefix="dynssm-streaming-") as name:
            files = logs(Path(name), max(count))
            for size, some in zip(times, count, strict=True):
                for memory in (given.memory, None):
                    cost = train(files[:some], Path(name), given.model, given.epochs, memory)
                    held = "all" if memory is None else f"{memory:g} MB"
                    errors.print(f"{size:g} times, {held}: {cost.memory:.0f} MB, {cost.seconds:.0f} s", markup=False)
                    rows.append([size, some, held, cost.memory, cost.seconds, *cost.rmse])
    except UserError as error:
        sys.exit(f"error: {error}")
    columns = ("rows / bound", "logs", "held", "MB", "s", "v_x", "v_y", "ω")
    if given.json is not None:
        write_json(given.json, {"rows": [dict(zip(columns, row, strict=True)) for row in rows]})
    console.print(Table(tuple(map(Column, columns)), rows).rich())


if __name__ == "__main__":
    main()
