"""The Deep Dynamics model (DDM): a network sets every coefficient of the single-track model, nothing corrects it.

After Chrosniak, Ning and Behl, "Deep Dynamics: Vehicle Dynamics Modeling With a Physics-Constrained Neural Network for
Autonomous Racing", RA-L 2024, and the sizes that are published for it: these are met exactly by a GRU that sees all seven
columns of the window, whose hidden states of all rows, side by side, enter the dense layers. As published there is no load
transfer and no residual, and the state advances by one Euler step; both are the model file's choice here.
"""

from __future__ import annotations

from itertools import pairwise
from typing import ClassVar, Literal

import torch
from pydantic import Field
from torch import Tensor, nn

from dynssm_ros.configuration import StrictModel
from dynssm_ros.learning.losses import LossConfig, Output
from dynssm_ros.learning.models.base import GruConfig, ModelConfig, TrainableModel, TrainingConfig
from dynssm_ros.learning.models.physics import INPUTS, PhysicsConfig, PhysicsLayer
from dynssm_ros.runtime.artifact import Normalisation
from dynssm_ros.vehicle import COEFFICIENTS, Vehicle


class DenseConfig(StrictModel):
    """Hidden dense layers, all of the same width."""

    layers: int = Field(ge=1)
    width: int = Field(ge=1)


class DdmConfig(ModelConfig):
    """Model file of a DDM."""

    kind: Literal["ddm", "fthd", "ekf_fthd"] = "ddm"
    gru: GruConfig
    dense: DenseConfig
    physics: PhysicsConfig
    loss: LossConfig
    training: TrainingConfig


class DDM(TrainableModel):
    """``theta = theta_min + sigmoid(network(window)) * (theta_max - theta_min)``, and a step of the physics with it."""

    KIND = "ddm"
    CONFIG: ClassVar[type[ModelConfig]] = DdmConfig
    lower: Tensor
    admissible: Tensor

    def __init__(self, config: DdmConfig, vehicle: Vehicle, normalisation: Normalisation) -> None:
        super().__init__(config, vehicle, normalisation)
        self.register_buffer("mean", torch.tensor(normalisation.input_mean))
        self.register_buffer("std", torch.tensor(normalisation.input_std))
        self.register_buffer("lower", torch.tensor(vehicle.lower, dtype=torch.float32))
        self.register_buffer("admissible", torch.tensor(vehicle.upper - vehicle.lower, dtype=torch.float32))
        self.gru = nn.GRU(INPUTS, config.gru.hidden, config.gru.layers, batch_first=True)
        H = config.rows(vehicle.sampling_time)
        sizes = (H * config.gru.hidden, *[config.dense.width] * config.dense.layers)
        hidden = [nn.Sequential(nn.Linear(a, b), nn.Mish()) for a, b in pairwise(sizes)]
        self.dense = nn.Sequential(*hidden, nn.Linear(config.dense.width, len(COEFFICIENTS)))
        self.physics = PhysicsLayer(vehicle, config.physics)

    @property
    def layers(self) -> list[nn.Module]:
        """What is trained, from the input to the output: the GRU, the hidden dense layers, the output layer."""
        return [self.gru, *self.dense]

    def hidden(self, window: Tensor) -> Tensor:
        """The last hidden layer ``(B, width)`` for raw windows ``(B, H, 7)``."""
        remembered, _ = self.gru((window - self.mean) / self.std)
        layer: Tensor = self.dense[:-1](remembered.flatten(1))
        return layer

    def coefficients(self, hidden: Tensor) -> Tensor:
        """``theta`` ``(B, 17)`` from the last hidden layer."""
        return self.lower + torch.sigmoid(self.dense[-1](hidden)) * self.admissible

    def forward(self, window: Tensor) -> Output:
        theta = self.coefficients(self.hidden(window))
        increment = self.physics.over(window, theta[:, None], 1)[:, 0]
        return Output(increment, increment, theta, None, None)
