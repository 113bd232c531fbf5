"""Recursive least squares on the calibrated physics: the online layer without a network, the baseline of all learned models.

Nothing is trained but the layer's prior. What a network earns is what it predicts better than this.
"""

from __future__ import annotations

from typing import Literal

from pydantic import Field
from torch import Tensor

from dynssm_ros.learning.dataset import SplitConfig, TrainingWindows
from dynssm_ros.learning.losses import Output
from dynssm_ros.learning.models.base import ModelConfig, OnlineConfig, TrainableModel
from dynssm_ros.learning.models.physics import PhysicsConfig, PhysicsLayer
from dynssm_ros.runtime.artifact import Normalisation
from dynssm_ros.vehicle import Vehicle


class RlsConfig(ModelConfig):
    """Model file of the online layer alone."""

    kind: Literal["rls"] = "rls"
    physics: PhysicsConfig = Field(default_factory=lambda: PhysicsConfig(nominal="calibrated"))
    online: OnlineConfig = Field(default_factory=OnlineConfig)
    training: SplitConfig = Field(default_factory=SplitConfig)


class Rls(TrainableModel):
    """The physics with nominal coefficients; the rest is the online layer's."""

    KIND = "rls"
    CONFIG = RlsConfig
    LEARNS = False
    nominal: Tensor

    def __init__(self, config: RlsConfig, vehicle: Vehicle, normalisation: Normalisation) -> None:
        super().__init__(config, vehicle, normalisation)
        self.physics = PhysicsLayer(vehicle, config.physics)
        self.register_buffer("nominal", config.physics.theta_0(vehicle))

    def forward(self, window: Tensor) -> Output:
        """Raw windows ``(B, H, 7)`` to predictions."""
        over = self.physics.over(window, self.nominal, window.shape[1])
        moved = over[:, -1]
        return Output(moved, moved, self.nominal.expand(window.shape[0], -1), None, None, over)

    def fit(self, training: TrainingWindows) -> bool:
        """There is nothing to fit."""
        return True
