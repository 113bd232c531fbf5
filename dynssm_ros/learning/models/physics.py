"""The single-track equations as a layer: the one source of :mod:`dynssm_ros.vehicle` under torch."""

from __future__ import annotations

from typing import Any, Literal, cast

import torch
from pydantic import Field
from torch import Tensor, nn

from dynssm_ros.configuration import StrictModel
from dynssm_ros.signals.inputs import WINDOW_COLUMNS, applied_inputs
from dynssm_ros.vehicle import Applied, CarModel, Coefficients, State, Vehicle
from dynssm_ros.vehicle.effects import initial_effect_states
from dynssm_ros.vehicle.integrators import Integrator

INPUTS = len(WINDOW_COLUMNS)


class PhysicsConfig(StrictModel):
    """Analytical dynamics layer."""

    integrator: Integrator | None = Field(
        default=None,
        description="null: the vehicle file's, which a calibration chooses by the data; Euler if it has none",
    )
    substeps: int = Field(default=1, ge=1)
    nominal: Literal["vehicle", "mid_range", "calibrated"] = Field(
        default="vehicle",
        description="theta_0: the vehicle file's nominal values, the middle of the bounds, or the values that a calibration "
        "on the training data finds",
    )
    load_transfer: bool = Field(default=True, description="false: no load transfer, also if the vehicle file has it")

    def stepping(self, vehicle: Vehicle) -> tuple[Integrator, int]:
        """Integrator and substeps of the physics of ``vehicle``."""
        return self.integrator or vehicle.model_integrator, self.substeps

    def modelled(self, vehicle: Vehicle) -> Vehicle:
        """The car as this physics has it."""
        if self.load_transfer:
            return vehicle
        return vehicle.model_copy(update={"constants": vehicle.constants.model_copy(update={"load_transfer": False})})

    def theta_0(self, vehicle: Vehicle) -> Tensor:
        """The coefficients that adaptation starts from, ``(17,)``."""
        values = (vehicle.lower + vehicle.upper) / 2 if self.nominal == "mid_range" else vehicle.nominal
        return torch.tensor(values, dtype=torch.float32)


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
    """f_dyn, from window rows and coefficients to the state increment."""

    def __init__(self, vehicle: Vehicle, config: PhysicsConfig) -> None:
        super().__init__()
        self.vehicle = vehicle
        self.stepping = config.stepping(vehicle)
        self.car = CarModel.of(vehicle, *self.stepping, xp=_XP)

    def forward(self, latest: Tensor, theta: Tensor) -> Tensor:
        """Raw rows ``(..., 7)`` and coefficients, broadcastable to ``(..., 17)``, to increments ``(..., 3)``.

        States of effects are settled at these rows; :meth:`over` carries them.
        """
        # columns of shape (B, 1), which the deployed graph need not squeeze and stack again
        rows = torch.split(latest, 1, dim=-1)
        settled = initial_effect_states(self.car.effects, rows[3], rows[4])
        moved, _ = self.car.increment(State(*rows[:3]), applied_inputs(rows), _coefficients(theta), settled)
        return torch.cat(list(moved), dim=-1)

    def over(self, window: Tensor, theta: Tensor, latest: int) -> Tensor:
        """Increments ``(B, latest, ..., 3)`` from the latest rows of windows ``(B, H, ..., 7)``, in order of time.

        Args:
            window: raw rows. Where effects have states, these are carried from the first row on.
            theta: coefficients ``(17,)``, or ``(B, 1, ..., 17)`` with the same over the window.
            latest: rows wanted, at most H.
        """
        if not self.car.effect_states:
            return cast(Tensor, self(window[:, window.shape[1] - latest :], theta))
        rows = torch.split(window, 1, dim=-1)
        moved = self.car.over(State(*rows[:3]), applied_inputs(rows), Applied(*rows[3:5]), _coefficients(theta), latest)
        return torch.cat(list(moved), dim=-1)


def _coefficients(theta: Tensor) -> Coefficients:
    return Coefficients(*torch.split(theta, 1, dim=-1))
