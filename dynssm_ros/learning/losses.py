"""The physics-informed objective, term by term, Eq. (19) to (24)."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from dynssm_ros.learning.configuration import LossConfig
from dynssm_ros.learning.models.dynssm.network import Output
from dynssm_ros.runtime.artifact import Normalisation

COMPONENTS = ("prediction", "parameters", "correction", "physics")
Scales = tuple[Tensor, Tensor]


def scales(config: LossConfig, normalisation: Normalisation) -> Scales:
    """``(s_y, s_delta)`` of shape ``(3,)`` as the configuration defines them."""
    units = {"target": normalisation.state_scale, "increment": normalisation.increment_scale, "none": (1.0, 1.0, 1.0)}
    return torch.tensor(units[config.scale]), torch.tensor(normalisation.increment_scale)


def objective(output: Output, target: Tensor, config: LossConfig, by: Scales) -> dict[str, Tensor]:
    """All terms of the loss, weighted; their sum is the objective. Terms that are switched off are zero.

    Args:
        output: of the model for ``B`` windows.
        target: measured increments ``(B, 3)``.
        config: weights and switches.
        by: ``(s_y, s_delta)``.
    """
    s_y, s_delta = by
    error = (output.increment - target) / s_y
    zero = error.new_zeros(())
    squared = (
        error.square().mean()
        if config.robust == 0
        else 2 * functional.huber_loss(error, torch.zeros_like(error), delta=config.robust)
    )
    deviation, correction, physics = output.deviation, output.correction, output.physics
    return {
        "prediction": squared,
        "parameters": zero if deviation is None else config.parameters * deviation.square().mean(),
        "correction": (
            config.correction * correction.square().mean() if correction is not None and config.correction else zero
        ),
        "physics": (
            config.physics * ((output.increment - physics) / s_delta).square().mean()
            if physics is not None and config.physics
            else zero
        ),
    }
