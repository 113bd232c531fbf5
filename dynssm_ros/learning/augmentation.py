"""Training windows changed at random, so that a model does not rely on what another track or set-up changes."""

from __future__ import annotations

import torch
from torch import Tensor

from dynssm_ros.learning.models.base import AugmentationConfig

_MIRRORED = (1.0, -1.0, -1.0, 1.0, -1.0, 1.0, -1.0)  # the sign of each window column with left and right exchanged


class Augmentation:
    """Mirrors and disturbs batches; where nothing is switched on they stay as they are.

    A disturbance is one more increment in every step, the same all over the window. The present state is kept, and the
    past is changed so that it leads there.
    """

    def __init__(self, config: AugmentationConfig, T_s: float, s_delta: Tensor, generator: torch.Generator) -> None:
        self.config = config
        self.T_s = T_s
        self.s_delta = s_delta
        self.generator = generator

    def __call__(self, window: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        """Raw windows ``(B, H, 7)`` and their increments ``(B, 3)``, changed."""
        config = self.config
        if config.mirror:
            window, target = self._mirrored(window, target)
        if config.offset:
            offset = config.offset * self._normal(window, 1)
            window = torch.cat([window[..., :4], window[..., 4:5] + offset[:, None], window[..., 5:]], dim=-1)
        if config.bank:
            each = (config.bank * self.s_delta * self._normal(window, 3))[:, None].expand(-1, window.shape[1], -1)
            window, target = _disturbed(window, target, each)
        if config.grip:
            lateral = self.T_s * window[..., 0] * window[..., 2] * (config.grip * self._normal(window, 1))
            each = torch.stack([torch.zeros_like(lateral), lateral, torch.zeros_like(lateral)], dim=-1)
            window, target = _disturbed(window, target, each)
        return window, target

    def _mirrored(self, window: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        chosen = (torch.rand(len(window), generator=self.generator) < 0.5).to(window.device)
        signs = torch.where(chosen[:, None], torch.tensor(_MIRRORED, device=window.device), 1.0)
        return window * signs[:, None], target * signs[:, :3]

    def _normal(self, window: Tensor, columns: int) -> Tensor:
        return torch.randn(len(window), columns, generator=self.generator).to(window.device)


def _disturbed(window: Tensor, target: Tensor, increments: Tensor) -> tuple[Tensor, Tensor]:
    """Adds ``increments`` ``(B, H, 3)``, of the step after each row, to the motion that led to the present state."""
    still_to_come = increments[:, :-1].flip(1).cumsum(1).flip(1)
    past = torch.cat([window[:, :-1, :3] - still_to_come, window[:, -1:, :3]], dim=1)
    return torch.cat([past, window[..., 3:]], dim=-1), target + increments[:, -1]
