"""Beyond the paper: what the window tells of the present error of the physics.

On another track or with another set-up, speeds and forces leave the range of the training laps, and the physics errs in a new
way: a banked turn, an offset of the steering. Two things stay as they were. Increments have the same size, and an error
that the physics just made, it makes again. The modules here are built on them. All increments are in units of ``s_delta``.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from dynssm_ros.learning.models.dynssm.config import InnovationConfig
from dynssm_ros.runtime.artifact import Normalisation

CHANNELS = 3
_INCREMENT_LIMIT = 4.0  # in units of s_delta; beyond it the encoders learn nothing more from the size
_INPUT_CHANGE_SHARE = 0.1  # what an input changes in a step, as a share of its standard deviation


def limited(value: Tensor, limit: Tensor | float = _INCREMENT_LIMIT) -> Tensor:
    """``value`` squeezed smoothly to less than ``limit``, by default the range that the training laps have seen."""
    return limit * torch.tanh(value / limit)


def centred(rows: Tensor) -> Tensor:
    """Rows ``(B, K, C)`` less their mean over the window."""
    return rows - rows.mean(dim=1, keepdim=True)


class Increments(nn.Module):
    """Window rows as changes: what the encoders see when absolute speeds and forces shall not matter."""

    std: Tensor
    increment_scale: Tensor
    FEATURES = 10

    def __init__(self, normalisation: Normalisation) -> None:
        super().__init__()
        self.register_buffer("std", torch.tensor(normalisation.input_std)[CHANNELS:])
        self.register_buffer("increment_scale", torch.tensor(normalisation.increment_scale))

    def states(self, window: Tensor) -> Tensor:
        """``s_k - s_{k-1}`` of raw windows ``(B, H, 7)``, ``(B, H - 1, 3)``."""
        return (window[:, 1:, :CHANNELS] - window[:, :-1, :CHANNELS]) / self.increment_scale

    def forward(self, window: Tensor, increments: Tensor) -> Tensor:
        """Features ``(B, H - 1, 10)``: increments, the same about their mean, changes of feedback, and commands.

        Commands are increments on the feedback by themselves.
        """
        feedback = window[:, 1:, CHANNELS : CHANNELS + 2] - window[:, :-1, CHANNELS : CHANNELS + 2]
        asked = window[:, 1:, CHANNELS + 2 :]
        inputs = torch.cat([feedback / self.std[:2], asked / self.std[:2]], dim=-1) / _INPUT_CHANGE_SHARE
        return limited(torch.cat([increments, centred(increments), inputs], dim=-1))


class InnovationFilter(nn.Module):
    """The physics with its own recent one-step errors carried forward: its prediction in innovation form.

    With the physics' increment ``p_k`` from row ``k``, the measured one ``d_k`` that led to it and the error
    ``e_k = d_k - p_{k-1}``,

        q_k = (I + A) (p_k + m_k) + sum_j [ W_j d_{k-j} + V_j (e_{k-j} - m_k) ],   m_k = sum_j g_j e_{k-j}

    where ``g`` is an exponential average over ``taps`` steps with a learned decay for each channel. A constant error of the
    physics vanishes exactly; ``A``, ``W`` and ``V`` start at zero and learn the noise and the dynamics of the rest. No
    term is constant, and none is a function of the absolute state: the filter means the same on any track.
    """

    def __init__(self, config: InnovationConfig, taps: int) -> None:
        super().__init__()
        self.taps = taps
        self.log_odds = nn.Parameter(torch.full((CHANNELS,), config.decay).logit())
        self.A = nn.Parameter(torch.zeros(CHANNELS, CHANNELS))
        self.filter = nn.Parameter(torch.zeros(CHANNELS, 2 * CHANNELS, taps))
        self.frozen: tuple[Tensor, Tensor, Tensor] | None = None

    def kernels(self) -> tuple[Tensor, Tensor, Tensor]:
        """``I + A`` ``(3, 3)``; ``g`` ``(taps, 3)``, newest last; one kernel ``(3, 6, taps)`` over ``[d, e]``."""
        if self.frozen is not None:
            return self.frozen
        lag = torch.arange(self.taps - 1.0, -1.0, -1.0, device=self.A.device)
        g = torch.sigmoid(self.log_odds)[:, None] ** lag
        g = g / g.sum(dim=-1, keepdim=True)
        direct = torch.eye(CHANNELS, device=self.A.device) + self.A
        W, V = torch.split(self.filter, CHANNELS, dim=1)
        carried = (direct - V.sum(dim=-1))[:, :, None] * g
        return direct, g.T.contiguous(), torch.cat([W, V + carried], dim=1)

    @torch.no_grad()
    def freeze(self) -> None:
        """Computes the kernels once and for all, for deployment."""
        self.frozen = self.kernels()

    def forward(self, increments: Tensor, physics: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Predictions from the last row of a window.

        Args:
            increments: measured ``d``, ``(B, H - 1, 3)``.
            physics: ``p`` from every row, ``(B, H, 3)``.

        Returns:
            ``q`` ``(B, 3)``, the last error ``e`` ``(B, 3)`` and its mean ``m`` ``(B, 3)``.
        """
        direct, g, kernel = self.kernels()
        errors = increments - physics[:, :-1]
        recent = torch.cat([increments, errors], dim=-1)[:, -self.taps :]
        remembered = functional.conv1d(recent.transpose(1, 2), kernel)[:, :, 0]
        q = physics[:, -1] @ direct.T + remembered
        return q, errors[:, -1], (errors[:, -self.taps :] * g).sum(dim=1)
