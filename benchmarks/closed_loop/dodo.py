"""The robustness matrix as doit's tasks: ``python -m doit -n 2 -f benchmarks/closed_loop/dodo.py``.

Variables: ``out`` (folder), ``trained`` (folder of the generalisation matrix: models are taken from there, and trained there
if they are missing), ``page`` (folder of the page and its figure), ``only`` (words that names of cells must begin with,
separated by commas), ``part`` (``development``, the default, or ``all``: test cells too), ``sets`` (as of the generalisation
matrix; with ``rivals`` the page is ``closed_loop_rivals.md``, or ``closed_loop_rivals_orca.md`` with ``only=orca``),
``models`` (those of the sets that are driven, separated by commas; all if not given). What is done is kept; a kill costs the
task under way. The tasks ``learn`` and ``learning_page`` run if they are named.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

from doit import get_var
from doit.tools import config_changed

from benchmarks.closed_loop.cells import Cell, cells
from benchmarks.closed_loop.page import LEARNING_PAGE, lap_times, learned_laps, learning_page, page, summary
from benchmarks.closed_loop.run import (
    BASELINES,
    CALIBRATES,
    learn_cell,
    learning_file,
    outcome_file,
    race_model,
    read_cell,
    read_learning,
)
from benchmarks.generalisation.run import RIVALS, model_folder, models_of
from benchmarks.generalisation.training_tasks import drive_tasks, train_tasks
from benchmarks.tasks import doit_config, save_figure
from dynssm_ros.errors import UserError
from dynssm_ros.files import replacing, write_json
from dynssm_ros.runtime.artifact import CARD

OUT = Path(get_var("out", "out/closed_loop"))
TRAINED = Path(get_var("trained", "out/generalisation"))
PAGE_FOLDER = Path(get_var("page", str(OUT)))
_DEVELOPMENT, _SHIPPED = "development", "shipped"
USUAL = {"only": "", "part": _DEVELOPMENT, "sets": _SHIPPED, "models": ""}
VALUES = {name: get_var(name, usual) for name, usual in USUAL.items()}
ARGUMENTS = [f"{name}={value}" for name, value in VALUES.items() if value != USUAL[name]]
# ridge has no physics to plan with
OFFERED = tuple(name for name in models_of(VALUES["sets"].split(",")) if name != "ridge")
ASKED = tuple(filter(None, VALUES["models"].split(",")))
if unknown := set(ASKED) - set(OFFERED):
    raise UserError(f"models={VALUES['models']}: {', '.join(sorted(unknown))} is none of {', '.join(OFFERED)}")
MODELS = ASKED or OFFERED
LEARNS = "dynssm"
PAGE = "closed_loop"
if set(RIVALS) & set(MODELS):
    PAGE = "_".join(["closed_loop_rivals", *filter(None, VALUES["only"].split(","))])
DOIT_CONFIG = doit_config(OUT / "doit.json") | {"default_tasks": ["page"]}
CELLS = [
    cell
    for cell in cells()
    if cell.name.startswith(tuple(VALUES["only"].split(","))) and (VALUES["part"] == "all" or not cell.is_test)
]
TRAININGS = {cell.training.name: cell.training for cell in CELLS}


def task_drive() -> Iterator[dict[str, Any]]:
    """Makes the laps of each training."""
    yield from drive_tasks(TRAININGS.values(), TRAINED, Path())


def task_train() -> Iterator[dict[str, Any]]:
    """Trains each model on each training."""
    yield from train_tasks(TRAININGS.values(), dict.fromkeys((*MODELS, CALIBRATES)), TRAINED)


def task_race() -> Iterator[dict[str, Any]]:
    """Drives each cell with each model."""
    for cell in CELLS:
        for name in (*BASELINES, *MODELS):
            trained = name if name in MODELS else CALIBRATES
            yield {
                "name": f"{cell.name}:{name}",
                "actions": [(race_model, [cell, name, OUT, TRAINED])],
                "file_dep": [str(model_folder(cell.training, trained, TRAINED) / CARD)],
                "targets": [str(outcome_file(cell, name, OUT))],
                "uptodate": [config_changed(repr(cell))],
            }


def task_page() -> dict[str, Any]:
    """Writes the page and the figure of what is there."""
    return {"actions": [write_page], "task_dep": ["race"], "uptodate": [False], "verbosity": 2}


def task_learn() -> Iterator[dict[str, Any]]:
    """Drives each cell faster every lap."""
    for cell in CELLS:
        yield {
            "name": cell.name,
            "actions": [(learn_cell, [cell, OUT, TRAINED, LEARNS])],
            "file_dep": [str(model_folder(cell.training, LEARNS, TRAINED) / CARD)],
            "targets": [str(learning_file(cell, OUT))],
            "uptodate": [config_changed(repr(cell))],
        }


def task_learning_page() -> dict[str, Any]:
    """Writes the page of what learned."""
    return {"actions": [write_learning_page], "task_dep": ["learn"], "uptodate": [False], "verbosity": 2}


def write_learning_page() -> None:
    """The page of the cells that were driven faster every lap, with its figure."""
    known, figure = _known(read_learning), Path(LEARNING_PAGE).with_suffix(".png").name
    save_figure(learned_laps(known), PAGE_FOLDER / figure)
    _write(LEARNING_PAGE, learning_page(known, ARGUMENTS, figure, CELLS))


def write_page() -> None:
    """The summary as JSON, the figure and the page."""
    known = _known(partial(read_cell, models=MODELS))
    write_json(OUT / "summary.json", summary(known))
    figure = f"{PAGE}.png"
    save_figure(lap_times(known), PAGE_FOLDER / figure)
    _write(f"{PAGE}.md", page(known, ARGUMENTS, figure, CELLS))


def _known(read: Callable[..., dict[str, Any] | None]) -> dict[Cell, dict[str, Any]]:
    """The outcomes that there are."""
    known = {cell: outcome for cell in CELLS if (outcome := read(cell, out=OUT)) is not None}
    if not known:
        raise UserError(f"only={VALUES['only']} part={VALUES['part']}: no cell was driven")
    return known


def _write(name: str, text: str) -> None:
    """Writes a page and prints it."""
    with replacing(PAGE_FOLDER / name) as aside:
        aside.write_text(text, encoding="utf-8")
    print(text)
