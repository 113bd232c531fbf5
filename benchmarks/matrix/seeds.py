"""What a lap owes to chance: cells again with other noise, ``python -m benchmarks.matrix.seeds CELL --count 12``.

A cell of the matrix is one drive. With another seed of the noise the same drive takes another time, and the worst of many
cells is partly the one with the worst noise. So a figure that misses its goal in one cell is asked again here. Models are
those that the matrix has trained; with ``--learn`` the last of ten laps is compared with the true model's best.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.matrix.raced_cells import Cell, named
from benchmarks.matrix.races import CALIBRATED, drive, learn, true_best
from benchmarks.matrix.races_page import last_lap
from dynssm_ros.control.race_models import TRUE


def ratios(cell: Cell, model: str, trained: Path) -> dict[str, float]:
    """The model's last lap over the true model's and over the calibrated car's."""
    lap, true, calibrated = (last_lap(drive(cell, name, trained).to_json()) for name in (model, TRUE, CALIBRATED))
    return {"over true": lap / true, "over calibrated": lap / calibrated}


def learned_ratio(cell: Cell, model: str, trained: Path) -> dict[str, float]:
    """The last lap of a car that learns over the true model's best."""
    best = true_best(cell)
    return {"over the true model's best": last_lap(learn(cell, trained, model).to_json()) / (best or float("nan"))}


def main(arguments: Sequence[str] | None = None) -> None:
    """Drives each cell with so many seeds and prints ratios of lap times."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.matrix.seeds", description=__doc__)
    parser.add_argument("cells", nargs="+", metavar="CELL", type=named)
    parser.add_argument("--count", type=int, default=12, help="seeds; the first is the matrix' own")
    parser.add_argument("--model", default="dynssm")
    parser.add_argument("--trained", type=Path, default=Path("out/generalisation"))
    parser.add_argument("--learn", action="store_true", help="ten laps, faster every lap")
    options = parser.parse_args(arguments)
    for first in options.cells:
        name, found = first.name, []
        for again in range(options.count):
            cell = replace(first, again=again)
            found.append((learned_ratio if options.learn else ratios)(cell, options.model, options.trained))
            print(
                f"{name}, seed {again}: " + ", ".join(f"{value:.4f} {of}" for of, value in found[-1].items()),
                flush=True,
            )
        for of in found[0]:
            values = np.array([one[of] for one in found])
            lost, values = int(np.isnan(values).sum()), values[~np.isnan(values)]
            spread = f"{values.mean():.4f} +- {values.std(ddof=1):.4f}" if len(values) > 1 else "too few"
            print(f"{name}, {of}: {spread} over {len(values)} seeds, worst {values.max(initial=0):.4f}, lost {lost}")


if __name__ == "__main__":
    main()
