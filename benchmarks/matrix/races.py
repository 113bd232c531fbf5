"""Driving the cells with each model in the controller."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from benchmarks.matrix.raced_cells import LAPS, PACE, Cell
from benchmarks.matrix.scored_cells import simulated_car
from benchmarks.matrix.scores import model_folder
from dynssm_ros.control.lap_learning import SAFE
from dynssm_ros.control.prediction_model import Adaptive, PredictionModel
from dynssm_ros.control.race import Course, Race, race
from dynssm_ros.control.race_models import TRUE, true_model
from dynssm_ros.control.reference import load_reference
from dynssm_ros.control.settings import Settings
from dynssm_ros.files import write_json
from dynssm_ros.runtime.baselines import SingleTrack
from dynssm_ros.runtime.registry import load_model

CALIBRATED = "calibrated"
BASELINES = (TRUE, CALIBRATED)
LEARNS = "dynssm"  # what is driven faster every lap
CALIBRATES = "rls"  # whose folder has the calibrated car
TRUE_PACES = (0.9, 1.0, 1.1, 1.2, 1.3)  # shares of the car's limits among which the true model's best is looked for
LEARNING_LAPS = 10
AS_IS = " as it is"  # ends the name of a model that needs no evidence


def outcome_file(cell: Cell, model: str, out: Path) -> Path:
    """Where the outcome of a cell with one of the models, or of :data:`BASELINES`, is."""
    return out / "cells" / cell.name / f"{model}.json"


def race_model(cell: Cell, name: str, out: Path, trained: Path) -> None:
    """Drives a cell with one of :data:`BASELINES`, or with a trained model: with evidence and as it is. ``trained``
    is the folder of the generalisation matrix, which has the models.
    """
    outcomes = {name: drive(cell, name, trained).to_json()}
    if name not in BASELINES:
        outcomes[name + AS_IS] = drive(cell, name, trained, evidence=False).to_json()
    write_json(outcome_file(cell, name, out), {"models": outcomes})


def drive(cell: Cell, name: str, trained: Path, evidence: bool = True) -> Race:
    """Drives a cell with one of :data:`BASELINES` or with a trained model; arguments as of :func:`race_model`."""
    course = _course(cell, PACE[cell.objective], evidence=evidence)
    if name == TRUE:
        model: PredictionModel = true_model(course.vehicle, cell.plant)
    else:
        calibrated = load_model(model_folder(cell.training, CALIBRATES, trained)).vehicle
        assert calibrated is not None
        folder = model_folder(cell.training, name, trained)
        known = SingleTrack(calibrated) if name == CALIBRATED else load_model(folder)
        model = Adaptive(known, calibrated, as_is=not evidence)
    return race(course, model)


def _course(cell: Cell, pace: float, laps: int = LAPS, evidence: bool = True, learns: bool = False) -> Course:
    """What is driven in a cell, the line with the share ``pace`` of the car's limits."""
    car, road = simulated_car(cell.car), cell.road
    return Course(
        car.with_effects(cell.effects.items()),
        road,
        cell.plant,
        load_reference("racing", car, road, pace),
        Settings.of(car, cell.objective, evidence=evidence),
        laps,
        sensing=cell.sensing,
        learning=car if learns else None,
    )


def learning_file(cell: Cell, out: Path) -> Path:
    """Where the outcome of a cell that is driven faster every lap is."""
    return out / "learning" / f"{cell.name}.json"


def learn_cell(cell: Cell, out: Path, trained: Path, model: str) -> None:
    """Drives a cell faster every lap with ``model`` of the folder ``trained``, and with the true model at several
    paces.
    """
    best, learned = true_best(cell), learn(cell, trained, model)
    write_json(learning_file(cell, out), {"true_best_s": best, "learned": learned.to_json()})


def true_best(cell: Cell) -> float | None:
    """Time of the true model's last lap (s) at the best of :data:`TRUE_PACES` that stays on the road, if one does."""
    best = []
    for pace in TRUE_PACES:
        course = _course(cell, pace)
        outcome = race(course, true_model(course.vehicle, cell.plant))
        if outcome.completed and not outcome.outside:
            best.append(outcome.lap_times[-1])
    return min(best, default=None)


def learn(cell: Cell, trained: Path, model: str) -> Race:
    """Drives a cell faster every lap; arguments as of :func:`learn_cell`."""
    knowledge = Adaptive(load_model(model_folder(cell.training, model, trained)), simulated_car(cell.car))
    return race(_course(cell, SAFE, LEARNING_LAPS, learns=True), knowledge)


def read_cell(cell: Cell, models: Iterable[str], out: Path) -> dict[str, Any] | None:
    """The outcomes of a cell with :data:`BASELINES` and ``models``; ``None`` unless it was driven with all of them."""
    outcomes: dict[str, Any] = {}
    for name in (*BASELINES, *models):
        outcome = _read(outcome_file(cell, name, out))
        if outcome is None:
            return None
        outcomes |= outcome["models"]
    return outcomes


def read_learning(cell: Cell, out: Path) -> dict[str, Any] | None:
    """The outcome of a cell that was driven faster every lap; ``None`` if it was not."""
    return _read(learning_file(cell, out))


def _read(file: Path) -> dict[str, Any] | None:
    return json.loads(file.read_text(encoding="utf-8")) if file.exists() else None
