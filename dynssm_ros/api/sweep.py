"""Sweeps: other settings of a model file, scored on laps that were left out."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dynssm_ros.api.inputs import Log, PathLike, files, load_model, name_of, opened, vehicle_in_windows
from dynssm_ros.api.settings import EPOCHS, CommandsSettings, WorkerSettings, keywords, setting
from dynssm_ros.api.train import model_config, train
from dynssm_ros.errors import DataWarning
from dynssm_ros.extras import require
from dynssm_ros.progress import Progress
from dynssm_ros.signals.recording import concatenate
from dynssm_ros.vehicle import Vehicle

if TYPE_CHECKING:
    from dynssm_ros.evaluation.open_loop import Accuracy
    from dynssm_ros.evaluation.sweep import Sweep


class SweepSettings(CommandsSettings, WorkerSettings):
    """Settings of :func:`sweep`."""

    space: Any = setting("dynssm", "Fields of the model file and what they may be: name of a shipped one or a file.")
    trials: int = setting(24, "Trainings in all; more later go on from those.", ge=1)
    holdout: float = setting(0.25, "Last fraction of each recording, which is left out and scored on.", ge=0.01, le=0.9)
    seed: int = setting(0, "Of the choices.", ge=0)
    epochs: int | None = EPOCHS


@keywords(SweepSettings)
def sweep(
    recordings: Log | Sequence[Log],
    model: PathLike,
    vehicle: Vehicle | PathLike,
    out: PathLike,
    *,
    settings: SweepSettings,
    validation: Log | Sequence[Log] = (),
    on_progress: Progress | None = None,
) -> Sweep:
    """Trains a model with other settings of its file, again and again, and scores it on laps that were left out.

    The first trial is the file as it is. Each model is in ``OUT/trials``. Continues after a kill, or with more trials.

    Args:
        recordings: of one car, to train on.
        model: model file: shipped name or path.
        vehicle: the car.
        out: folder of the sweep.
        settings: all keywords as one object; workers of a cluster find recordings and ``out`` by the same paths.
        validation: recordings to score on, instead of the last fraction of each.
        on_progress: called with the trials that are done.

    Raises:
        ConfigurationError: a field that the model file does not have, or whose own value is not in the space.

    Example:
        >>> found = sweep("laps.parquet", "dynssm", "orca", "sweep")  # doctest: +SKIP
        >>> found.best.settings["training.learning_rate"]  # doctest: +SKIP
        0.0031
    """
    require("sweep", "sweep", "train", "race")
    from dynssm_ros.evaluation.sweep import Space, Sweep
    from dynssm_ros.learning.models.registry import field_of, load_model_config

    s = settings
    space = s.space if isinstance(s.space, Space) else Space.load(s.space)
    car, config = vehicle_in_windows(vehicle), load_model_config(model)
    learned, scored = list(files(recordings)), list(files(validation))
    opened([*learned, *scored], car)  # what is wrong with them is said once
    about = {
        "model": config.model_dump(mode="json"), "vehicle": car.model_dump(mode="json"), "holdout": s.holdout,
        "recordings": list(map(name_of, learned)), "validation": list(map(name_of, scored)),
        "commands": s.commands, "epochs": s.epochs,
    }  # fmt: skip
    found = Sweep(Path(out), space, {name: field_of(config, name) for name in space.choices}, s.seed, about)
    found.run(partial(_scored, learned, scored, model, car, Path(out), s), s.trials, s.workers, on_progress)
    return found


def _scored(
    recordings: list[Log], validation: list[Log], model: PathLike, car: Vehicle, out: Path, settings: SweepSettings,
    number: int, chosen: Mapping[str, Any],
) -> Accuracy:  # fmt: skip
    """Trains with chosen values of the model file, and scores on laps that were left out."""
    from dynssm_ros.evaluation.open_loop import accuracies
    from dynssm_ros.learning.models.registry import load_model_config, overrides

    folder, holdout = out / "trials" / f"{number:03d}", settings.holdout
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)
        config = model_config(load_model_config(model, overrides(chosen)), epochs=settings.epochs)
        train(recordings, config, car, folder, holdout=0.0 if validation else holdout, commands=settings.commands)
        trained = load_model(folder)
        logs = [log.with_commands(trained.commands) for log in opened(validation or recordings, car)]
    log = concatenate(logs if validation else [log.split_last(holdout)[1] for log in logs])
    return accuracies(log, {trained.name: trained})[trained.name]
