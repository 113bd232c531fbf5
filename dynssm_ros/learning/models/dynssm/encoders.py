"""The neural memory branch: state-space and recurrent encoders of the history window, and their fusion."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from dynssm_ros.learning.models.base import GruConfig
from dynssm_ros.learning.models.dynssm.config import FusionConfig, SsmConfig


class DiagonalSsm(nn.Module):
    """Diagonal linear state-space layer, discretised by zero-order hold.

    Per channel: ``x' = A x + u``, ``y = C x + D u`` with real ``A < 0`` of ``states`` entries, so that

        x_k = exp(dt A) x_{k-1} + (exp(dt A) - 1) / A u_k.

    The same map is evaluated as a convolution with its impulse response (parallel in time, for training) or as the
    recurrence itself (one multiply-add per step, for deployment).
    """

    def __init__(self, channels: int, states: int) -> None:
        super().__init__()
        self.channels = channels
        # time constants from two steps to many windows, as a real diagonal initialisation A_n = -(n + 1) spreads them
        self.log_dt = nn.Parameter(torch.empty(channels).uniform_(math.log(0.01), math.log(0.5)))
        self.log_a = nn.Parameter(torch.log(torch.arange(1, states + 1).float()).repeat(channels, 1))
        self.C = nn.Parameter(torch.randn(channels, states) / math.sqrt(states))
        self.D = nn.Parameter(torch.ones(channels))
        self.frozen: tuple[Tensor, Tensor] | None = None

    def discretised(self) -> tuple[Tensor, Tensor]:
        """``(dt A, B_bar)`` of shape ``(channels, states)``: exponent per step and zero-order-hold input gain."""
        a = -torch.exp(self.log_a)
        exponent = torch.exp(self.log_dt)[:, None] * a
        return exponent, torch.expm1(exponent) / a

    def step_coefficients(self) -> tuple[Tensor, Tensor]:
        """``(A_bar, C B_bar)`` of the recurrence, ``(states, channels)``; constants once :meth:`freeze` was called."""
        if self.frozen is not None:
            return self.frozen
        exponent, gain = self.discretised()
        return torch.exp(exponent).T.contiguous(), (self.C * gain).T.contiguous()

    @torch.no_grad()
    def freeze(self) -> None:
        """Computes the coefficients of the recurrence once and for all, for deployment."""
        self.frozen = self.step_coefficients()

    def convolution(self, u: Tensor) -> Tensor:
        """``(B, L, channels)`` to the same shape, by a causal convolution with the impulse response."""
        kernel, step = self.response(u.shape[1]), torch.arange(u.shape[1], device=u.device)
        # windows are short: the convolution is a product with the lower-triangular Toeplitz matrix of the response
        lag = step[:, None] - step
        toeplitz = kernel[:, lag.clamp(min=0)] * (lag >= 0)
        y: Tensor = torch.einsum("cts,bsc->btc", toeplitz, u) + self.D * u
        return y

    def convolved_last(self, u: Tensor) -> Tensor:
        """The last instant of :meth:`convolution`, ``(B, channels)``."""
        y: Tensor = (self.response(u.shape[1]).flip(1).T * u).sum(1) + self.D * u[:, -1]
        return y

    def response(self, length: int) -> Tensor:
        """Impulse response without the feedthrough ``D``, ``(channels, length)``."""
        exponent, b = self.discretised()
        decay, x = torch.exp(exponent), self.C * b
        over_states = torch.ones_like(x[:1]).T  # the sum as a product, as operations are counted
        steps = [x @ over_states]
        # step by step: powers of all lags at once do not fit into the cache and take six times as long
        for _ in range(length - 1):
            x = x * decay
            steps.append(x @ over_states)
        return torch.cat(steps, dim=1)

    def recurrence(self, u: Tensor) -> Tensor:
        """``(B, L, channels)`` to the same shape, step by step."""
        decay, gain = self.step_coefficients()
        x = torch.zeros_like(decay)
        outputs = []
        for now in torch.split(u, 1, dim=1):
            x = decay * x + now  # (B, states, channels), in units of B_bar: one operation less a step
            outputs.append((x * gain).sum(1, keepdim=True) + self.D * now)
        return torch.cat(outputs, dim=1)

    def recurred_last(self, u: Tensor) -> Tensor:
        """The last instant of :meth:`recurrence`, ``(B, channels)``.

        Steps of a linear recurrence are associative: merging neighbours into one step of twice the length, again and
        again, takes four rounds for a window of 15 instead of 15 steps.
        """
        decay, gain = self.step_coefficients()
        x = u[:, :, None, :]
        while x.shape[1] > 1:
            if x.shape[1] % 2:
                x = functional.pad(x, (0, 0, 0, 0, 1, 0))  # a step from rest, before the first
            x = decay * x[:, 0::2] + x[:, 1::2]
            decay = decay * decay
        y: Tensor = (x[:, 0] * gain).sum(1) + self.D * u[:, -1]
        return y


class SsmEncoder(nn.Module):
    """phi_SSM: projection, state-space layers with skip connections, the features of the last instant."""

    def __init__(self, inputs: int, config: SsmConfig) -> None:
        super().__init__()
        self.features = config.channels
        self.project = nn.Linear(inputs, config.channels)
        self.layers = nn.ModuleList(DiagonalSsm(config.channels, config.states) for _ in range(config.layers))
        self.recurrent = False

    def for_deployment(self) -> None:
        """Switches to the recurrence with constant coefficients."""
        self.recurrent = True
        for layer in self._ssm_layers():
            layer.freeze()

    def forward(self, window: Tensor) -> Tensor:
        """``(B, H, inputs)`` normalised to ``(B, channels)``."""
        u: Tensor = self.project(window)
        *earlier, last = self._ssm_layers()
        for layer in earlier:
            u = u + functional.silu(layer.recurrence(u) if self.recurrent else layer.convolution(u))
        return u[:, -1] + functional.silu(last.recurred_last(u) if self.recurrent else last.convolved_last(u))

    def _ssm_layers(self) -> list[DiagonalSsm]:
        return [layer for layer in self.layers if isinstance(layer, DiagonalSsm)]


class GruEncoder(nn.Module):
    """phi_GRU: the last hidden state of a gated recurrent unit."""

    def __init__(self, inputs: int, config: GruConfig) -> None:
        super().__init__()
        self.features = config.hidden
        self.gru = nn.GRU(inputs, config.hidden, config.layers, batch_first=True)

    def forward(self, window: Tensor) -> Tensor:
        """``(B, H, inputs)`` normalised to ``(B, hidden)``."""
        _, last = self.gru(window)
        return torch.as_tensor(last[-1])


class Fusion(nn.Module):
    """phi_fuse: both memories and the latest normalised input to the latent memory ``z_t``, Eq. (17)."""

    def __init__(self, inputs: int, ssm: SsmConfig | None, gru: GruConfig | None, config: FusionConfig) -> None:
        super().__init__()
        self.ssm = SsmEncoder(inputs, ssm) if ssm else None
        self.gru = GruEncoder(inputs, gru) if gru else None
        features = inputs + sum(encoder.features for encoder in (self.ssm, self.gru) if encoder is not None)
        self.mix = nn.Sequential(
            nn.Linear(features, config.hidden), nn.SiLU(), nn.Linear(config.hidden, config.latent), nn.SiLU()
        )

    def forward(self, window: Tensor) -> Tensor:
        """``(B, H, inputs)`` normalised to ``z_t`` of shape ``(B, latent)``."""
        parts = [encoder(window) for encoder in (self.ssm, self.gru) if encoder is not None]
        mixed: Tensor = self.mix(torch.cat([*parts, window[:, -1]], dim=-1))
        return mixed
