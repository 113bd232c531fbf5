"""The physics-informed objective, term by term, Eq. (19) to (24)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, NamedTuple

import torch
from pydantic import Field
from torch import Tensor
from torch.nn import functional

from dynssm_ros.configuration import StrictModel
from dynssm_ros.runtime.artifact import Normalisation


class Output(NamedTuple):
    """What a model computes for ``B`` windows; all increments are ``s_{t+1} - s_t``."""

    increment: Tensor  # final prediction, Eq. (30), as an increment (B, 3)
    physics: Tensor | None  # the physics' increment, Eq. (26), (B, 3)
    theta: Tensor | None  # adapted coefficients, Eq. (18), (B, 17)
    deviation: Tensor | None  # normalised parameter deviation, Eq. (20), (B, 17)
    correction: Tensor | None  # normalised output of the residual network, Eq. (28), (B, 3)
    nominal: Tensor | None = None
    """Increments of the physics with nominal coefficients from the latest rows, ``(B, rows, 3)``, for who needs them too."""


class LossConfig(StrictModel):
    """Weights and switches of the objective, Eq. (24)."""

    scale: Literal["target", "increment", "none"] = Field(
        default="increment",
        description="s_y: standard deviation of the target state (paper) or of its increment; none: errors as they are, "
        "in m/s, m/s and rad/s",
    )
    robust: float = Field(default=0.0, ge=0, description="Huber threshold in units of the scale; 0: squared error")
    parameters: float = Field(ge=0, description="lambda_theta")
    rollout: float = Field(
        default=0.0,
        ge=0,
        description="beyond the paper: length of the rollouts whose errors count (s), one step at first, all of it from the "
        "last quarter of the epochs on; 0: one step ahead",
    )
    correction: float = Field(default=0.0, ge=0, description="lambda_corr; 0 switches the residual penalty off")
    physics: float = Field(default=0.0, ge=0, description="lambda_phy; 0 switches the physics anchor off")


COMPONENTS = ("prediction", "parameters", "correction", "physics")
Scales = tuple[Tensor, Tensor]


def scales(config: LossConfig, normalisation: Normalisation) -> Scales:
    """``(s_y, s_delta)`` of shape ``(3,)`` as the configuration defines them."""
    units = {"target": normalisation.state_scale, "increment": normalisation.increment_scale, "none": (1.0, 1.0, 1.0)}
    return torch.tensor(units[config.scale]), torch.tensor(normalisation.increment_scale)


def rollout_objective(
    model: Callable[[Tensor], Output], rows: Tensor, target: Tensor, *, steps: int, config: LossConfig, by: Scales
) -> dict[str, Tensor]:
    """The mean over a rollout of :func:`objective`, where the error of a state ``k`` steps ahead counts over ``k``.

    ``rows`` are measured, ``(B, H + steps - 1, 7)``: the window, and the rows through which the rollout leads. ``target``
    is the measured increment from the last of them, ``(B, 3)``.
    """
    H = rows.shape[1] - steps + 1
    following = torch.cat([rows[:, H:, :3], rows[:, -1:, :3] + target[:, None]], dim=1)
    window = rows[:, :H]
    each = []
    for k in range(steps):
        output, now = model(window), window[:, -1, :3]
        # as an increment that ends where the measured path does
        each.append(objective(output, following[:, k] - now, config, (by[0] * (k + 1), by[1])))
        if k + 1 < steps:
            row = torch.cat([now + output.increment, rows[:, H + k, 3:]], dim=-1)
            window = torch.cat([window[:, 1:], row[:, None]], dim=1)
    return {name: torch.stack([terms[name] for terms in each]).mean() for name in COMPONENTS}


def objective(output: Output, target: Tensor, config: LossConfig, by: Scales) -> dict[str, Tensor]:
    """All terms of the loss, weighted by ``config``; their sum is the objective. Terms that are switched off are zero.

    ``target`` has the measured increments ``(B, 3)``; ``by`` is ``(s_y, s_delta)``.
    """
    s_y, s_delta = by
    error = (output.increment - target) / s_y
    if config.robust:
        prediction = 2 * functional.huber_loss(error, torch.zeros_like(error), delta=config.robust)
    else:
        prediction = error.square().mean()
    terms = dict.fromkeys(COMPONENTS, error.new_zeros(())) | {"prediction": prediction}
    if output.deviation is not None:
        terms["parameters"] = config.parameters * output.deviation.square().mean()
    if output.correction is not None and config.correction:
        terms["correction"] = config.correction * output.correction.square().mean()
    if output.physics is not None and config.physics:
        terms["physics"] = config.physics * ((output.increment - output.physics) / s_delta).square().mean()
    return terms
