"""Beyond the paper: what the window tells of the present error of the physics, and of the error of a prediction.

On another track or with another set-up, speeds and forces leave the range of the training laps, and the physics errs in a new
way: a banked turn, an offset of the steering. Two things stay as they were. Increments have the same size, and an error
that the physics just made, it makes again. The modules here are built on them. All increments are in units of ``s_delta``.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from dynssm_ros.learning.models.dynssm.config import InnovationConfig, InWindowConfig
from dynssm_ros.runtime.artifact import Normalisation

CHANNELS = 3
_INCREMENT_LIMIT = 4.0  # in units of s_delta; beyond it the encoders learn nothing more from the size
_INPUT_CHANGE_SHARE = 0.1  # what an input changes in a step, as a share of its standard deviation
_LARGEST_FACTOR = 1.2
_WEIGHTS = 8  # shrinkage weights to choose from, each three times the one before
_NO_SHRINKAGE = 1e12  # a weight that no evidence moves
_VALIDATION_RMSE_TOLERANCE = 0.01  # relative; what shrinkage may cost on data like the training data
_COVERED, _QUANTILE = 0.9, 1.6448536  # the share of errors within this many standard deviations


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

    def forward(self, increments: Tensor, physics: Tensor, retrospective: int) -> tuple[Tensor, Tensor, Tensor]:
        """Predictions from the last row and, retrospectively, from the ``retrospective`` rows before it.

        Args:
            increments: measured ``d``, ``(B, H - 1, 3)``.
            physics: ``p`` from every row, ``(B, H, 3)``.
            retrospective: rows before the last one to predict from as well.

        Returns:
            ``q`` ``(B, retrospective + 1, 3)``, the last error ``e`` ``(B, 3)`` and its mean ``m`` ``(B, 3)``.
        """
        direct, g, kernel = self.kernels()
        errors = increments - physics[:, :-1]
        recent = torch.cat([increments, errors], dim=-1)[:, -(self.taps + retrospective) :]
        remembered = functional.conv1d(recent.transpose(1, 2), kernel).transpose(1, 2)
        q = physics[:, -(retrospective + 1) :] @ direct.T + remembered
        return q, errors[:, -1], (errors[:, -self.taps :] * g).sum(dim=1)


class InWindowErrors(nn.Module):
    """Judges a prediction by the one-step errors that the model would have made over the last steps of the window.

    *Shrinkage* scales each channel's increment by the regression of what happened on what was predicted, drawn towards one:
    an increment that could not be predicted lately shrinks towards "no change". *Limit*: the residual is limited to the
    size of the errors that it is to correct. *Variance*: a constant and a share of the recent squared errors. The
    shrinkage weight is fitted on validation data such that shrinkage costs at most 1 % there. The variance is fitted on
    data that the model knows as little as the next lap, so that 90 % intervals cover 90 % there.
    """

    weight: Tensor
    variance: Tensor

    def __init__(self, config: InWindowConfig, steps: int) -> None:
        super().__init__()
        self.config = config
        self.steps = steps
        # in squared increments of size s_delta, for each channel
        self.register_buffer("weight", torch.full((CHANNELS,), config.shrinkage_weight))
        # variance = constant + share * mean squared error of the in-window errors, for each channel
        self.register_buffer("variance", torch.stack([torch.ones(CHANNELS), torch.zeros(CHANNELS)]))

    def shrinkage(self, predicted: Tensor, happened: Tensor) -> Tensor:
        """Factor of the prediction ``(B, 3)`` from retrospective predictions and what happened, each ``(B, steps, 3)``."""
        return _regression(predicted, happened, self.weight)

    def limited(self, residual: Tensor, predicted: Tensor, happened: Tensor) -> Tensor:
        """``residual`` ``(B, 3)`` squeezed smoothly below the in-window errors, all in units of ``s_delta``."""
        if self.config.limit is None:
            return residual
        errors = torch.sqrt(_mean_square(predicted - happened) + torch.finfo(residual.dtype).tiny)
        return limited(residual, self.config.limit * errors)

    def no_shrinkage(self) -> None:
        """Leaves the predictions as they are."""
        self.weight.fill_(_NO_SHRINKAGE)

    def spread(self, predicted: Tensor, happened: Tensor) -> Tensor:
        """Variance of the prediction's error ``(B, 3)``, in units of ``s_delta`` squared."""
        spread: Tensor = self.variance[0] + self.variance[1] * _mean_square(predicted - happened)
        return spread

    @torch.no_grad()
    def fit_shrinkage(self, retrospective: Tensor, happened: Tensor, predicted: Tensor, target: Tensor) -> None:
        """Picks for each channel the least shrinkage weight that costs next to nothing on data like the training data.

        The lower the weight, the more of a wrong prediction elsewhere is taken back.

        Args:
            retrospective: predictions of the last steps, ``(N, steps, 3)``.
            happened: the measured increments that they are of.
            predicted: the predictions that shrinkage is to scale, ``(N, 3)``.
            target: the measured increments that they are of.
        """
        candidates = [self.config.shrinkage_weight * 3.0**power for power in range(_WEIGHTS)]
        errors = []
        for weight in candidates:
            factor = _regression(retrospective, happened, torch.full_like(self.weight, weight))
            errors.append((factor * predicted - target).square().mean(dim=0).sqrt())
        rmse = torch.stack(errors)
        affordable = rmse <= (1 + _VALIDATION_RMSE_TOLERANCE) * rmse.min(dim=0).values
        self.weight.copy_(torch.tensor(candidates)[affordable.int().argmax(dim=0)])

    @torch.no_grad()
    def fit_variance(self, past: Tensor, errors: Tensor) -> None:
        """Fits the variance: the most likely mixture of a constant and the recent errors, scaled to cover 90 %.

        Args:
            past: in-window errors ``(N, steps, 3)``.
            errors: of the predictions themselves, ``(N, 3)``.
        """
        square, recent = errors.square(), _mean_square(past)
        tiny = torch.finfo(square.dtype).tiny
        mean, of_recent = square.mean(dim=0).clamp(min=tiny), recent.mean(dim=0).clamp(min=tiny)
        shares = torch.linspace(0.0, 0.95, 20)
        variances = [mean * ((1 - share) + share * recent / of_recent) for share in shares]
        likelihoods = torch.stack([-(variance.log() + square / variance).mean(dim=0) for variance in variances])
        share = shares[likelihoods.argmax(dim=0)]
        mixture = torch.stack([mean * (1 - share), mean * share / of_recent])
        ratio = square / (mixture[0] + mixture[1] * recent)
        scale = torch.quantile(ratio, _COVERED, dim=0) / _QUANTILE**2
        self.variance.copy_(mixture * scale)


def _regression(predicted: Tensor, happened: Tensor, weight: Tensor) -> Tensor:
    """Slope of ``happened`` on ``predicted`` over ``(B, steps, 3)``, drawn towards one by ``weight`` ``(3,)``."""
    agreed = (predicted * happened).sum(dim=1) + weight
    full = (predicted * predicted).sum(dim=1) + weight
    return torch.clamp(agreed / full, 0.0, _LARGEST_FACTOR)


def _mean_square(errors: Tensor) -> Tensor:
    return torch.mean(errors * errors, dim=1)
