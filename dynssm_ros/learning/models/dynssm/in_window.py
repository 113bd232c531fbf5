"""Coefficients that the window itself tells: a change of the car shows in the physics' own past errors.

A network learns what a change looks like only from data in which it happened, and many a car has never been driven with
a steering that is off, or on half of its grip. How errors depend on coefficients needs no learning: the physics says it.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from dynssm_ros.arrays import normal_equations
from dynssm_ros.learning.models.dynssm.config import EstimationConfig
from dynssm_ros.vehicle import COEFFICIENTS, Vehicle


class InWindowEstimation(nn.Module):
    """Maximum a posteriori estimate of a few coefficients over the last steps of the window.

    With the physics' errors ``e_k`` of the ``steps`` last steps, their slopes ``J_k`` by the coefficients, errors of
    standard deviation ``noise`` that are not the coefficients', and changes ``x`` that have standard deviation ``spread``
    before anything is seen, it minimises

        sum_k |e_k - J_k x|^2 / noise^2 + |x / spread|^2

    by Gauss and Newton, with secants over one ``spread`` as slopes: the first round about the nominal car, the others about
    the estimate before. Where the window says nothing of a coefficient, as on a straight, it stays nominal.
    """

    directions: Tensor
    lower: Tensor
    upper: Tensor

    def __init__(self, config: EstimationConfig, steps: int, vehicle: Vehicle) -> None:
        super().__init__()
        self.config = config
        self.steps = steps
        directions = torch.zeros(len(config.spread), len(COEFFICIENTS))
        for direction, (name, share) in zip(directions, config.spread.items(), strict=True):
            k = COEFFICIENTS.index(name)
            direction[k] = share * (vehicle.upper - vehicle.lower)[k]
        self.register_buffer("directions", directions)
        self.register_buffer("lower", torch.tensor(vehicle.lower, dtype=torch.float32))
        self.register_buffer("upper", torch.tensor(vehicle.upper, dtype=torch.float32))

    def forward(self, happened: Tensor, physics: Callable[[Tensor], Tensor], nominal: Tensor) -> Tensor:
        """All coefficients as the window tells them, within their bounds, ``(B, 17)``.

        Args:
            happened: measured increments of the last steps, ``(B, steps, 3)`` in units of ``s_delta``.
            physics: what cars with coefficients ``(B or 1, n, 17)`` do in the same steps: ``(B, steps, n, 3)``.
            nominal: coefficients of the nominal car ``(17,)``.
        """
        theta = nominal[None]
        unit = torch.eye(len(self.directions), device=nominal.device)
        x = happened.new_zeros(1, len(self.directions), 1)  # in units of spread
        for _ in range(self.config.rounds):
            cars = torch.cat([theta[:, None], theta[:, None] + self.directions], dim=1)
            moved = physics(cars).transpose(1, 2).flatten(2) / self.config.noise  # (B, 1 + K, 3 steps)
            now, slopes = moved[:, :1], moved[:, 1:] - moved[:, :1]
            errors = happened.flatten(1)[:, None] / self.config.noise - now
            J = slopes.transpose(1, 2)
            x = solved(*normal_equations(J, errors.transpose(1, 2) + J @ x, unit))
            theta = torch.clamp(nominal + x[:, :, 0] @ self.directions, self.lower, self.upper)
        return theta


def solved(A: Tensor, b: Tensor) -> Tensor:
    """``A^-1 b`` for small symmetric positive definite ``A`` ``(B, K, K)`` and ``b`` ``(B, K, n)``.

    By Gauss and Jordan, whose steps ONNX can express; such matrices need no pivoting.
    """
    K = A.shape[-1]
    unit = torch.eye(K, device=A.device)
    scale = torch.rsqrt((A * unit).sum(dim=-1, keepdim=True))  # to ones on the diagonal, next to which float32 is exact
    system = torch.cat([scale * A * scale.transpose(1, 2), scale * b], dim=-1)
    for k in range(K):
        row = system[:, k : k + 1] / system[:, k : k + 1, k : k + 1]
        system = system - (system[:, :, k : k + 1] - unit[:, k : k + 1]) * row
    return scale * system[:, :, K:]
