"""Training: recordings to a model folder."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from dynssm_ros.api.inputs import Log, PathLike, files, joined, opened, vehicle_in_windows
from dynssm_ros.api.settings import EPOCHS, CommandsSettings, keywords, setting
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


class TrainSettings(CommandsSettings):
    """Settings of :func:`train`."""

    holdout: float = setting(
        0.0, "Leave the last fraction of each recording out, for an evaluation on it.", ge=0.0, le=0.9
    )
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
    from dynssm_ros.identification.result.calibration import calibrate
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
        data = joined(opened(recordings, car), s.commands, s.holdout)
    else:
        data = sampled(_looked_at(recordings, car), s.memory, commands=s.commands, holdout=s.holdout)

    def calibrated(laps: Recording, car: Vehicle, integrator: Integrator | None) -> Vehicle:
        if integrator in (None, car.integrator) and car.was_calibrated_on(laps.fingerprints):
            return car
        return calibrate(laps, car, integrator=integrator).vehicle

    trained = train(data, config, car, checkpoint, device=s.device, progress=on_progress, calibrate=calibrated)
    artifact = save_artifact(trained, folder, {"holdout": s.holdout, "device": s.device}, picture)
    for path in checkpoints(config, checkpoint):
        path.unlink(missing_ok=True)
    return TrainingResult(trained, artifact)


def model_config(model: ModelConfig | PathLike, **training: Any) -> ModelConfig:
    """A model file with other training settings, where they are not ``None``."""
    from dynssm_ros.learning.models.registry import load_model_config

    config = load_model_config(model) if isinstance(model, (str, Path)) else model
    return config.with_training(**{name: value for name, value in training.items() if value is not None})


def _looked_at(logs: Log | Sequence[Log], car: Vehicle) -> list[Path]:
    """Files of recordings, each of which was looked at; see :func:`~dynssm_ros.api.inputs.opened`."""
    found = []
    for log in files(logs):
        if isinstance(log, Recording):
            raise ConfigurationError(
                "memory: a recording that is not in a file takes its memory already; expected files"
            )
        opened(log, car)
        found.append(Path(log))
    return found
