"""The optimisation loop: AdamW over shuffled batches, early stopping on validation windows, resumes after a kill."""

from __future__ import annotations

import hashlib
import math
import os
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from dynssm_ros import __version__
from dynssm_ros.errors import ConfigurationError
from dynssm_ros.files import replacing
from dynssm_ros.learning.dataset import TrainingWindows
from dynssm_ros.learning.losses import COMPONENTS, LossConfig, Scales, rollout_objective, scales
from dynssm_ros.learning.models.base import ModelConfig, TrainableModel
from dynssm_ros.progress import NamedProgress
from dynssm_ros.runtime.artifact import Normalisation
from dynssm_ros.vehicle import Vehicle

History = dict[str, list[float]]

_LEARNING_RATE_FLOOR = 0.02  # the cosine schedule ends at this fraction of the learning rate
_PLATEAU = 0.1  # of the epochs, after which a training is to be better than predicting the mean change
_FALLING = 0.95  # of the loss in the first half of these epochs; a loss that falls below in the second is no plateau
_PLATEAU_EPOCHS = 5  # but no fewer than these
_RESTART_RATE = 0.25  # of the learning rate, with each restart


@dataclass
class TrainingState:
    """All that changes while training but the model, and so all that a checkpoint holds beside it."""

    epoch: int = 0
    best_epoch: int = 0  # the one with the lowest validation loss; 0: the untrained model
    best_loss: float = float("inf")
    best: dict[str, Tensor] = field(default_factory=dict)
    history: History = field(default_factory=dict)  # mean loss per epoch: train/TERM and validation/TERM of COMPONENTS
    restarts: int = 0  # times that it began anew, out of a plateau


class Optimisation:
    """Adam over shuffled batches of ``training``; windows of ``validation`` say which epoch is best.

    ``scale`` gives the units of the losses. ``anew`` gives the model with other weights, for a restart; without it there
    is none. The file ``checkpoint`` is kept up to date.
    """

    def __init__(
        self,
        config: Any,
        vehicle: Vehicle,
        model: TrainableModel,
        *,
        scale: Normalisation,
        training: TrainingWindows,
        validation: TrainingWindows,
        checkpoint: Path,
        anew: Callable[[int], TrainableModel] | None = None,
        device: str | torch.device = "cpu",
    ) -> None:
        self.config = config
        self.anew = anew
        self.loss: LossConfig = config.loss
        self.settings = config.training
        self.steps = rollout_steps(config, vehicle)
        self.model = model.to(device)
        s_y, s_delta = scales(config.loss, scale)
        self.scales: Scales = (s_y.to(device), s_delta.to(device))
        self.H = config.rows(vehicle.sampling_time)
        self.device = torch.device(device)
        self.training, self.validation = training.to(self.device), validation.to(self.device)
        self.trained = [parameter for parameter in self.model.parameters() if parameter.requires_grad]
        self.optimiser, self.schedule = self._optimiser(1.0)
        self.shuffle = torch.Generator().manual_seed(config.training.seed)
        self.checkpoint = checkpoint
        self.identity = _identity(config, vehicle, training)
        self.state = TrainingState(history=_empty_history())

    def run(self, progress: NamedProgress | None) -> int:
        """Trains until the validation loss stops falling; the model is the best one then.

        Returns:
            Epochs that were done before.

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
                words = f"validation {validated['prediction']:.4g}, best {state.best_loss:.4g}"
                progress(state.epoch, settings.epochs, words)
            if self._on_plateau():
                state = self._restart()
        if state.epoch == 0:
            raise ConfigurationError(
                f"model {self.config.name}: diverged in the first epoch; expected a smaller learning_rate than "
                f"{settings.learning_rate:g}"
            )
        self.model.load_state_dict(state.best)
        return resumed_from

    def _on_plateau(self) -> bool:
        """Whether the loss has stopped falling without the model being any good, and the training can begin anew."""
        epochs = max(math.ceil(_PLATEAU * self.settings.epochs), _PLATEAU_EPOCHS)
        losses = self.state.history["validation/prediction"]
        if (
            self.state.epoch != epochs
            or min(losses[epochs // 2 :]) < _FALLING * min(losses[: epochs // 2])
            or self.anew is None
            or self.state.restarts >= self.settings.restarts
        ):
            return False
        self.model.eval()
        return unexplained(self.model, self.training, replace(self.validation, H=self.H)) >= 1.0

    def _restart(self) -> TrainingState:
        """Begins anew, from other weights and with a smaller learning rate."""
        assert self.anew is not None
        restarts = self.state.restarts + 1
        self.model.load_state_dict(self.anew(restarts).state_dict())
        self.optimiser, self.schedule = self._optimiser(_RESTART_RATE**restarts)
        self.state = TrainingState(history=_empty_history(), restarts=restarts)
        self._keep_if_better(self._validate()["prediction"])
        return self.state

    def _optimiser(self, share: float) -> tuple[torch.optim.Optimizer, torch.optim.lr_scheduler.LRScheduler]:
        """The optimiser with ``share`` of the learning rate, and its schedule."""
        rate = share * self.settings.learning_rate
        optimiser = torch.optim.AdamW(self.trained, lr=rate, weight_decay=self.settings.weight_decay, fused=True)
        if self.settings.schedule == "constant":
            return optimiser, torch.optim.lr_scheduler.ConstantLR(optimiser, factor=1.0)
        floor = rate * _LEARNING_RATE_FLOOR
        return optimiser, torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, self.settings.epochs, floor)

    def _keep_if_better(self, loss: float) -> None:
        if loss < self.state.best_loss:
            self.state.best_loss, self.state.best_epoch = loss, self.state.epoch
            self.state.best = {name: value.detach().clone() for name, value in self.model.state_dict().items()}

    def _epoch(self) -> dict[str, float]:
        self.model.train()
        totals = dict.fromkeys(COMPONENTS, 0.0)
        steps = self._ramped()
        for batch in self.training.epoch(self.shuffle, self.settings.batch_size):
            terms = self._terms(*batch, steps)
            self.optimiser.zero_grad()
            torch.stack(list(terms.values())).sum().backward()  # type: ignore[no-untyped-call]
            if self.settings.gradient_clip is not None:
                nn.utils.clip_grad_norm_(self.trained, self.settings.gradient_clip)
            self.optimiser.step()
            for term, value in terms.items():
                totals[term] += value.item() * len(batch[1]) / len(self.training)
        return totals

    @torch.no_grad()
    def _validate(self) -> dict[str, float]:
        self.model.eval()
        totals = dict.fromkeys(COMPONENTS, 0.0)
        for batch in self.validation.batches():
            for term, value in self._terms(*batch, self.steps).items():
                totals[term] += value.item() * len(batch[1]) / len(self.validation)
        return totals

    def _terms(self, window: Tensor, target: Tensor, steps: int) -> dict[str, Tensor]:
        if self.steps == 1:
            return self.model.terms(window, target, self.loss, self.scales)
        longer = self.steps - steps  # rows that this rollout does not reach
        if longer:
            window, target = window[:, :-longer], window[:, -longer, :3] - window[:, -longer - 1, :3]
        return rollout_objective(self.model, window, target, steps=steps, config=self.loss, by=self.scales)

    def _ramped(self) -> int:
        """Steps of the rollouts in this epoch: one until half of the epochs are done, all in the last quarter."""
        share = (self.state.epoch / max(self.settings.epochs, 1) - 0.5) / 0.25
        return 1 + round((self.steps - 1) * float(min(max(share, 0.0), 1.0)))

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
        if not os.path.isfile(self.checkpoint):
            return 0
        try:
            with zipfile.ZipFile(self.checkpoint) as archive:
                damaged = archive.testzip()  # torch does not compare the checksums that it writes
            content = torch.load(self.checkpoint, map_location=self.device, weights_only=True)
        except Exception:  # whatever a foreign or damaged file raises: it is not ours to continue
            return 0
        if damaged or not isinstance(content, dict) or content.get("identity") != self.identity:
            return 0
        self.model.load_state_dict(content["model"])
        self.optimiser.load_state_dict(content["optimiser"])
        self.schedule.load_state_dict(content["schedule"])
        self.shuffle.set_state(content["shuffle"].cpu())
        self.state = TrainingState(**{name: content[name] for name in vars(self.state)})
        return self.state.epoch


def rollout_steps(config: Any, vehicle: Vehicle) -> int:
    """Steps of the rollouts whose errors are minimised; 1 without."""
    loss: LossConfig | None = getattr(config, "loss", None)
    return 1 if loss is None or loss.rollout == 0 else max(1, round(loss.rollout / vehicle.sampling_time))


@torch.no_grad()
def squared_errors(model: TrainableModel, windows: TrainingWindows) -> Tensor:
    """Mean squared one-step error of each state over ``windows``, ``(3,)`` in squared m/s, m/s, rad/s."""
    squares = torch.zeros(3, dtype=torch.float64)
    for batch, target in windows.batches():
        squares += (model(batch).increment - target).double().square().sum(0).cpu()
    return squares / len(windows)


def unexplained(model: TrainableModel, training: TrainingWindows, validation: TrainingWindows) -> float:
    """Mean squared error on ``validation`` over that of predicting the mean change in ``training``, mean of the states."""
    of_mean = (validation.increments - training.increments.mean(0)).double().square().mean(0).cpu()
    return float((squared_errors(model, validation) / of_mean).mean())


def _empty_history() -> History:
    return {f"{part}/{term}": [] for part in ("train", "validation") for term in COMPONENTS}


def _identity(config: ModelConfig, vehicle: Vehicle, training: TrainingWindows) -> str:
    """Names a training by code, data, car and configuration, so that a checkpoint is never continued for another."""
    digest = hashlib.sha256(f"{__version__} {torch.__version__} {config.model_dump_json()}".encode())
    digest.update(vehicle.model_dump_json().encode())
    for rows in (training.matrix, training.ends):
        digest.update(np.ascontiguousarray(rows.cpu().numpy()).tobytes())
    return digest.hexdigest()
