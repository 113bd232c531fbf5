"""Ridge regression from the normalised window to the state increment: the linear rival."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import torch
from pydantic import Field
from torch import Tensor, nn

from dynssm_ros.learning.dataset import SplitConfig, TrainingWindows
from dynssm_ros.learning.losses import Output
from dynssm_ros.learning.models.base import ModelConfig, TrainableModel, scale_buffers
from dynssm_ros.learning.models.physics import INPUTS
from dynssm_ros.runtime.artifact import Normalisation
from dynssm_ros.vehicle import Vehicle


class RidgeConfig(ModelConfig):
    """Model file of a ridge regression."""

    kind: Literal["ridge"] = "ridge"
    penalty: float = Field(default=1.0, gt=0, description="weight of the squared coefficients of standardised inputs")
    training: SplitConfig = Field(default_factory=SplitConfig)


class Ridge(TrainableModel):
    """``s_{t+1} - s_t = s_delta * (W vec(H_t) + b)`` with W by regularised least squares."""

    KIND = "ridge"
    CONFIG = RidgeConfig

    def __init__(self, config: RidgeConfig, vehicle: Vehicle, normalisation: Normalisation) -> None:
        super().__init__(config, vehicle, normalisation)
        self.penalty = config.penalty
        scale_buffers(self, normalisation)
        self.linear = nn.Linear(config.rows(vehicle.sampling_time) * INPUTS, 3)

    def forward(self, window: Tensor) -> Output:
        """Raw windows ``(B, H, 7)`` to predictions without physics."""
        features = ((window - self.mean) / self.std).flatten(1)
        return Output(self.increment_scale * self.linear(features), None, None, None, None)

    @torch.no_grad()
    def fit(self, training: TrainingWindows) -> bool:
        """Closed-form solution in double precision; the intercept is free of the penalty."""
        columns = self.linear.in_features
        centre, level = torch.zeros(columns, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
        for features, targets in self._scaled(training):
            centre += features.sum(0) / len(training)
            level += targets.sum(0) / len(training)
        gram = self.penalty * torch.eye(columns, dtype=torch.float64)
        moment = torch.zeros(columns, 3, dtype=torch.float64)
        for features, targets in self._scaled(training):
            x = features - centre
            gram += x.T @ x
            moment += x.T @ (targets - level)
        weights = torch.linalg.solve(gram, moment)
        self.linear.weight.copy_(weights.T)
        self.linear.bias.copy_(level - centre @ weights)
        return True

    def _scaled(self, training: TrainingWindows) -> Iterator[tuple[Tensor, Tensor]]:
        """Features and targets, batch by batch."""
        for windows, increments in training.batches():
            features = ((windows - self.mean) / self.std).flatten(1)
            yield features.double(), (increments / self.increment_scale).double()
