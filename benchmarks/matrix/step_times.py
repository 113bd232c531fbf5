"""How long a control step takes, apart from the machine: ``python -m benchmarks.matrix.step_times CELL --count 10``.

A cell of the matrix is driven several times with the same seed, so that each step computes the same in every drive. The
least of its times is nearest to what the step needs; what the others have beyond it is the machine's. The percentiles over
all times and over the least ones are told beside each other.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.matrix.raced_cells import named
from benchmarks.matrix.races import BASELINES, drive
from dynssm_ros.control.race import Race


def summary(drives: Sequence[Race]) -> str:
    """Median and 99th percentile of the steps' times (ms), over all drives and over the least of each step."""
    if any(not np.array_equal(each.command, drives[0].command) for each in drives):
        return "a late plan has changed a drive, so that times cannot be compared"
    seconds = np.array([each.solve for each in drives])
    measured, least = (np.percentile(1e3 * times, [50, 99]) for times in (seconds, seconds.min(axis=0)))
    return "p50 {:.2f}, p99 {:.2f} ms; least of {}: p50 {:.2f}, p99 {:.2f} ms".format(*measured, len(drives), *least)


def main(arguments: Sequence[str] | None = None) -> None:
    """Drives each cell so many times and prints percentiles of its steps."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.matrix.step_times", description=__doc__)
    parser.add_argument("cells", nargs="+", metavar="CELL", type=named)
    parser.add_argument("--count", type=int, default=10, help="drives of each cell")
    parser.add_argument("--models", nargs="+", default=["true"], help=f"{', '.join(BASELINES)}, or trained ones")
    parser.add_argument("--trained", type=Path, default=Path("out/generalisation"))
    options = parser.parse_args(arguments)
    for cell in options.cells:
        for model in options.models:
            drives = [drive(cell, model, options.trained) for _ in range(options.count)]
            print(f"{cell.name}, {model}: {summary(drives)}", flush=True)


if __name__ == "__main__":
    main()
