"""Ridge regression from the normalised window to the state increment: the honest linear rival."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from dynssm_ros.learning.models.dynssm.network import INPUTS, Output
from dynssm_ros.runtime.artifact import Normalisation


class Ridge(nn.Module):
    """``s_{t+1} - s_t = s_delta * (W vec(H_t) + b)`` with W by regularised least squares."""

    mean: Tensor
    std: Tensor
    increment_scale: Tensor

    def __init__(self, H: int, normalisation: Normalisation) -> None:
        super().__init__()
        self.register_buffer("mean", torch.tensor(normalisation.input_mean))
        self.register_buffer("std", torch.tensor(normalisation.input_std))
        self.register_buffer("increment_scale", torch.tensor(normalisation.increment_scale))
        self.linear = nn.Linear(H * INPUTS, 3)

    def forward(self, window: Tensor) -> Output:
        """Raw windows ``(B, H, 7)`` to predictions without physics."""
        features = ((window - self.mean) / self.std).flatten(1)
        return Output(self.increment_scale * self.linear(features), None, None, None, None)

    @torch.no_grad()
    def fit(self, windows: Tensor, increments: Tensor, penalty: float) -> None:
        """Closed-form solution in double precision.

        Args:
            windows: raw windows ``(N, H, 7)``.
            increments: measured ``s_{t+1} - s_t``, ``(N, 3)``.
            penalty: weight of the squared coefficients of standardised inputs; the intercept is free.
        """
        features = ((windows - self.mean) / self.std).flatten(1).double()
        targets = (increments / self.increment_scale).double()
        centre, level = features.mean(0), targets.mean(0)
        x, y = features - centre, targets - level
        gram = x.T @ x + penalty * torch.eye(x.shape[1], dtype=torch.float64)
        weights = torch.linalg.solve(gram, x.T @ y)
        self.linear.weight.copy_(weights.T)
        self.linear.bias.copy_(level - centre @ weights)
