"""The Deep Dynamics model (DDM): a network sets every coefficient of the single-track model, nothing corrects it.

After Chrosniak, Ning and Behl, "Deep Dynamics: Vehicle Dynamics Modeling With a Physics-Constrained Neural Network for
Autonomous Racing", RA-L 2024, and the sizes that are published for it: these are met exactly by a GRU that sees all seven
columns of the window, whose hidden states of all rows, side by side, enter the dense layers. As published there is no load
transfer and no residual, and the state advances by one Euler step; both are the model file's choice here.
"""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn

from dynssm_ros.learning.configuration import ModelConfig
from dynssm_ros.learning.models.dynssm.network import INPUTS, Output, PhysicsLayer
from dynssm_ros.runtime.artifact import Normalisation
from dynssm_ros.vehicle import COEFFICIENTS, Vehicle


class DDM(nn.Module):
    """``theta = theta_min + sigmoid(network(window)) * (theta_max - theta_min)``, and a step of the physics with it."""

    mean: Tensor
    std: Tensor
    lower: Tensor
    admissible: Tensor

    def __init__(self, config: ModelConfig, vehicle: Vehicle, normalisation: Normalisation) -> None:
        super().__init__()
        assert config.gru is not None
        assert config.dense is not None
        assert config.physics is not None
        self.register_buffer("mean", torch.tensor(normalisation.input_mean))
        self.register_buffer("std", torch.tensor(normalisation.input_std))
        self.register_buffer("lower", torch.tensor(vehicle.lower, dtype=torch.float32))
        self.register_buffer("admissible", torch.tensor(vehicle.upper - vehicle.lower, dtype=torch.float32))
        self.gru = nn.GRU(INPUTS, config.gru.hidden, config.gru.layers, batch_first=True)
        sizes = (config.H * config.gru.hidden, *[config.dense.width] * config.dense.layers)
        hidden = [nn.Sequential(nn.Linear(a, b), nn.Mish()) for a, b in pairwise(sizes)]
        self.dense = nn.Sequential(*hidden, nn.Linear(config.dense.width, len(COEFFICIENTS)))
        self.physics = PhysicsLayer(vehicle, config.physics)

    @property
    def layers(self) -> list[nn.Module]:
        """What is trained, from the input to the output: the GRU, the hidden dense layers, the output layer."""
        return [self.gru, *self.dense]

    def forward(self, window: Tensor) -> Output:
        """Raw windows ``(B, H, 7)`` to predictions that are all physics."""
        remembered, _ = self.gru((window - self.mean) / self.std)
        theta = self.lower + torch.sigmoid(self.dense(remembered.flatten(1))) * self.admissible
        increment = self.physics(window[:, -1], theta)
        return Output(increment, increment, theta, None, None)
