"""Training windows changed at random, so that a model does not rely on which way the bends of a track turn."""

from __future__ import annotations

import torch
from torch import Tensor

from dynssm_ros.learning.models.base import AugmentationConfig

_MIRRORED = (1.0, -1.0, -1.0, 1.0, -1.0, 1.0, -1.0)  # the sign of each window column with left and right exchanged


class Augmentation:
    """Mirrors half of the windows of a batch, if that is switched on."""

    def __init__(self, config: AugmentationConfig, generator: torch.Generator) -> None:
        self.config = config
        self.generator = generator

    def __call__(self, window: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        """Raw windows ``(B, H, 7)`` and their increments ``(B, 3)``, changed."""
        if not self.config.mirror:
            return window, target
        chosen = (torch.rand(len(window), generator=self.generator) < 0.5).to(window.device)
        signs = torch.where(chosen[:, None], torch.tensor(_MIRRORED, device=window.device), 1.0)
        return window * signs[:, None], target * signs[:, :3]
