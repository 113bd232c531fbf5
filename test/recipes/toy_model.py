"""Recipe 2, a new model: the mean increment of the last rows, with one learned factor for each channel."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor, nn

from dynssm_ros import register_model
from dynssm_ros.learning.losses import LossConfig, Output
from dynssm_ros.learning.models.base import ModelConfig, TrainableModel, TrainingConfig
from dynssm_ros.runtime.artifact import Normalisation
from dynssm_ros.vehicle import Vehicle


class MomentumConfig(ModelConfig):
    """Model file of the toy."""

    kind: Literal["momentum"] = "momentum"
    first: float = 0.5
    loss: LossConfig
    training: TrainingConfig


@register_model
class Momentum(TrainableModel):
    """``s_{t+1} - s_t = factor * mean(s_k - s_{k-1})``."""

    KIND = "momentum"
    CONFIG = MomentumConfig

    def __init__(self, config: MomentumConfig, vehicle: Vehicle, normalisation: Normalisation) -> None:
        super().__init__(config, vehicle, normalisation)
        self.factor = nn.Parameter(torch.full((3,), config.first))

    def forward(self, window: Tensor) -> Output:
        """Raw windows ``(B, H, 7)`` to predictions."""
        increment = self.factor * (window[:, 1:, :3] - window[:, :-1, :3]).mean(dim=1)
        return Output(increment, None, None, None, None)
