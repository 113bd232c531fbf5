"""Training the models of a training, and scoring them on a cell."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

import dynssm_ros
from benchmarks.matrix.scored_cells import Cell, Training, test_drive, training_drive
from dynssm_ros.evaluation.open_loop import evaluate
from dynssm_ros.files import write_json
from dynssm_ros.runtime.baselines import Persistence, SingleTrack, SingleTrackEwma
from dynssm_ros.runtime.contract import WindowModel
from dynssm_ros.runtime.registry import load_model, with_offline
from dynssm_ros.signals.recording import concatenate
from dynssm_ros.simulation.laps import SimulationError
from dynssm_ros.vehicle import load_vehicle

MODELS: dict[str, dict[str, Any]] = {"rls": {"base": "rls"}, "ridge": {"base": "ridge"}, "dynssm": {"base": "dynssm"}}
"""What is trained, as changes of shipped model files."""
ABLATIONS: dict[str, dict[str, Any]] = {
    "no_innovation": {"base": "dynssm", "innovation": None},
    "rollout_loss": {"base": "dynssm", "loss": {"rollout": 0.3}, "training": {"epochs": 20}},
    "ssm_and_head": {
        "base": "dynssm", "ssm": {"channels": 24, "states": 8}, "adaptation": {"hidden": 24, "alpha": 0.5},
        "loss": {"parameters": 0.01},
    },
    "rls_one_lag": {"base": "rls", "online": {"lags": 1, "other_lags": 1, "input_lags": 1}},
    "rls_long_lags": {"base": "rls", "online": {"lags": 15, "other_lags": 15, "input_lags": 15}},
    "rls_memory_100_s": {"base": "rls", "online": {"memory": 100.0}},
    "rls_hardly_learning": {"base": "rls", "online": {"memory": 1.0}},
}  # fmt: skip
RIVALS: dict[str, dict[str, Any]] = {
    "gp": {"base": "gp"}, "ddm": {"base": "ddm_{size}"}, "fthd": {"base": "fthd_{size}"},
}  # fmt: skip
"""Models of others, with what their authors chose for a car of about that size: ``orca`` or ``av21``."""
SETS = {"shipped": MODELS, "ablations": ABLATIONS, "rivals": RIVALS}
BASELINES = ("persistence", "single_track", "single_track_ewma", "ridge", "rls")
ROLLOUT_STRIDE = 5
_HEAVY = 100.0  # kg


def models_of(sets: Iterable[str]) -> dict[str, dict[str, Any]]:
    """What is trained in all: those of some of :data:`SETS`."""
    return {name: content for each in sets for name, content in SETS[each].items()}


def model_folder(training: Training, model: str, out: Path) -> Path:
    """Where a trained model is."""
    return out / "models" / training.name / model


def drive_file(training: Training, out: Path) -> Path:
    """The laps of a training."""
    return out / "drives" / f"{training.name}.parquet"


def drive(training: Training, out: Path, data: Path) -> None:
    """Makes the laps of a training."""
    concatenate(training_drive(training, data)).save(drive_file(training, out))


def train_model(training: Training, model: str, out: Path) -> None:
    """Trains one of :func:`models_of`."""
    import benchmarks.rivals  # noqa: F401 - registers them
    from dynssm_ros.learning.models.registry import load_model_config, merge, parse_model_config

    content = dict(models_of(SETS)[model])
    size = "av21" if load_vehicle(training.vehicle).constants.m > _HEAVY else "orca"
    base = load_model_config(content.pop("base").format(size=size)).model_dump(mode="json")
    config = parse_model_config({**merge(base, content), "name": model}, model)
    dynssm_ros.train(drive_file(training, out), config, training.vehicle, model_folder(training, model, out))


def cell_file(cell: Cell, out: Path) -> Path:
    """Where the scores of a cell are."""
    return out / "cells" / f"{cell.name}.json"


def score_cell(cell: Cell, out: Path, data: Path, sets: Iterable[str]) -> None:
    """Scores all models on a cell; ``null`` if the changed car cannot be driven."""
    trained = {name: load_model(model_folder(cell.training, name, out)) for name in models_of(sets)}
    car = trained["rls"].vehicle
    assert car is not None
    models: dict[str, WindowModel] = {
        "persistence": Persistence(), "single_track": SingleTrack(car), "single_track_ewma": SingleTrackEwma(car),
        **with_offline(trained),
    }  # fmt: skip
    try:
        laps = concatenate(test_drive(cell, data))
    except SimulationError as error:
        write_json(cell_file(cell, out), {"scores": None, "why": str(error)})
        return
    evaluation = evaluate(laps, models, min_speed=car.minimum_speed, stride=ROLLOUT_STRIDE, calls=1)
    scores = {}
    for name, score in evaluation.scores.items():
        covered = score.coverage_90
        scores[name] = {
            "rmse": [_number(value) for value in score.rmse],
            "ade": _number(score.rollout.ade),
            "fde": _number(score.rollout.fde),
            "coverage": None if covered is None else [_number(value) for value in covered],
        }
    gains = {}
    for name in trained:
        metrics = json.loads((model_folder(cell.training, name, out) / "metrics.json").read_text(encoding="utf-8"))
        gains[name] = metrics.get("network_gain")
    write_json(cell_file(cell, out), {"scores": scores, "network_gain": gains, "rows": len(evaluation.rows)})


def _number(value: float) -> float:
    """A finite number for JSON: what diverged is very large."""
    return float(value) if np.isfinite(value) else 1e30


def read_cell(cell: Cell, out: Path) -> dict[str, Any] | None:
    """The scores of a cell; ``None`` if there are none."""
    file = cell_file(cell, out)
    content = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {"scores": None}
    return content if content["scores"] is not None else None
