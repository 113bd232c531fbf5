"""Training in stages: what a model starts from, the model itself, further models that tell how large its errors are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch

from dynssm_ros.arrays import Indices
from dynssm_ros.errors import ConfigurationError, RecordingError, SettingError
from dynssm_ros.learning.dataset import normalisation, split_ends, split_windows
from dynssm_ros.learning.earned_layer import LayerBase, earned_layer
from dynssm_ros.learning.models.base import ModelConfig, TrainableModel
from dynssm_ros.learning.models.registry import build_model
from dynssm_ros.learning.optimisation import (
    History,
    Optimisation,
    TrainingState,
    rollout_steps,
    squared_errors,
    unexplained,
)
from dynssm_ros.progress import NamedProgress
from dynssm_ros.runtime.artifact import Normalisation
from dynssm_ros.runtime.features import LayerFeatures
from dynssm_ros.runtime.online import OnlineLayer
from dynssm_ros.signals.recording import Recording
from dynssm_ros.vehicle import Vehicle
from dynssm_ros.vehicle.integrators import Integrator

Calibrate = Callable[[Recording, Vehicle, Integrator | None], Vehicle]
"""Fits the nominal values of a vehicle to a recording, for an integrator or, ``None``, the one that is closest to it."""

_SEEDS_APART = 1000  # of a restart from the training before
_SHORTER = 4  # how many times fewer epochs the models have that only tell how large errors are on unknown laps


@dataclass(frozen=True)
class Trained:
    """The outcome of a training."""

    config: ModelConfig
    vehicle: Vehicle  # the car as the model has it; see PhysicsConfig.modelled
    recording: Recording
    model: TrainableModel
    normalisation: Normalisation
    history: History  # mean loss per epoch: train/TERM and validation/TERM for each of COMPONENTS
    best_epoch: int
    validation_rmse: tuple[float, float, float]
    unexplained: float
    """Mean squared error on validation windows over that of predicting the mean change, mean of the states."""
    windows: tuple[int, int]  # number of training and validation windows
    resumed_from: int = 0  # epochs that were already done, of all stages together
    restarts: int = 0  # times that it began anew, out of a plateau
    start: Trained | None = None  # the model that fine-tuning started from
    features: LayerFeatures | None = None  # what the online layer sees; None without one, as the next
    online: OnlineLayer | None = None
    network_gain: float | None = None
    """Share of the online layer's error on left-out parts that the network takes away; ``None`` without either."""
    throttle_gain: float | None = None
    """The same of the throttle's steps; ``None`` if they were not tried."""

    @property
    def failure(self) -> str:
        """Why the training has failed, in words; empty if it has not. What an online layer stands on is judged by that."""
        if self.config.online is not None or self.unexplained < 1.0:
            return ""
        return (
            f"model {self.config.name}: the training failed: on validation windows its mean squared error is "
            f"{self.unexplained:.3g} of that of predicting the mean change; expected less than 1 (a smaller learning_rate, "
            f"another seed or more data may help)"
        )

    @property
    def deploys_network(self) -> bool:
        """Whether a network acts: there is no online layer, or the network has earned its place in it."""
        return self.features is None or self.features.layout.network

    @property
    def H(self) -> int:
        """Rows of the model's window."""
        return self.config.rows(self.vehicle.sampling_time)


@dataclass(frozen=True)
class _Stages:
    """The stages of a training: the whole, and one without each part of the laps, which only tells how large errors are."""

    config: ModelConfig
    vehicle: Vehicle
    device: str
    progress: NamedProgress | None
    calibrate: Calibrate | None
    files: list[Path]  # the checkpoint of each stage
    epochs: tuple[int, ...]  # of each stage at most

    def run(
        self, data: Recording, config: ModelConfig, stage: int, name: str, integrator: Integrator | None
    ) -> Trained:
        """One stage, from what the model starts from on."""
        car = self.vehicle
        if self.calibrate is not None and (config.with_physics.nominal == "calibrated" or config.online is not None):
            report = self._report(name, stage)
            if report is not None:
                report(0, 0, "calibrating the car")
            car = self.calibrate(data, car, integrator)
        file, start, done = self.files[stage], None, 0
        if config.start is not None:
            first = config.start.name if name == config.name else f"{name}: {config.start.name}"
            start = _train(data, config.start, car, _start_of(file), self.device, self._report(first, stage))
            done = start.config.training.effort[0]
        alone = len(self.epochs) == 1 and start is None
        return _train(
            data, config, car, file, self.device, self.progress if alone else self._report(name, stage, done), start
        )

    def _report(self, name: str, stage: int, done_before: int = 0) -> NamedProgress | None:
        """Progress of a stage, in epochs of all; ``done_before`` within the stage."""
        progress, before, total = self.progress, sum(self.epochs[:stage]) + done_before, sum(self.epochs)
        if progress is None:
            return None
        return lambda done, _, words: progress(before + done, total, f"{name}: {words}")


def train(
    recording: Recording,
    config: ModelConfig,
    vehicle: Vehicle,
    checkpoint: Path,
    *,
    device: str = "cpu",
    progress: NamedProgress | None = None,
    calibrate: Calibrate | None = None,
) -> Trained:
    """Trains a model; ``checkpoint`` is kept up to date and continued from if it belongs to the same training.

    Some trainings have several stages with a checkpoint each, see :func:`checkpoints`: fine-tuning, and the models whose
    predictions of a part that they do not know say what the network is worth. A stage that is done is not repeated.

    Args:
        recording: training data; validation windows are taken out of it.
        config: the model file.
        vehicle: the car whose coefficients are adapted.
        checkpoint: file beside the result; the caller removes it once the result is saved.
        device: ``cpu`` or ``cuda``.
        progress: called after each epoch.
        calibrate: from the data of a stage and the vehicle to the calibrated one, for models whose physics asks for it;
            ``None``: the vehicle is taken as calibrated. All stages step as the first.

    Raises:
        RecordingError: another sampling time than the vehicle's, or too little data.
        ConfigurationError: the training diverges at once.
    """
    parts = recording.stretches(config.parts) if config.parts else []
    left_out = [recording.select(part) for part in parts]
    if not all(_can_be_trained_on(_rest(recording, part), config, vehicle) for part in parts):
        parts = []
    shorter = config.with_training(epochs=max(1, config.training.effort[0] // _SHORTER))
    stages = _Stages(
        config, vehicle, device, progress, calibrate, checkpoints(config, checkpoint)[-1 - config.parts :],
        (_epochs(config), *(_epochs(shorter) for _ in parts)),
    )  # fmt: skip
    trained = stages.run(recording, config, 0, config.name, config.with_physics.integrator)
    if config.online is None:
        return trained
    if not trained.model.LEARNS:
        return _with_layer(trained, [(trained.model, part) for part in left_out])
    names = [f"{config.name} without part {k} of {len(parts)}" for k in range(1, len(parts) + 1)]
    others = [
        stages.run(_rest(recording, part), shorter, k, name, trained.vehicle.integrator).model
        for k, (part, name) in enumerate(zip(parts, names, strict=True), 1)
    ]
    return _with_layer(trained, list(zip(others, left_out, strict=False)))


def _epochs(config: ModelConfig) -> int:
    """Epochs of a stage at most, with those of the model that it starts from."""
    return config.training.effort[0] + (config.start.training.effort[0] if config.start else 0)


def _start_of(checkpoint: Path) -> Path:
    """The checkpoint of the model that another one starts from."""
    return checkpoint.with_suffix(".start.pt")


def _with_layer(trained: Trained, left_out: list[tuple[TrainableModel, Recording]]) -> Trained:
    """The model with its online layer; ``left_out``: parts of the laps, each with a model that was trained without it."""
    assert trained.config.online is not None
    physics = trained.config.with_physics
    base = LayerBase(trained.vehicle, physics, trained.normalisation, trained.H, trained.config.online)
    earned = earned_layer(base, trained.model, trained.recording, left_out)
    return replace(
        trained, features=earned.features, online=earned.layer, network_gain=earned.network_gain,
        throttle_gain=earned.throttle_gain,
    )  # fmt: skip


def checkpoints(config: ModelConfig, checkpoint: Path) -> list[Path]:
    """The files that a training with ``checkpoint`` keeps: of the model, then of those without a part of the laps."""
    stages = [checkpoint, *[checkpoint.with_suffix(f".part{k + 1}.pt") for k in range(config.parts)]]
    return stages if config.start is None else [*map(_start_of, stages), *stages]


def check_device(device: str) -> None:
    """Checks that torch can compute on ``device``.

    Raises:
        ConfigurationError: it cannot; names what there is.
    """
    available = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
    if device not in available:
        raise SettingError(f"device {device}: not available here; expected {' or '.join(available)}", "device")


def _training_ends(recording: Recording, config: ModelConfig, vehicle: Vehicle) -> Indices:
    """The last rows of the model's training windows."""
    H, least = config.rows(vehicle.sampling_time), config.training.effort[1]
    return split_ends(recording, H, config.training, vehicle.minimum_speed, least)[0]


def _rest(recording: Recording, part: slice) -> Recording:
    """A recording without a part."""
    return recording.select(np.delete(np.arange(len(recording)), part))


def _can_be_trained_on(recording: Recording, config: ModelConfig, vehicle: Vehicle) -> bool:
    """Whether ``recording`` has windows enough for training and validation."""
    try:
        _training_ends(recording, config, vehicle)
    except RecordingError:
        return False
    return True


def _begin(config: ModelConfig, vehicle: Vehicle, scale: Normalisation, restart: int) -> TrainableModel:
    """The model before training, with other weights for each restart."""
    torch.manual_seed(config.training.seed + _SEEDS_APART * restart)
    return build_model(config, vehicle, scale)


def _train(
    recording: Recording,
    config: ModelConfig,
    vehicle: Vehicle,
    checkpoint: Path,
    device: str,
    progress: NamedProgress | None,
    start: Trained | None = None,
) -> Trained:
    """One stage; ``start`` is the outcome of the stage before."""
    recording.require_sampling_time(vehicle.sampling_time, f"vehicle {vehicle.name}")
    recording.require_set_point(vehicle.inputs.set_point, f"vehicle {vehicle.name}")
    torch.set_num_threads(1)  # batches are small: more threads wait for each other longer than they compute
    vehicle = config.with_physics.modelled(vehicle)
    H = config.rows(vehicle.sampling_time)
    ends = _training_ends(recording, config, vehicle)
    scale = normalisation(recording, ends) if start is None else start.normalisation
    anew = partial(_begin, config, vehicle, scale)
    model = anew(0)
    ahead = rollout_steps(config, vehicle) - 1
    if ahead and model.EXTRA_ROWS:
        raise ConfigurationError(
            f"model {config.name}: loss.rollout: kind {config.kind} has a loss of its own; expected 0"
        )
    rows, least = H + model.EXTRA_ROWS + ahead, config.training.effort[1]
    training, validation = split_windows(recording, rows, config.training, vehicle.minimum_speed, least)
    if start is not None:
        model.take_over(start.model)
    state, resumed_from = TrainingState(), start.resumed_from if start else 0
    if not model.fit(training):
        optimisation = Optimisation(
            config, vehicle, model, scale=scale, training=training, validation=validation, checkpoint=checkpoint,
            anew=anew if start is None else None, device=device,
        )  # fmt: skip
        resumed_from += optimisation.run(progress)
        state = optimisation.state
    model.cpu().eval()
    held = replace(validation, H=H)
    v_x, v_y, omega = squared_errors(model, held).sqrt().tolist()
    return Trained(
        config, vehicle, recording, model, scale, state.history, state.best_epoch, (v_x, v_y, omega),
        unexplained(model, training, held), (len(training), len(validation)), resumed_from, state.restarts, start,
    )  # fmt: skip
