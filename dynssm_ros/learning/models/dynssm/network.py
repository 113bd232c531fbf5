"""DynSSM: physics with adapted coefficients and a gated residual, Section III of the paper."""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from dynssm_ros.learning.configuration import ModelConfig, PhysicsConfig
from dynssm_ros.learning.models.dynssm.encoders import Fusion
from dynssm_ros.learning.models.dynssm.in_window import Identification
from dynssm_ros.learning.models.dynssm.innovation import ErrorMemory, Hindcast, Increments, centred, limited
from dynssm_ros.runtime.artifact import Normalisation
from dynssm_ros.signals.inputs import WINDOW_COLUMNS, applied_inputs
from dynssm_ros.vehicle import COEFFICIENTS, Coefficients, State, Vehicle
from dynssm_ros.vehicle.effects import initial_memory
from dynssm_ros.vehicle.single_track import increment

INPUTS = len(WINDOW_COLUMNS)
_UNTRAINED = 1e-6  # weights of an output that is to have no say at first, and yet passes gradients on


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
    variance: Tensor | None = None
    """Stated variance of the prediction's error, ``(B, 3)``; ``None``: constant."""


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

    def __init__(self, config: ModelConfig, vehicle: Vehicle, inputs: int) -> None:
        super().__init__()
        assert config.adaptation is not None
        self.alpha = config.adaptation.alpha
        self.condition = nn.Sequential(nn.Linear(inputs, config.adaptation.hidden), nn.SiLU())
        self.deviate = nn.Linear(config.adaptation.hidden, len(COEFFICIENTS))
        nn.init.normal_(self.deviate.weight, std=_UNTRAINED)  # training starts from the nominal car
        nn.init.zeros_(self.deviate.bias)
        self.register_buffer("lower", torch.tensor(vehicle.lower, dtype=torch.float32))
        self.register_buffer("upper", torch.tensor(vehicle.upper, dtype=torch.float32))

    def forward(self, latent: Tensor, latest: Tensor, nominal: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """``z_t``, the latest encoder input and theta_0 to ``(theta, normalised deviation, c_t)``."""
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
        nn.init.normal_(last.weight, std=_UNTRAINED)  # training starts from the physics alone
        nn.init.zeros_(last.bias)

    def forward(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """``q_t`` to the correction in units of ``s_delta`` and the network's output, each ``(B, 3)``."""
        r: Tensor = self.network(q)
        return self.scale * torch.sigmoid(self.gate(q)) * r, r


class DynSSM(nn.Module):
    """The whole model; components whose configuration is left out are absent (the paper's ablations).

    The paper's model sees normalised states and adds the residual to the physics. Beyond it, each a switch: the encoders
    see increments and the physics' past errors (``inputs``), the physics carries its recent errors forward (``memory``),
    and predictions in hindsight scale the prediction and state its variance (``hindcast``).
    """

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
        self.changes = Increments(normalisation)
        width = Increments.FEATURES if config.inputs.features == "increments" else INPUTS
        width += 3 if config.inputs.physics_errors else 0
        self.fusion = Fusion(width, config.ssm, config.gru, config.fusion)
        self.physics = PhysicsLayer(vehicle, config.physics) if config.physics else None
        self.head = ParameterHead(config, vehicle, latent + width) if config.adaptation else None
        self.identification = Identification(config.identification, vehicle) if config.identification else None
        self.memory = ErrorMemory(config.memory) if config.memory else None
        self.hindcast = Hindcast(config.hindcast) if config.hindcast else None
        conditioned = config.adaptation.hidden if config.adaptation else latent
        self.residual = None
        if config.residual:
            features = conditioned + width
            features += len(COEFFICIENTS) if self.head else 0
            features += 6 if self.physics else 0
            self.residual = GatedResidual(features, config.residual.hidden, config.residual.scale)
        if config.physics:
            self.register_buffer("nominal", nominal_parameters(config.physics, vehicle))

    def forward(self, window: Tensor) -> Output:
        """Raw windows ``(B, H, 7)`` to predictions."""
        increments = self.changes.states(window)
        seen = self._seen(window, increments)
        latest = seen[:, -1]
        conditioned = self.fusion(seen)
        theta = deviation = None
        if self.head is not None:
            theta, deviation, conditioned = self.head(conditioned, latest, self._nominal(window, increments))
        elif self.physics is not None:
            theta = self.nominal.expand(window.shape[0], -1)  # not len(), which an export would freeze
        step = self._step(window, increments, theta)
        # the network must not learn to lean on hindsight, so training does without
        judge, hindsight = None if self.training else self.hindcast, step.hindsight
        correction = None
        moved = step.expected
        if self.residual is not None:
            scaled, correction = self.residual(self._residual_input(conditioned, deviation, window, latest, step))
            if judge is not None and hindsight is not None:
                scaled = judge.limited(scaled, *hindsight)
            added = self.increment_scale * scaled
            moved = added if moved is None else moved + added
        assert moved is not None
        variance = None
        if self.hindcast is not None and hindsight is not None:
            if judge is not None and judge.config.trust:
                moved = moved * judge.trust(*hindsight)
            if self.hindcast.config.uncertainty:
                variance = self.hindcast.spread(*hindsight) * self.increment_scale.square()
        return Output(moved, step.physics, theta, deviation, correction, variance)

    def _nominal(self, window: Tensor, increments: Tensor) -> Tensor:
        """theta_0, which adaptation starts from: ``(17,)``, or as the window tells it ``(B, 17)``."""
        if self.identification is None:
            return self.nominal
        physics = self.physics
        assert physics is not None
        steps = self.identification.config.steps
        rows = window[:, -steps - 1 : -1, None]
        theta: Tensor = self.identification(
            increments[:, -steps:], lambda cars: physics(rows, cars[:, None]) / self.increment_scale, self.nominal
        )
        return theta

    def _seen(self, window: Tensor, increments: Tensor) -> Tensor:
        """What the encoders read, ``(B, rows, features)``."""
        changes, errors = self.config.inputs.features == "increments", self.config.inputs.physics_errors
        rows = self.changes(window, increments) if changes else (window - self.mean) / self.std
        if errors:
            assert self.physics is not None
            past = increments - self.physics(window[:, :-1], self.nominal) / self.increment_scale
            rows = torch.cat([rows[:, -past.shape[1] :], limited(centred(past))], dim=-1)
        return rows if self.config.inputs.rows is None else rows[:, -self.config.inputs.rows :]

    def _step(self, window: Tensor, increments: Tensor, theta: Tensor | None) -> _Step:
        """The physics with the coefficients ``theta``, and with its memory if it has one."""
        if self.physics is None or theta is None:
            return _Step()
        if self.memory is None:
            physics = self.physics(window[:, -1], theta)
            return _Step(physics, physics)
        # the car as it is taken to be now, over the whole window: its errors are those of these coefficients
        over = self.physics(window, theta[:, None]) / self.increment_scale
        steps = self.hindcast.config.steps if self.hindcast is not None else 0
        q, error, mean = self.memory(increments, over, steps)
        physics = over[:, -1]
        return _Step(
            physics * self.increment_scale,
            q[:, -1] * self.increment_scale,
            (q[:, :-1], increments[:, -steps:]) if steps else None,
            torch.cat([physics + mean, error - mean], dim=-1),
        )

    def _residual_input(
        self, conditioned: Tensor, deviation: Tensor | None, window: Tensor, latest: Tensor, step: _Step
    ) -> Tensor:
        """``q_t = [c_t, normalised deviation, h_t, physics state, physics increment]``, Eq. (27).

        With a memory its bounded outlook stands in for the physics' state and increment.
        """
        assert self.config.residual is not None
        raw = self.config.residual.inputs == "raw"
        now = window[:, -1]
        parts = [conditioned, now if raw else latest]
        if deviation is not None:
            parts.append(deviation)
        if step.outlook is not None:
            parts.append(limited(step.outlook))
        elif step.physics is not None and raw:
            parts += [now[:, :3] + step.physics, step.physics]
        elif step.physics is not None:
            following = (now[:, :3] + step.physics - self.mean[:3]) / self.std[:3]
            parts += [following, step.physics / self.increment_scale]
        return torch.cat(parts, dim=-1)

    @torch.no_grad()
    def fit_trust(self, window: Tensor, target: Tensor) -> None:
        """Fits trust to validation windows ``(N, H, 7)`` and their measured increments ``(N, 3)``."""
        assert self.hindcast is not None
        hindcasts, happened = self._hindsight(window)
        self.hindcast.trust_fully()
        freely = self.eval()(window).increment / self.increment_scale
        self.hindcast.fit_trust(hindcasts, happened, freely, target / self.increment_scale)

    @torch.no_grad()
    def errors(self, window: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        """Errors in hindsight ``(N, steps, 3)`` and of the predictions ``(N, 3)`` on windows and measured increments."""
        hindcasts, happened = self._hindsight(window)
        return (hindcasts - happened) * self.increment_scale, self.eval()(window).increment - target

    @torch.no_grad()
    def fit_variance(self, past: Tensor, errors: Tensor) -> None:
        """Fits the stated variance to what :meth:`errors` gives."""
        assert self.hindcast is not None
        self.hindcast.fit_variance(past / self.increment_scale, errors / self.increment_scale)

    def _hindsight(self, window: Tensor) -> tuple[Tensor, Tensor]:
        """Predictions of the last steps of windows and what happened, each ``(N, steps, 3)`` in units of ``s_delta``."""
        increments = self.changes.states(window)
        hindsight = self._step(window, increments, self.eval()(window).theta).hindsight
        assert hindsight is not None
        return hindsight

    def for_deployment(self) -> DynSSM:
        """Switches the state-space layers to their recurrence and freezes what does not change; returns itself."""
        if self.fusion.ssm is not None:
            self.fusion.ssm.for_deployment()
        if self.memory is not None:
            self.memory.freeze()
        return self.eval()


class _Step(NamedTuple):
    """What the physics says of the next step, for ``B`` windows."""

    physics: Tensor | None = None
    """Its increment ``(B, 3)``."""
    expected: Tensor | None = None
    """The same with its memory, if it has one."""
    hindsight: tuple[Tensor, Tensor] | None = None
    """The last steps as predicted in hindsight and as they happened, each ``(B, steps, 3)`` in units of ``s_delta``."""
    outlook: Tensor | None = None
    """Physics with its mean error, and the last error about that mean, ``(B, 6)`` in units of ``s_delta``."""


def nominal_parameters(config: PhysicsConfig, vehicle: Vehicle) -> Tensor:
    """theta_0 after the configuration: the middle of the bounds or the vehicle's (calibrated) nominal values, ``(17,)``."""
    values = (vehicle.lower + vehicle.upper) / 2 if config.nominal == "mid_range" else vehicle.nominal
    return torch.tensor(values, dtype=torch.float32)
