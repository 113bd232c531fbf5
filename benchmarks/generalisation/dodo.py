"""The generalisation matrix as doit's tasks: ``python -m doit -n 2 -f benchmarks/generalisation/dodo.py``.

Variables: ``out`` (folder), ``page`` (folder of the page and its figure), ``data`` (folder of the real logs), ``only`` (words
that names of trainings must begin with, separated by commas), ``part`` (``development``, the default, or ``all``: test cells
too), ``sets`` (``shipped``, the default, ``ablations``, ``rivals``, separated by commas; rivals take a day). What is
done is kept; a kill costs the task under way.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from doit import get_var
from doit.tools import config_changed

from benchmarks.generalisation import ablations
from benchmarks.generalisation.cells import cells
from benchmarks.generalisation.page import FIGURE, PAGE, heat_map, page, summary
from benchmarks.generalisation.run import cell_file, model_folder, models_of, read_cell, score_cell
from benchmarks.generalisation.training_tasks import drive_tasks, train_tasks
from benchmarks.tasks import doit_config, save_figure
from dynssm_ros.errors import UserError
from dynssm_ros.files import replacing, write_json
from dynssm_ros.runtime.artifact import CARD

OUT = Path(get_var("out", "out/generalisation"))
PAGE_FOLDER = Path(get_var("page", str(OUT)))
DATA = Path(get_var("data", os.environ.get("DYNSSM_DATA", "../shared/data")))
ONLY = tuple(get_var("only", "").split(","))
_SHIPPED, _DEVELOPMENT = "shipped", "development"
PART = get_var("part", _DEVELOPMENT)
SETS = get_var("sets", _SHIPPED)
MODEL_SETS = tuple(SETS.split(","))
ARGUMENTS = " ".join(
    f"{name}={value}"
    for name, value, usual in (("part", PART, _DEVELOPMENT), ("sets", SETS, _SHIPPED), ("only", ",".join(ONLY), ""))
    if value != usual
)
DOIT_CONFIG = doit_config(OUT / "doit.json")
CELLS = [cell for cell in cells(DATA) if cell.training.name.startswith(ONLY) and (PART == "all" or not cell.is_test)]
TRAININGS = {cell.training.name: cell.training for cell in CELLS}


def task_drive() -> Iterator[dict[str, Any]]:
    """Makes the laps of each training."""
    yield from drive_tasks(TRAININGS.values(), OUT, DATA)


def task_train() -> Iterator[dict[str, Any]]:
    """Trains each model on each training."""
    yield from train_tasks(TRAININGS.values(), models_of(MODEL_SETS), OUT)


def task_score() -> Iterator[dict[str, Any]]:
    """Scores the models on each cell."""
    for cell in CELLS:
        yield {
            "name": cell.name,
            "actions": [(score_cell, [cell, OUT, DATA, MODEL_SETS])],
            "file_dep": [str(model_folder(cell.training, name, OUT) / CARD) for name in models_of(MODEL_SETS)],
            "targets": [str(cell_file(cell, OUT))],
            "uptodate": [config_changed(repr((cell, MODEL_SETS)))],
        }


def task_page() -> dict[str, Any]:
    """Writes the page and the heat map of what is there."""
    return {"actions": [write_page], "task_dep": ["score"], "uptodate": [False], "verbosity": 2}


def write_page() -> None:
    """The summary as JSON, the heat map and the page."""
    known = {cell: content for cell in CELLS if (content := read_cell(cell, OUT)) is not None}
    if not known:
        raise UserError(f"only={','.join(ONLY)} part={PART}: no cell was scored")
    write_json(OUT / "summary.json", summary(known))
    save_figure(heat_map(known), PAGE_FOLDER / FIGURE)
    text = page(known, ARGUMENTS, len(CELLS) - len(known))
    with replacing(PAGE_FOLDER / PAGE) as aside:
        aside.write_text(text, encoding="utf-8")
    if "ablations" in MODEL_SETS:
        with replacing(PAGE_FOLDER / ablations.PAGE) as aside:
            aside.write_text(ablations.page(known, ARGUMENTS), encoding="utf-8")
    print(text)
