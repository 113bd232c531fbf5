"""Training: seeded, early stopping on blocks in time, resumes after a kill exactly where it was."""

from __future__ import annotations

import hashlib
import math
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from dynssm_ros import __version__
from dynssm_ros.errors import ConfigurationError, RecordingError
from dynssm_ros.files import replacing
from dynssm_ros.learning.augmentation import Augmentation
from dynssm_ros.learning.calibration import calibrate
from dynssm_ros.learning.configuration import LossConfig, ModelConfig, TrainingConfig
from dynssm_ros.learning.dataset import Windows, all_windows, normalisation, split_windows
from dynssm_ros.learning.losses import COMPONENTS, Scales, objective, scales
from dynssm_ros.learning.models.ddm import DDM
from dynssm_ros.learning.models.dynssm.network import DynSSM
from dynssm_ros.learning.models.fthd import freeze, physics_loss
from dynssm_ros.learning.models.registry import build_model, modelled_vehicle
from dynssm_ros.learning.models.ridge import Ridge
from dynssm_ros.runtime.artifact import Normalisation
from dynssm_ros.signals.recording import Recording
from dynssm_ros.vehicle import Vehicle

History = dict[str, list[float]]
Progress = Callable[[int, int, str], None]
"""Called after each epoch with epochs done, epochs at most, and a line about them."""

_LEARNING_RATE_FLOOR = 0.02  # the cosine schedule ends at this fraction of the learning rate
_SHORTER = 4  # how many times fewer epochs the models have that only tell how large errors are on unknown laps


@dataclass(frozen=True)
class Trained:
    """The outcome of a training."""

    config: ModelConfig
    vehicle: Vehicle
    """The car as the model has it; see :func:`modelled_vehicle`."""
    recording: Recording
    model: nn.Module
    normalisation: Normalisation
    history: History
    """Mean loss per epoch: ``train/TERM`` and ``validation/TERM`` for each of ``COMPONENTS``."""
    best_epoch: int
    validation_rmse: tuple[float, float, float]
    windows: tuple[int, int]
    """Number of training and validation windows."""
    resumed_from: int = 0
    """Epochs that were already done, of all stages together."""
    start: Trained | None = None
    """The model that fine-tuning started from."""


def train(
    recording: Recording,
    config: ModelConfig,
    vehicle: Vehicle,
    checkpoint: Path,
    device: str = "cpu",
    progress: Progress | None = None,
) -> Trained:
    """Trains a model; ``checkpoint`` is kept up to date and continued from if it belongs to the same training.

    Some trainings have several stages with a checkpoint each, see :func:`checkpoints`: fine-tuning, and the models whose
    errors on a part that they do not know say how far the prediction can be trusted. A stage that is done is not repeated.

    Args:
        recording: training data; validation windows are taken out of it.
        config: the model file.
        vehicle: the car whose coefficients are adapted.
        checkpoint: file beside the result; the caller removes it once the result is saved.
        device: ``cpu`` or ``cuda``.
        progress: told after each epoch.

    Raises:
        RecordingError: another sampling time than the vehicle's, or too little data.
        ConfigurationError: the training diverges at once.
    """
    files = checkpoints(config, checkpoint)
    if config.fine_tuning is not None:
        start = config.fine_tuning.starts_from
        stages: tuple[int, ...] = (start.training.epochs, config.training.epochs)
        ddm = _train(recording, start, vehicle, files[0], device, _stage(progress, start.name, 0, stages))
        return _train(recording, config, vehicle, files[1], device, _stage(progress, config.name, 1, stages), ddm)
    parts = [np.arange(len(recording)) * config.parts // len(recording) == k for k in range(config.parts)]
    rests = [recording.select(~part) for part in parts]
    if not rests or not all(_can_be_trained_on(rest, config) for rest in rests):
        return _train(recording, config, vehicle, checkpoint, device, progress)
    shorter = config.with_training(epochs=max(1, config.training.epochs // _SHORTER))
    stages = (config.training.epochs, *[shorter.training.epochs] * len(parts))
    trained = _train(recording, config, vehicle, checkpoint, device, _stage(progress, config.name, 0, stages))
    errors = []
    for k, (part, rest, file) in enumerate(zip(parts, rests, files[1:], strict=True), 1):
        report = _stage(progress, f"{config.name} without part {k} of {len(parts)}", k, stages)
        without = _train(rest, shorter, vehicle, file, device, report).model
        assert isinstance(without, DynSSM)
        unknown = all_windows(recording.select(part), config.H, config.training.min_speed)
        errors.append(without.errors(*unknown.batch(slice(None))))
    assert isinstance(trained.model, DynSSM)
    trained.model.fit_variance(*(torch.cat(each) for each in zip(*errors, strict=True)))
    return trained


def _can_be_trained_on(recording: Recording, config: ModelConfig) -> bool:
    """Whether ``recording`` has windows enough for training and validation."""
    try:
        split_windows(recording, config.H, config.training)
    except RecordingError:
        return False
    return True


def checkpoints(config: ModelConfig, checkpoint: Path) -> list[Path]:
    """The files that a training with ``checkpoint`` keeps, in the order of its stages."""
    if config.fine_tuning is not None:
        return [checkpoint.with_suffix(".start.pt"), checkpoint]
    return [checkpoint, *[checkpoint.with_suffix(f".part{k + 1}.pt") for k in range(config.parts)]]


def _stage(progress: Progress | None, name: str, stage: int, epochs: tuple[int, ...]) -> Progress | None:
    """Progress of one of several stages, in epochs of all."""
    if progress is None:
        return None
    before = sum(epochs[:stage])
    return lambda done, _, words: progress(before + done, sum(epochs), f"{name}: {words}")


def _train(
    recording: Recording,
    config: ModelConfig,
    vehicle: Vehicle,
    checkpoint: Path,
    device: str,
    progress: Progress | None,
    start: Trained | None = None,
) -> Trained:
    """One stage; ``start`` is the outcome of the stage before."""
    recording.require_sampling_time(vehicle.sampling_time, f"vehicle {vehicle.name}")
    torch.set_num_threads(1)  # batches are small: more threads wait for each other longer than they compute
    torch.manual_seed(config.training.seed)
    if config.physics is not None and config.physics.nominal == "calibrated":
        vehicle = calibrate(recording, vehicle, min_speed=config.training.min_speed).vehicle
    vehicle = modelled_vehicle(config, vehicle)
    rows = config.H if start is None else config.H + 1  # FTHD compares the predictions of neighbouring windows
    training, validation = split_windows(recording, rows, config.training)
    scale = normalisation(recording, training) if start is None else start.normalisation
    model = build_model(config, vehicle, scale)
    if isinstance(model, Ridge):
        model.fit(*training.batch(slice(None)), penalty=config.ridge_penalty)
        run = _Run(model, {}, 0, 0)
    else:
        if start is not None:
            _take_over(start, model, config)
        optimisation = _Optimisation if start is None else _FineTuning
        run = optimisation(config, vehicle, model, scale, training, validation, checkpoint, torch.device(device)).run(
            progress
        )
    model = run.model.cpu().eval()
    if isinstance(model, DynSSM) and model.hindcast is not None:
        held = validation.batch(slice(None))
        model.fit_trust(*held)
        model.fit_variance(*model.errors(*held))
    return Trained(
        config, vehicle, recording, model, scale, run.history, run.best_epoch,
        validation_rmse(model, replace(validation, H=config.H)), (len(training), len(validation)),
        run.resumed_from + (start.resumed_from if start else 0), start,
    )  # fmt: skip


def _take_over(start: Trained, model: nn.Module, config: ModelConfig) -> None:
    """Gives ``model`` the weights of ``start`` and freezes as many layers as its configuration says."""
    assert isinstance(model, DDM)
    assert config.fine_tuning is not None
    model.load_state_dict(start.model.state_dict())
    freeze(model, config.fine_tuning.frozen)


def check_device(device: str) -> None:
    """Checks that torch can compute on ``device``.

    Raises:
        ConfigurationError: it cannot; names what there is.
    """
    available = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
    if device not in available:
        raise ConfigurationError(f"--device {device}: not available here; expected {' or '.join(available)}")


@torch.no_grad()
def validation_rmse(model: nn.Module, windows: Windows) -> tuple[float, float, float]:
    """One-step RMSE of each state over ``windows`` (m/s, m/s, rad/s)."""
    batch, target = windows.batch(slice(None))
    rmse = (model(batch).increment - target).square().mean(0).sqrt().tolist()
    return rmse[0], rmse[1], rmse[2]


@dataclass
class _Run:
    model: nn.Module
    history: History
    best_epoch: int
    resumed_from: int


@dataclass
class _State:
    """All that changes while training, and so all that a checkpoint holds."""

    epoch: int = 0
    best_epoch: int = 0
    best_loss: float = float("inf")
    best: dict[str, Tensor] = field(default_factory=dict)
    history: History = field(default_factory=dict)


class _Optimisation:
    """Adam over shuffled batches."""

    def __init__(
        self,
        config: ModelConfig,
        vehicle: Vehicle,
        model: nn.Module,
        scale: Normalisation,
        training: Windows,
        validation: Windows,
        checkpoint: Path,
        device: torch.device,
    ) -> None:
        assert config.loss is not None
        self.config = config
        self.loss: LossConfig = config.loss
        self.settings = config.training
        self.model = model.to(device)
        s_y, s_delta = scales(config.loss, scale)
        self.scales: Scales = (s_y.to(device), s_delta.to(device))
        self.training, self.validation = training.to(device), validation.to(device)
        self.trained = [parameter for parameter in self.model.parameters() if parameter.requires_grad]
        self.optimiser = torch.optim.AdamW(
            self.trained, lr=config.training.learning_rate, weight_decay=config.training.weight_decay
        )
        self.schedule = _schedule(config.training, self.optimiser)
        self.shuffle = torch.Generator().manual_seed(config.training.seed)
        self.augmentation = Augmentation(
            config.training.augmentation, vehicle.sampling_time, self.scales[1], self.shuffle
        )
        self.checkpoint = checkpoint
        self.identity = _identity(config, vehicle, training)
        self.state = _State(history={f"{part}/{term}": [] for part in ("train", "validation") for term in COMPONENTS})

    def run(self, progress: Progress | None) -> _Run:
        """Trains until the validation loss stops falling; returns the best model.

        Raises:
            ConfigurationError: it diverges before there is a best one.
        """
        resumed_from = self._resume()
        state, settings = self.state, self.settings
        if state.epoch == 0:  # the calibrated car itself is the first candidate
            self._keep_if_better(self._validate()["prediction"])
        while state.epoch < settings.epochs and state.epoch - state.best_epoch < settings.patience:
            trained = self._epoch()
            validated = self._validate()
            if not math.isfinite(validated["prediction"]):  # what has diverged stays so
                break
            state.epoch += 1
            for part, terms in (("train", trained), ("validation", validated)):
                for term, value in terms.items():
                    state.history[f"{part}/{term}"].append(value)
            self._keep_if_better(validated["prediction"])
            self.schedule.step()
            self._save()
            if progress is not None:
                progress(
                    state.epoch,
                    settings.epochs,
                    f"validation {validated['prediction']:.4g}, best {state.best_loss:.4g}",
                )
        if state.epoch == 0:
            raise ConfigurationError(
                f"model {self.config.name}: diverged in the first epoch; expected a smaller learning_rate than "
                f"{settings.learning_rate:g}"
            )
        self.model.load_state_dict(state.best)
        return _Run(self.model, state.history, state.best_epoch, resumed_from)

    def _keep_if_better(self, loss: float) -> None:
        if loss < self.state.best_loss:
            self.state.best_loss, self.state.best_epoch = loss, self.state.epoch
            self.state.best = {name: value.detach().clone() for name, value in self.model.state_dict().items()}

    def _epoch(self) -> dict[str, float]:
        self.model.train()
        order = torch.randperm(len(self.training), generator=self.shuffle).to(self.training.ends.device)
        batches = torch.split(order, self.settings.batch_size)
        totals = dict.fromkeys(COMPONENTS, 0.0)
        for index in batches:
            window, target = self.augmentation(*self.training.batch(index))
            terms = self._terms(window, target)
            loss = torch.stack(list(terms.values())).sum()
            self.optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            if self.settings.gradient_clip is not None:
                nn.utils.clip_grad_norm_(self.trained, self.settings.gradient_clip)
            self.optimiser.step()
            for term, value in terms.items():
                totals[term] += value.item() * len(index) / len(order)
        return totals

    @torch.no_grad()
    def _validate(self) -> dict[str, float]:
        self.model.eval()
        window, target = self.validation.batch(slice(None))
        return {term: value.item() for term, value in self._terms(window, target).items()}

    def _terms(self, window: Tensor, target: Tensor) -> dict[str, Tensor]:
        return objective(self.model(window), target, self.loss, self.scales)

    def _save(self) -> None:
        content: dict[str, Any] = vars(self.state) | {
            "identity": self.identity,
            "model": self.model.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "schedule": self.schedule.state_dict(),
            "shuffle": self.shuffle.get_state(),
        }
        with replacing(self.checkpoint) as aside:
            torch.save(content, aside)

    def _resume(self) -> int:
        """Continues from the checkpoint if it is of this very training; returns its epoch, 0 for a fresh start."""
        if not self.checkpoint.is_file():
            return 0
        try:
            with zipfile.ZipFile(self.checkpoint) as archive:
                damaged = archive.testzip()  # torch does not compare the checksums that it writes
            content = torch.load(self.checkpoint, map_location=self.training.ends.device, weights_only=True)
        except Exception:  # whatever a foreign or damaged file raises: it is not ours to continue
            return 0
        if damaged or not isinstance(content, dict) or content.get("identity") != self.identity:
            return 0
        self.model.load_state_dict(content["model"])
        self.optimiser.load_state_dict(content["optimiser"])
        self.schedule.load_state_dict(content["schedule"])
        self.shuffle.set_state(content["shuffle"].cpu())
        self.state = _State(**{name: content[name] for name in vars(self.state)})
        return self.state.epoch


class _FineTuning(_Optimisation):
    """FTHD's second stage, with the physics loss. Windows have ``H + 1`` rows."""

    def _terms(self, window: Tensor, target: Tensor) -> dict[str, Tensor]:
        assert self.config.fine_tuning is not None
        assert isinstance(self.model, DDM)
        output = self.model(window[:, 1:])
        disagreement = physics_loss(self.model, window, output, self.scales[0])
        terms = objective(output, target, self.loss, self.scales)
        return terms | {"physics": self.config.fine_tuning.physics * disagreement}


def _schedule(settings: TrainingConfig, optimiser: torch.optim.Optimizer) -> torch.optim.lr_scheduler.LRScheduler:
    if settings.schedule == "constant":
        return torch.optim.lr_scheduler.ConstantLR(optimiser, factor=1.0)
    floor = settings.learning_rate * _LEARNING_RATE_FLOOR
    return torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, settings.epochs, floor)


def _identity(config: ModelConfig, vehicle: Vehicle, training: Windows) -> str:
    """Names a training by code, data, car and configuration, so that a checkpoint is never continued for another."""
    digest = hashlib.sha256(f"{__version__} {torch.__version__} {config.model_dump_json()}".encode())
    digest.update(vehicle.model_dump_json().encode())
    digest.update(np.ascontiguousarray(training.matrix.numpy()).tobytes())
    digest.update(training.ends.numpy().tobytes())
    return digest.hexdigest()
