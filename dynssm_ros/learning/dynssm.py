"""DynSSM: physics with adapted coefficients and a gated residual, Section III of the paper."""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from dynssm_ros.learning.configuration import ModelConfig, PhysicsConfig
from dynssm_ros.learning.encoders import Fusion
from dynssm_ros.runtime.artifact import Normalisation
from dynssm_ros.signals.inputs import WINDOW_COLUMNS, applied_inputs
from dynssm_ros.vehicle import COEFFICIENTS, Coefficients, State, Vehicle
from dynssm_ros.vehicle.effects import initial_memory
from dynssm_ros.vehicle.single_track import increment

INPUTS = len(WINDOW_COLUMNS)
_LARGEST_ERROR = 8.0  # in units of s_delta; beyond it an encoder learns nothing more from the size


class Output(NamedTuple):
    """What a model computes for ``B`` windows; all increments are ``s_{t+1} - s_t``."""

    increment: Tensor
    """Final prediction, Eq. (30), as an increment ``(B, 3)``."""
    physics: Tensor | None
    """The physics' increment, Eq. (26), ``(B, 3)``."""
    theta: Tensor | None
    """Adapted coefficients, Eq. (18), ``(B, 17)``."""
    deviation: Tensor | None
    """Normalised parameter deviation, Eq. (20), ``(B, 17)``."""
    correction: Tensor | None
    """Normalised output of the residual network, Eq. (28), ``(B, 3)``."""


class _Torch:
    """torch as an array namespace, with an arctan2 that ONNX can express."""

    def __getattr__(self, name: str) -> Any:
        return getattr(torch, name)

    @staticmethod
    def arctan2(y: Tensor, x: Tensor) -> Tensor:
        """As torch's. Exported it is for ``x >= 0``, cheap and defined at standstill; the exporter's own divides 0 by 0."""
        if torch.onnx.is_in_onnx_export():
            return torch.arctan(y / x.clamp(min=torch.finfo(x.dtype).tiny))
        return torch.arctan2(y, x)


_XP = _Torch()


class PhysicsLayer(nn.Module):
    """f_dyn: the one single-track source under torch, from window rows and coefficients to the state increment."""

    def __init__(self, vehicle: Vehicle, config: PhysicsConfig) -> None:
        super().__init__()
        self.vehicle = vehicle
        self.config = config
        self.effects = vehicle.active_effects

    def forward(self, latest: Tensor, theta: Tensor) -> Tensor:
        """Raw rows ``(..., 7)`` and coefficients, broadcastable to ``(..., 17)``, to increments ``(..., 3)``."""
        # columns of shape (B, 1), which the deployed graph need not squeeze and stack again
        rows = torch.split(latest, 1, dim=-1)
        moved, _ = increment(
            _XP,
            State(*rows[:3]),
            initial_memory(self.effects, rows[3], rows[4]),
            applied_inputs(rows),
            Coefficients(*torch.split(theta, 1, dim=-1)),
            self.vehicle.constants,
            self.vehicle.sampling_time,
            self.effects,
            self.config.integrator,
            self.config.substeps,
        )
        return torch.cat(list(moved), dim=-1)


class ParameterHead(nn.Module):
    """Bounded adaptation: theta = clip(theta_0 + alpha tanh(g(z, h)) range), Eq. (18)."""

    lower: Tensor
    upper: Tensor

    def __init__(self, config: ModelConfig, vehicle: Vehicle, latent: int) -> None:
        super().__init__()
        assert config.adaptation is not None
        self.alpha = config.adaptation.alpha
        self.condition = nn.Sequential(nn.Linear(latent + INPUTS, config.adaptation.hidden), nn.SiLU())
        self.deviate = nn.Linear(config.adaptation.hidden, len(COEFFICIENTS))
        nn.init.normal_(self.deviate.weight, std=1e-3)  # training starts from the nominal car
        nn.init.zeros_(self.deviate.bias)
        self.register_buffer("lower", torch.tensor(vehicle.lower, dtype=torch.float32))
        self.register_buffer("upper", torch.tensor(vehicle.upper, dtype=torch.float32))

    def forward(self, latent: Tensor, latest: Tensor, nominal: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """``z_t``, the latest normalised input and theta_0 to ``(theta, normalised deviation, c_t)``."""
        conditioned = self.condition(torch.cat([latent, latest], dim=-1))
        admissible = self.upper - self.lower
        shift = torch.tanh(self.deviate(conditioned)) * (self.alpha * admissible)
        theta = torch.clamp(nominal + shift, self.lower, self.upper)
        return theta, (theta - nominal) / admissible, conditioned


class GatedResidual(nn.Module):
    """lambda_r s_delta * sigmoid(gate(q)) * r(q), Eq. (28) and (29)."""

    def __init__(self, features: int, hidden: tuple[int, ...], scale: float) -> None:
        super().__init__()
        self.scale = scale
        sizes = (features, *hidden)
        layers = [module for a, b in pairwise(sizes) for module in (nn.Linear(a, b), nn.SiLU())]
        self.network = nn.Sequential(*layers, nn.Linear(hidden[-1], 3))
        self.gate = nn.Linear(features, 3)
        last = self.network[-1]
        assert isinstance(last, nn.Linear)
        nn.init.normal_(last.weight, std=1e-3)  # training starts from the physics alone
        nn.init.zeros_(last.bias)

    def forward(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """``q_t`` to the correction in units of ``s_delta`` and the network's output, each ``(B, 3)``."""
        r: Tensor = self.network(q)
        return self.scale * torch.sigmoid(self.gate(q)) * r, r


class DynSSM(nn.Module):
    """The whole model; components whose configuration is left out are absent (the paper's ablations)."""

    mean: Tensor
    std: Tensor
    increment_scale: Tensor
    nominal: Tensor

    def __init__(self, config: ModelConfig, vehicle: Vehicle, normalisation: Normalisation) -> None:
        super().__init__()
        assert config.fusion is not None
        self.config = config
        latent = config.fusion.latent
        self.register_buffer("mean", torch.tensor(normalisation.input_mean))
        self.register_buffer("std", torch.tensor(normalisation.input_std))
        self.register_buffer("increment_scale", torch.tensor(normalisation.increment_scale))
        self.fusion = Fusion(INPUTS + (3 if config.physics_errors else 0), config.ssm, config.gru, config.fusion)
        self.physics = PhysicsLayer(vehicle, config.physics) if config.physics else None
        self.head = ParameterHead(config, vehicle, latent) if config.adaptation else None
        conditioned = config.adaptation.hidden if config.adaptation else latent
        self.residual = None
        if config.residual:
            features = conditioned + INPUTS
            features += len(COEFFICIENTS) if self.head else 0
            features += 6 if self.physics else 0
            self.residual = GatedResidual(features, config.residual.hidden, config.residual.scale)
        if config.physics:
            self.register_buffer("nominal", nominal_parameters(config.physics, vehicle))

    def forward(self, window: Tensor) -> Output:
        """Raw windows ``(B, H, 7)`` to predictions."""
        normalised = (window - self.mean) / self.std
        latest = normalised[:, -1]
        raw = window[:, -1]
        seen = torch.cat([normalised, self._past_errors(window)], dim=-1) if self.config.physics_errors else normalised
        conditioned = self.fusion(seen)
        theta = deviation = increment = None
        if self.head is not None:
            theta, deviation, conditioned = self.head(conditioned, latest, self.nominal)
        elif self.physics is not None:
            theta = self.nominal.expand(window.shape[0], -1)  # not len(), which an export would freeze
        if self.physics is not None:
            increment = self.physics(raw, theta)
        if self.residual is None:
            assert increment is not None
            return Output(increment, increment, theta, deviation, None)
        q = self._residual_input(conditioned, deviation, raw, latest, increment)
        scaled, correction = self.residual(q)
        added = self.increment_scale * scaled
        return Output(added if increment is None else increment + added, increment, theta, deviation, correction)

    def _past_errors(self, window: Tensor) -> Tensor:
        """One-step errors of the nominal physics over the window in units of ``s_delta``, ``(B, H, 3)``.

        Row ``k`` holds the error of the step that led to it; the first row, whose step is not in the window, is zero.
        """
        assert self.physics is not None
        before, after = window[:, :-1], window[:, 1:, :3]
        errors = (after - before[..., :3] - self.physics(before, self.nominal)) / self.increment_scale
        bounded = errors.clamp(-_LARGEST_ERROR, _LARGEST_ERROR)
        return torch.cat([torch.zeros_like(bounded[:, :1]), bounded], dim=1)

    def _residual_input(
        self, conditioned: Tensor, deviation: Tensor | None, raw: Tensor, latest: Tensor, increment: Tensor | None
    ) -> Tensor:
        """``q_t = [c_t, normalised deviation, h_t, physics state, physics increment]``, Eq. (27)."""
        assert self.config.residual is not None
        standardised = self.config.residual.inputs == "normalised"
        parts = [conditioned, latest if standardised else raw]
        if deviation is not None:
            parts.append(deviation)
        if increment is not None:
            if standardised:
                parts += [latest[:, :3] + increment / self.std[:3], increment / self.increment_scale]
            else:
                parts += [raw[:, :3] + increment, increment]
        return torch.cat(parts, dim=-1)

    def for_deployment(self) -> DynSSM:
        """Switches the state-space layers to their recurrence; returns itself."""
        if self.fusion.ssm is not None:
            self.fusion.ssm.for_deployment()
        return self.eval()


def nominal_parameters(config: PhysicsConfig, vehicle: Vehicle) -> Tensor:
    """theta_0 after the configuration: the vehicle's nominal values or the middle of the bounds, ``(17,)``."""
    values = vehicle.nominal if config.nominal == "vehicle" else (vehicle.lower + vehicle.upper) / 2
    return torch.tensor(values, dtype=torch.float32)
