"""What models that are fitted at once, not over epochs, have in common."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor

STATES = 3


def driven(rows: Tensor, mean: Tensor, std: Tensor) -> Tensor:
    """State and applied inputs of raw rows ``(..., 7)``, standardised by ``mean`` and ``std`` ``(7,)``, ``(..., 5)``."""
    state = (rows[..., :STATES] - mean[:STATES]) / std[:STATES]
    applied = (rows[..., 3:5] + rows[..., 5:7] - mean[3:5]) / std[3:5]
    return torch.cat([state, applied], dim=-1)


@torch.enable_grad()
def minimise(parameters: Iterable[Tensor], loss: Callable[[], Any], steps: int, rate: float) -> None:
    """So many steps of Adam."""
    optimiser = torch.optim.Adam(parameters, lr=rate)
    for _ in range(steps):
        optimiser.zero_grad()
        loss().backward()
        optimiser.step()
