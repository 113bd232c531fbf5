"""The contract of a trainable model: its configuration, what it computes, and what training asks of it.

A model is one file or folder: a subclass of :class:`ModelConfig` with its own blocks, and a subclass of
:class:`TrainableModel` that names it. :func:`dynssm_ros.learning.models.registry.register_model` makes it known by its
``kind``; everything else (train, export, evaluate, predict) works with the contract alone.
"""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import torch
from pydantic import Field, model_validator
from torch import Tensor, nn
from typing_extensions import Self

from dynssm_ros.configuration import StrictModel
from dynssm_ros.learning.dataset import SplitConfig, TrainingWindows
from dynssm_ros.learning.losses import LossConfig, Output, Scales, objective
from dynssm_ros.learning.models.physics import PhysicsConfig
from dynssm_ros.runtime.artifact import Normalisation
from dynssm_ros.runtime.coefficients import SPREAD
from dynssm_ros.vehicle import Vehicle


class TrainingConfig(SplitConfig):
    """Optimisation by AdamW over shuffled batches."""

    epochs: int = Field(ge=1)
    batch_size: int = Field(ge=1)
    learning_rate: float = Field(gt=0)
    schedule: Literal["cosine", "constant"] = Field(default="cosine", description="course of the learning rate")
    weight_decay: float = Field(default=0.0, ge=0)
    gradient_clip: float | None = Field(default=1.0, gt=0, description="largest norm of a gradient; null: any")
    patience: int = Field(ge=1, description="epochs without a better validation loss before it stops")
    restarts: int = Field(
        default=3,
        ge=0,
        description="times that a training begins anew, with other weights and a quarter of the learning rate, if after a "
        "tenth of its epochs (at least 5) it is no better than predicting the mean change",
    )

    @model_validator(mode="before")
    @classmethod
    def _without_augmentation(cls, content: Any) -> Any:
        """Reads what version 0.3 wrote: mirrored laps, if they are off, are the same as none."""
        if not isinstance(content, dict) or "augmentation" not in content:
            return content
        if content["augmentation"] != {"mirror": False}:
            raise ValueError("augmentation: this version does not mirror laps; train without it")
        return {name: value for name, value in content.items() if name != "augmentation"}

    @property
    def effort(self) -> tuple[int, int]:
        """Epochs at most, and training windows that are needed."""
        return self.epochs, self.batch_size


class GruConfig(StrictModel):
    """Recurrent encoder."""

    hidden: int = Field(ge=1)
    layers: int = Field(default=1, ge=1)


class OnlineConfig(StrictModel):
    """The online layer on top of the model: a Bayesian linear layer that keeps learning while the car drives."""

    lags: int = Field(default=10, ge=1, description="measured increments of the channel itself, back from the last")
    other_lags: int = Field(default=2, ge=0, description="the same of the other channels")
    input_lags: int = Field(default=3, ge=1, description="changes of throttle and steering")
    throttle_steps: bool | None = Field(
        default=None,
        description="also smooth steps of the throttle about twelve fractions, for forces that bend there: engine, brakes; "
        "null: in laps that coast, where they take 3 % off the error on left-out stretches",
    )
    error_average: float = Field(default=0.6, gt=0, description="the physics' mean error is that over so long (s)")
    memory: float = Field(
        default=1000.0, gt=0, description="time constant with which weights return to their prior (s)"
    )
    spread: dict[str, float] = Field(
        default_factory=lambda: dict(SPREAD),
        description="standard deviation of each coefficient's change from one day to another, as a share of its nominal "
        "value, for shifts of slip angles in rad; those not named stay as calibrated",
    )
    folds: int = Field(
        default=4,
        ge=1,
        description="stretches of the recording; the prior that is worth most on each was fitted without it",
    )


class ModelConfig(StrictModel):
    """What every model file has. A model's own configuration adds its blocks; a block that it does not have is refused."""

    name: str
    kind: str = Field(description="which model it is")
    history: float = Field(gt=0, description="length of the history window (s)")
    training: SplitConfig
    online: OnlineConfig | None = Field(default=None, description="null: none")

    def rows(self, T_s: float) -> int:
        """H, rows of the history window at the sampling time ``T_s`` (s)."""
        return steps_of(self.history, T_s)

    @property
    def with_physics(self) -> PhysicsConfig:
        """Its block ``physics``; of a model without one, what its online layer takes the car for."""
        block: PhysicsConfig | None = getattr(self, "physics", None)
        return block or PhysicsConfig()

    @property
    def start(self) -> ModelConfig | None:
        """The model that is trained first and that this one starts from."""
        return None

    @property
    def parts(self) -> int:
        """Parts of the recording that further models are trained without, to see what the network is worth; 0: none."""
        return self.online.folds if self.online else 0

    def with_training(self, **changes: Any) -> Self:
        """The same model with other training settings; those that it does not have are left out."""
        known = {name: value for name, value in changes.items() if name in type(self.training).model_fields}
        return self.model_copy(update={"training": self.training.model_copy(update=known)})


class TrainableModel(nn.Module):
    """Maps raw windows ``(B, H, 7)`` to an :class:`~dynssm_ros.learning.losses.Output`.

    Subclasses take ``(config, vehicle, normalisation)`` and register their buffers and parameters.

    Attributes:
        KIND: by which model files and cards name it.
        CONFIG: its configuration.
        EXTRA_ROWS: rows before the window that its loss reads as well.
        LEARNS: whether it predicts more than the calibrated physics.
    """

    KIND: ClassVar[str] = ""
    CONFIG: ClassVar[type[ModelConfig]] = ModelConfig
    EXTRA_ROWS: ClassVar[int] = 0
    LEARNS: ClassVar[bool] = True
    mean: Tensor  # of those that take scale_buffers, as the next
    std: Tensor
    increment_scale: Tensor

    def __init__(self, config: Any, vehicle: Vehicle, normalisation: Normalisation) -> None:
        super().__init__()

    def forward(self, window: Tensor) -> Output:
        """Raw windows ``(B, H, 7)`` to predictions."""
        raise NotImplementedError

    def terms(self, window: Tensor, target: Tensor, loss: LossConfig, scales: Scales) -> dict[str, Tensor]:
        """The weighted terms of the loss on windows ``(B, H + EXTRA_ROWS, 7)`` and increments ``(B, 3)``."""
        return objective(self(window), target, loss, scales)

    def fit(self, training: TrainingWindows) -> bool:
        """Fits in closed form; returns whether that is all the training there is."""
        return False

    def take_over(self, start: TrainableModel) -> None:
        """Starts from a trained model; see :attr:`ModelConfig.start`."""
        raise NotImplementedError

    def for_deployment(self) -> Self:
        """Prepares a copy of the model for export; returns itself."""
        return self.eval()


def steps_of(seconds: float, T_s: float) -> int:
    """Number of sampling times in a stretch of ``seconds``, at least one."""
    return max(1, round(seconds / T_s))


def scale_buffers(model: nn.Module, normalisation: Normalisation) -> None:
    """Registers mean and standard deviation of the inputs and s_delta as buffers ``mean``, ``std``, ``increment_scale``."""
    model.register_buffer("mean", torch.tensor(normalisation.input_mean))
    model.register_buffer("std", torch.tensor(normalisation.input_std))
    model.register_buffer("increment_scale", torch.tensor(normalisation.increment_scale))
