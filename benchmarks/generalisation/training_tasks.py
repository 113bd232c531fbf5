"""Tasks of doit that make the laps of trainings, and train models on them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from doit.tools import config_changed

from benchmarks.generalisation.cells import Training
from benchmarks.generalisation.run import SETS, drive, drive_file, model_folder, models_of, train_model
from dynssm_ros.runtime.artifact import CARD


def drive_tasks(trainings: Iterable[Training], out: Path, data: Path) -> Iterator[dict[str, Any]]:
    """Makes the laps of each training, below ``out``; ``data``: folder of the real logs."""
    for training in trainings:
        yield {
            "name": training.name,
            "actions": [(drive, [training, out, data])],
            "targets": [str(drive_file(training, out))],
            "uptodate": [config_changed(repr(training))],
        }


def train_tasks(trainings: Iterable[Training], models: Iterable[str], out: Path) -> Iterator[dict[str, Any]]:
    """Trains each of ``models`` (names) on each training, below ``out``."""
    contents, models = models_of(SETS), tuple(models)
    for training in trainings:
        for name in models:
            yield {
                "name": f"{training.name}:{name}",
                "actions": [(train_model, [training, name, out])],
                "file_dep": [str(drive_file(training, out))],
                "targets": [str(model_folder(training, name, out) / CARD)],
                "uptodate": [config_changed(repr((training, contents[name])))],
            }
