"""Training: recordings to a model folder."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from dynssm_ros.api.calibrate import require_a_drive, require_physics
from dynssm_ros.api.inputs import Log, PathLike, files, held_out, joined, opened, vehicle_in_windows
from dynssm_ros.api.settings import EPOCHS, HOLDOUT, CommandsSettings, StrictSettings, keywords, setting
from dynssm_ros.errors import ConfigurationError
from dynssm_ros.extras import require
from dynssm_ros.progress import NamedProgress
from dynssm_ros.signals.recording import Recording
from dynssm_ros.vehicle import Vehicle
from dynssm_ros.vehicle.integrators import Integrator

if TYPE_CHECKING:
    from dynssm_ros.learning.models.base import ModelConfig
    from dynssm_ros.learning.stages import Trained
    from dynssm_ros.runtime.artifact import Artifact


class TrainSettings(CommandsSettings, StrictSettings):
    """Settings of :func:`train`."""

    holdout: float | None = HOLDOUT
    seed: int | None = setting(None, "Instead of the model file's.", ge=0)
    epochs: int | None = EPOCHS
    device: str = setting("cpu", "cpu or cuda.")
    memory: float | None = setting(
        None,
        "What the rows may take (MB): if they take more, a sample of each recording is trained on.",
        otherwise="any",
    )


class TrainingResult(NamedTuple):
    """A trained model and where it was written."""

    trained: Trained
    artifact: Artifact


@keywords(TrainSettings)
def train(
    recordings: Log | Sequence[Log],
    model: ModelConfig | PathLike,
    vehicle: Vehicle | PathLike,
    out: PathLike,
    *,
    settings: TrainSettings,
    on_progress: NamedProgress | None = None,
    picture: Callable[[Trained, Path], None] | None = None,
) -> TrainingResult:
    """Trains a model and writes its folder: card, weights, ONNX graph, metrics. Continues after a kill.

    Args:
        recordings: of one car.
        model: model file: shipped name or path.
        vehicle: the car; calibrated on the recordings first if the model asks for it.
        out: folder to write. ``OUT.checkpoint.pt`` beside it is removed when the model is there.
        settings: all keywords as one object.
        on_progress: called after each epoch with epochs done, epochs at most and a line about them.
        picture: draws the training to the file in the folder that it is given.

    Example:
        >>> laps = recorded(simulate("orca", "club", duration=20.0))
        >>> result = train(laps, "ridge", "orca", "ridge_model")
        >>> result.artifact.card.window
        30
    """
    require("train", "train")
    from dynssm_ros.learning.export import check_replaceable, save_artifact
    from dynssm_ros.learning.sampling import sampled
    from dynssm_ros.learning.stages import check_device, checkpoints, train

    s = settings
    check_device(s.device)
    folder = Path(out) if Path(out).name else Path(out).absolute()  # "." has no name to put the checkpoint beside
    check_replaceable(folder)
    config = model_config(model, seed=s.seed, epochs=s.epochs)
    checkpoint, car = folder.with_name(f"{folder.name}.checkpoint.pt"), vehicle_in_windows(vehicle)
    if s.memory is None:
        logs = opened(recordings, car, strict=s.strict)
        left_out = held_out(logs, s.holdout, car)
        data = joined(logs, s.commands, left_out)
    else:
        paths, begins = zip(*_looked_at(recordings, car, s.strict), strict=True)
        left_out = held_out(begins, s.holdout, car)
        data = sampled(paths, s.memory, commands=s.commands, holdouts=[left_out[each] for each in begins])
    require_a_drive(data, car)
    car, calibrated = car.with_held_out(left_out), partial(_calibrated, rows=len(data))
    trained = train(data, config, car, checkpoint, device=s.device, progress=on_progress, calibrate=calibrated)
    artifact = save_artifact(trained, folder, {"holdout": _in_brief(left_out), "device": s.device}, picture)
    for path in checkpoints(config, checkpoint):
        path.unlink(missing_ok=True)
    return TrainingResult(trained, artifact)


def _calibrated(laps: Recording, car: Vehicle, integrator: Integrator | None, *, rows: int) -> Vehicle:
    """The car calibrated on laps, taken as it is where it was. Those of all ``rows`` must be worth a car file; parts of
    them only tell how large errors are.
    """
    from dynssm_ros.identification.result.calibration import calibrate

    if integrator in (None, car.integrator) and car.was_calibrated_on(laps.fingerprints):
        return car
    found = calibrate(laps, car, integrator=integrator)
    if len(laps) == rows:
        require_physics(found)
    return found.vehicle


def model_config(model: ModelConfig | PathLike, **training: Any) -> ModelConfig:
    """A model file with other training settings, where they are not ``None``."""
    from dynssm_ros.learning.models.registry import load_model_config

    config = load_model_config(model) if isinstance(model, (str, Path)) else model
    return config.with_training(**{name: value for name, value in training.items() if value is not None})


def _in_brief(shares: Mapping[str, float]) -> float | dict[str, float]:
    """The share of all recordings, or that of each."""
    return next(iter(shares.values())) if len(set(shares.values())) == 1 else dict(shares)


def _looked_at(logs: Log | Sequence[Log], car: Vehicle, strict: bool) -> list[tuple[Path, str]]:
    """Files of recordings, each of which was looked at, see :func:`~dynssm_ros.api.inputs.opened`, and their beginnings."""
    found = []
    for log in files(logs):
        if isinstance(log, Recording):
            raise ConfigurationError(
                "memory: a recording that is not in a file takes its memory already; expected files"
            )
        found += [(Path(log), one.beginning) for one in opened(log, car, strict=strict)]
    return found
