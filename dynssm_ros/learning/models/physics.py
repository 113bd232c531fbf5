"""The single-track equations as a layer: the one source of :mod:`dynssm_ros.vehicle` under torch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, cast

import torch
from pydantic import Field
from torch import Tensor, nn

from dynssm_ros.configuration import StrictModel
from dynssm_ros.signals.inputs import WINDOW_COLUMNS, applied_inputs
from dynssm_ros.vehicle import Applied, Coefficients, State, Vehicle
from dynssm_ros.vehicle.effects import initial_effect_states
from dynssm_ros.vehicle.effects.carried import carries, effect_states_along
from dynssm_ros.vehicle.single_track import Integrator, increment

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
        self.effects = vehicle.active_effects
        self.carries = carries(self.effects)

    def forward(self, latest: Tensor, theta: Tensor) -> Tensor:
        """Raw rows ``(..., 7)`` and coefficients, broadcastable to ``(..., 17)``, to increments ``(..., 3)``.

        States of effects are settled at these rows; :meth:`over` carries them.
        """
        # columns of shape (B, 1), which the deployed graph need not squeeze and stack again
        rows = torch.split(latest, 1, dim=-1)
        return self._from(rows, theta, initial_effect_states(self.effects, rows[3], rows[4]))

    def _from(self, rows: Sequence[Tensor], theta: Tensor, effect_states: Mapping[str, Tensor]) -> Tensor:
        """Increments from columns of rows, ``(..., 1)`` each, with the states that effects have there."""
        moved, _ = increment(
            _XP,
            State(*rows[:3]),
            effect_states,
            applied_inputs(rows),
            Coefficients(*torch.split(theta, 1, dim=-1)),
            self.vehicle.constants,
            self.vehicle.sampling_time,
            self.effects,
            *self.stepping,
        )
        return torch.cat(list(moved), dim=-1)

    def over(self, window: Tensor, theta: Tensor, latest: int) -> Tensor:
        """Increments ``(B, latest, ..., 3)`` from the latest rows of windows ``(B, H, ..., 7)``, in order of time.

        Args:
            window: raw rows. Where effects have states, these are carried from the first row on.
            theta: coefficients ``(17,)``, or ``(B, 1, ..., 17)`` with the same over the window.
            latest: rows wanted, at most H.
        """
        if not self.carries:
            return cast(Tensor, self(window[:, window.shape[1] - latest :], theta))
        wanted = torch.split(window[:, window.shape[1] - latest :], 1, dim=-1)
        rows = [torch.split(row, 1, dim=-1) for row in torch.unbind(window, dim=1)]
        each = theta if theta.dim() == 1 else theta[:, 0]
        carried = effect_states_along(
            _XP,
            [State(*row[:3]) for row in rows],
            [applied_inputs(row) for row in rows],
            Applied(*rows[0][3:5]),
            Coefficients(*torch.split(each, 1, dim=-1)),
            self.vehicle.constants,
            self.vehicle.sampling_time,
            self.effects,
            *self.stepping,
        )[-latest:]
        effect_states = {name: torch.stack([at[name] for at in carried], dim=1) for name in carried[0]}
        return self._from(wanted, theta, effect_states)
