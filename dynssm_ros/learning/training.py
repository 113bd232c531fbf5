"""Training: seeded, early stopping on blocks in time, resumes after a kill exactly where it was."""

from __future__ import annotations

import hashlib
import math
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from dynssm_ros import __version__
from dynssm_ros.errors import ConfigurationError
from dynssm_ros.files import replacing
from dynssm_ros.learning.configuration import LossConfig, ModelConfig
from dynssm_ros.learning.dataset import Windows, normalisation, split_windows
from dynssm_ros.learning.dynssm import DynSSM
from dynssm_ros.learning.losses import COMPONENTS, Scales, objective, scales
from dynssm_ros.learning.ridge import Ridge
from dynssm_ros.runtime.artifact import Normalisation
from dynssm_ros.signals.recording import Recording
from dynssm_ros.vehicle import Vehicle

History = dict[str, list[float]]
Progress = Callable[[int, int, str], None]
"""Called after each epoch with epochs done, epochs at most, and a line about them."""

_LEARNING_RATE_FLOOR = 0.02  # the cosine schedule ends at this fraction of the learning rate


@dataclass(frozen=True)
class Trained:
    """The outcome of a training."""

    config: ModelConfig
    vehicle: Vehicle
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


def train(
    recording: Recording,
    config: ModelConfig,
    vehicle: Vehicle,
    checkpoint: Path,
    device: str = "cpu",
    progress: Progress | None = None,
) -> Trained:
    """Trains a model; ``checkpoint`` is kept up to date and continued from if it belongs to the same training.

    Args:
        recording: training data; validation blocks are taken out of it.
        config: the model file.
        vehicle: the car whose coefficients are adapted.
        checkpoint: file beside the result; the caller removes it once the result is saved.
        device: ``cpu`` or ``cuda``.
        progress: told after each epoch.

    Raises:
        RecordingError: another sampling time than the vehicle's, or too little data.
        ConfigurationError: the training diverges at once.
    """
    recording.require_sampling_time(vehicle.sampling_time, f"vehicle {vehicle.name}")
    torch.set_num_threads(1)  # batches are small: more threads wait for each other longer than they compute
    torch.manual_seed(config.training.seed)
    training, validation = split_windows(recording, config.H, config.training)
    scale = normalisation(recording, training)
    if config.kind == "ridge":
        ridge = Ridge(config.H, scale)
        ridge.fit(*training.batch(slice(None)), penalty=config.ridge_penalty)
        run = _Run(ridge, {}, 0, 0)
    else:
        run = _Optimisation(config, vehicle, scale, training, validation, checkpoint, torch.device(device)).run(
            progress
        )
    model = run.model.cpu().eval()
    return Trained(
        config, vehicle, recording, model, scale, run.history, run.best_epoch, validation_rmse(model, validation),
        (len(training), len(validation)), run.resumed_from,
    )  # fmt: skip


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
    """Adam with a cosine schedule over shuffled batches."""

    def __init__(
        self,
        config: ModelConfig,
        vehicle: Vehicle,
        scale: Normalisation,
        training: Windows,
        validation: Windows,
        checkpoint: Path,
        device: torch.device,
    ) -> None:
        assert config.loss is not None
        self.name = config.name
        self.loss: LossConfig = config.loss
        self.settings = config.training
        self.model = DynSSM(config, vehicle, scale).to(device)
        s_y, s_delta = scales(config.loss, scale)
        self.scales: Scales = (s_y.to(device), s_delta.to(device))
        self.training, self.validation = training.to(device), validation.to(device)
        self.optimiser = torch.optim.AdamW(
            self.model.parameters(), lr=config.training.learning_rate, weight_decay=config.training.weight_decay
        )
        self.schedule = torch.optim.lr_scheduler.CosineAnnealingLR(
            self.optimiser, config.training.epochs, config.training.learning_rate * _LEARNING_RATE_FLOOR
        )
        self.shuffle = torch.Generator().manual_seed(config.training.seed)
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
        while state.epoch < settings.epochs and state.epoch - state.best_epoch < settings.patience:
            trained = self._epoch()
            validated = self._validate()
            if not math.isfinite(validated["prediction"]):  # what has diverged stays so
                break
            state.epoch += 1
            for part, terms in (("train", trained), ("validation", validated)):
                for term, value in terms.items():
                    state.history[f"{part}/{term}"].append(value)
            if validated["prediction"] < state.best_loss:
                state.best_loss, state.best_epoch = validated["prediction"], state.epoch
                state.best = {name: value.detach().clone() for name, value in self.model.state_dict().items()}
            self.schedule.step()
            self._save()
            if progress is not None:
                progress(
                    state.epoch,
                    settings.epochs,
                    f"validation {validated['prediction']:.4f}, best {state.best_loss:.4f}",
                )
        if not state.best:
            raise ConfigurationError(
                f"model {self.name}: diverged in the first epoch; expected a smaller learning_rate than "
                f"{settings.learning_rate:g}"
            )
        self.model.load_state_dict(state.best)
        return _Run(self.model, state.history, state.best_epoch, resumed_from)

    def _epoch(self) -> dict[str, float]:
        self.model.train()
        order = torch.randperm(len(self.training), generator=self.shuffle).to(self.training.ends.device)
        batches = torch.split(order, self.settings.batch_size)
        totals = dict.fromkeys(COMPONENTS, 0.0)
        for index in batches:
            window, target = self.training.batch(index)
            terms = objective(self.model(window), target, self.loss, self.scales)
            loss = torch.stack(list(terms.values())).sum()
            self.optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            nn.utils.clip_grad_norm_(self.model.parameters(), 1.0)
            self.optimiser.step()
            for term, value in terms.items():
                totals[term] += value.item() * len(index) / len(order)
        return totals

    @torch.no_grad()
    def _validate(self) -> dict[str, float]:
        self.model.eval()
        window, target = self.validation.batch(slice(None))
        return {
            term: value.item() for term, value in objective(self.model(window), target, self.loss, self.scales).items()
        }

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


def _identity(config: ModelConfig, vehicle: Vehicle, training: Windows) -> str:
    """Names a training by code, data, car and configuration, so that a checkpoint is never continued for another."""
    digest = hashlib.sha256(f"{__version__} {torch.__version__} {config.model_dump_json()}".encode())
    digest.update(vehicle.model_dump_json().encode())
    digest.update(np.ascontiguousarray(training.matrix.numpy()).tobytes())
    digest.update(training.ends.numpy().tobytes())
    return digest.hexdigest()
