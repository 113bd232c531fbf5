"""DynSSM: physics with adapted coefficients and a gated residual, Section III of the paper."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor, nn
from typing_extensions import Self

from dynssm_ros.learning.losses import Output
from dynssm_ros.learning.models.base import TrainableModel, scale_buffers, steps_of
from dynssm_ros.learning.models.dynssm.config import DynssmConfig
from dynssm_ros.learning.models.dynssm.encoders import Fusion
from dynssm_ros.learning.models.dynssm.innovation import Increments, InnovationFilter, centred, limited
from dynssm_ros.learning.models.physics import INPUTS, PhysicsLayer
from dynssm_ros.runtime.artifact import Normalisation
from dynssm_ros.vehicle import COEFFICIENTS, Vehicle

_UNTRAINED = 1e-6  # weights of an output that is to have no say at first, and yet passes gradients on


class ParameterHead(nn.Module):
    """Bounded adaptation: theta = clip(theta_0 + alpha tanh(g(z, h)) range), Eq. (18)."""

    lower: Tensor
    upper: Tensor

    def __init__(self, config: DynssmConfig, vehicle: Vehicle, inputs: int) -> None:
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


class DynSSM(TrainableModel):
    """The whole model; components whose configuration is left out are absent (the paper's ablations).

    The paper's model sees normalised states and adds the residual to the physics. Beyond it, each a switch: the encoders
    see increments and the physics' past errors (``inputs``), and the physics carries its recent errors forward
    (``innovation``).
    """

    KIND = "dynssm"
    CONFIG = DynssmConfig
    nominal: Tensor

    def __init__(self, config: DynssmConfig, vehicle: Vehicle, normalisation: Normalisation) -> None:
        super().__init__(config, vehicle, normalisation)
        self.config = config
        T_s, latent = vehicle.sampling_time, config.fusion.latent
        config.check_rows(T_s)
        read = config.inputs.history
        self._read = 0 if read is None else steps_of(read, T_s)  # latest rows that the encoders see; 0: all
        scale_buffers(self, normalisation)
        self.changes = Increments(normalisation)
        width = Increments.FEATURES if config.inputs.features == "increments" else INPUTS
        width += 3 if config.inputs.physics_errors else 0
        self.fusion = Fusion(width, config.ssm, config.gru, config.fusion)
        self.physics = PhysicsLayer(vehicle, config.physics) if config.physics else None
        self.head = ParameterHead(config, vehicle, latent + width) if config.adaptation else None
        filtered = config.innovation
        self.innovation = InnovationFilter(filtered, steps_of(filtered.history, T_s)) if filtered else None
        conditioned = config.adaptation.hidden if config.adaptation else latent
        self.residual = None
        if config.residual:
            features = conditioned + width
            features += len(COEFFICIENTS) if self.head else 0
            features += 6 if self.physics else 0
            self.residual = GatedResidual(features, config.residual.hidden, config.residual.scale)
        if config.physics:
            self.register_buffer("nominal", config.physics.theta_0(vehicle))

    def forward(self, window: Tensor) -> Output:
        """Raw windows ``(B, H, 7)`` to predictions."""
        increments = self.changes.states(window)
        nominal = self._nominal_increments(window)
        seen = self._seen(window, increments, nominal)
        latest = seen[:, -1]
        conditioned = self.fusion(seen)
        theta = deviation = None
        if self.head is not None:
            theta, deviation, conditioned = self.head(conditioned, latest, self.nominal)
        elif self.physics is not None:
            theta = self.nominal.expand(window.shape[0], -1)  # not len(), which an export would freeze
        step = self._step(window, increments, nominal, theta)
        correction = None
        moved = step.expected
        if self.residual is not None:
            scaled, correction = self.residual(self._residual_input(conditioned, deviation, window, latest, step))
            added = self.increment_scale * scaled
            moved = added if moved is None else moved + added
        assert moved is not None
        return Output(moved, step.physics, theta, deviation, correction, nominal)

    def _nominal_increments(self, window: Tensor) -> Tensor | None:
        """What the physics with nominal coefficients says from every row, ``(B, H, 3)``; ``None`` if nothing reads it."""
        reads = self.config.inputs.physics_errors or (self.innovation is not None and self.head is None)
        return self.physics.over(window, self.nominal, window.shape[1]) if self.physics is not None and reads else None

    def _seen(self, window: Tensor, increments: Tensor, nominal: Tensor | None) -> Tensor:
        """What the encoders read, ``(B, rows, features)``."""
        changes = self.config.inputs.features == "increments"
        rows = self.changes(window, increments) if changes else (window - self.mean) / self.std
        if self.config.inputs.physics_errors:
            assert nominal is not None
            past = increments - nominal[:, :-1] / self.increment_scale
            rows = torch.cat([rows[:, -past.shape[1] :], limited(centred(past))], dim=-1)
        return rows[:, -self._read :]

    def _step(self, window: Tensor, increments: Tensor, nominal: Tensor | None, theta: Tensor | None) -> _Step:
        """The physics with the coefficients ``theta``, and with its innovation filter if it has one."""
        if self.physics is None or theta is None:
            return _Step()
        if self.innovation is None:
            physics = self.physics.over(window, theta[:, None], 1)[:, 0]
            return _Step(physics, physics)
        # the car as it is taken to be now, over the whole window: its errors are those of these coefficients
        over = nominal if self.head is None else self.physics.over(window, theta[:, None], window.shape[1])
        assert over is not None
        over = over / self.increment_scale
        q, error, mean = self.innovation(increments, over)
        physics = over[:, -1]
        features = torch.cat([physics + mean, error - mean], dim=-1)
        return _Step(physics * self.increment_scale, q * self.increment_scale, features)

    def _residual_input(
        self, conditioned: Tensor, deviation: Tensor | None, window: Tensor, latest: Tensor, step: _Step
    ) -> Tensor:
        """``q_t = [c_t, normalised deviation, h_t, physics state, physics increment]``, Eq. (27).

        With an innovation filter its bounded features stand in for the physics' state and increment.
        """
        assert self.config.residual is not None
        raw = self.config.residual.inputs == "raw"
        now = window[:, -1]
        parts = [conditioned, now if raw else latest]
        if deviation is not None:
            parts.append(deviation)
        if step.features is not None:
            parts.append(limited(step.features))
        elif step.physics is not None and raw:
            parts += [now[:, :3] + step.physics, step.physics]
        elif step.physics is not None:
            following = (now[:, :3] + step.physics - self.mean[:3]) / self.std[:3]
            parts += [following, step.physics / self.increment_scale]
        return torch.cat(parts, dim=-1)

    def for_deployment(self) -> Self:
        """Switches the state-space layers to their recurrence and freezes what does not change; returns itself."""
        if self.fusion.ssm is not None:
            self.fusion.ssm.for_deployment()
        if self.innovation is not None:
            self.innovation.freeze()
        return self.eval()


class _Step(NamedTuple):
    """What the physics says of the next step, for ``B`` windows."""

    physics: Tensor | None = None  # its increment (B, 3)
    expected: Tensor | None = None  # the same with its innovation filter, if it has one
    features: Tensor | None = None
    """Physics with its mean error, and the last error about that mean, ``(B, 6)`` in units of ``s_delta``."""
