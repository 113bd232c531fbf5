"""EKF-FTHD: an FTHD that filters the measured states with an extended Kalman filter whose covariances it learns.

After the extension of Fang and Yu's FTHD for noisy data: six further outputs of the network are the variances of process
noise Q and measurement noise R of the three states, bounded. The filter runs over the last rows of the window, on the
single-track model with the coefficients of that window, and the step into the future starts from the filtered state.

What is not known to us was chosen here: the filter sees the last rows alone, because its gain settles within a few; it is
linearised about the measured states, so that the physics of all rows is one call; the variances are squares of shares of
s_delta, the scale of a step's change; the coefficients' network is the DDM's of the first stage, and the noises' output
layer is new in the second one.
"""

from __future__ import annotations

from typing import ClassVar, Literal

import torch
from pydantic import Field
from torch import Tensor, nn

from benchmarks.rivals.fthd import FTHD, FthdConfig
from dynssm_ros.configuration import StrictModel
from dynssm_ros.learning.losses import Output
from dynssm_ros.learning.models.base import ModelConfig
from dynssm_ros.learning.models.physics import INPUTS
from dynssm_ros.runtime.artifact import Normalisation
from dynssm_ros.vehicle import Vehicle

_STATES = 3
_SECANT = 2.0  # half the width of central differences, in units of s_delta: far above what single precision rounds


class FilterConfig(StrictModel):
    """The extended Kalman filter."""

    rows: int = Field(default=6, ge=2, description="of the window that it sees, the last ones")
    noise: tuple[float, float] = Field(
        default=(0.01, 2.0),
        description="bounds of the standard deviations of process and measurement, in units of s_delta",
    )


class EkfFthdConfig(FthdConfig):
    """Model file of an EKF-FTHD."""

    kind: Literal["ekf_fthd"] = "ekf_fthd"
    filter: FilterConfig = Field(default_factory=FilterConfig)


class EkfFTHD(FTHD):
    """An FTHD on filtered states."""

    KIND = "ekf_fthd"
    NEW = ("noises.weight", "noises.bias", "increment_scale")
    CONFIG: ClassVar[type[ModelConfig]] = EkfFthdConfig
    nudges: Tensor

    def __init__(self, config: EkfFthdConfig, vehicle: Vehicle, normalisation: Normalisation) -> None:
        super().__init__(config, vehicle, normalisation)
        self.filter = config.filter
        self.noises = nn.Linear(config.dense.width, 2 * _STATES)
        self.register_buffer("increment_scale", torch.tensor(normalisation.increment_scale))
        nudges = torch.zeros(1 + 2 * _STATES, INPUTS)
        nudges[1 : 1 + _STATES, :_STATES] = torch.diag(_SECANT * self.increment_scale)
        nudges[1 + _STATES :] = -nudges[1 : 1 + _STATES]
        self.register_buffer("nudges", nudges, persistent=False)

    def forward(self, window: Tensor) -> Output:
        hidden = self.hidden(window)
        theta = self.coefficients(hidden)
        state = self.filtered(window, theta, *self.variances(hidden))
        latest = torch.cat([state, window[:, -1, _STATES:]], dim=-1)
        moved = self.physics.over(torch.cat([window[:, :-1], latest[:, None]], dim=1), theta[:, None], 1)[:, 0]
        increment = state - window[:, -1, :_STATES] + moved
        return Output(increment, increment, theta, None, None)

    def variances(self, hidden: Tensor) -> tuple[Tensor, Tensor]:
        """Q of a step and R, ``(B, 3)`` each, from the last hidden layer."""
        least, most = self.filter.noise
        std = (least + (most - least) * torch.sigmoid(self.noises(hidden))) * self.increment_scale.repeat(2)
        Q, R = torch.split(std.square(), _STATES, dim=-1)
        return Q, R

    def filtered(self, window: Tensor, theta: Tensor, Q: Tensor, R: Tensor) -> Tensor:
        """The state of the last row ``(B, 3)``: posterior mean of the filter."""
        rows = self.filter.rows
        nearby = self.physics.over(window[:, :, None] + self.nudges, theta[:, None, None], rows)
        moved, ahead, behind = torch.split(nearby, [1, _STATES, _STATES], dim=2)
        slope = (ahead - behind).transpose(-1, -2) / (2 * _SECANT * self.increment_scale)
        eye = torch.eye(_STATES)
        return kalman_filtered(window[:, -rows:, :_STATES], moved[:, :, 0], slope + eye, Q[:, None] * eye, R)


def kalman_filtered(measured: Tensor, moved: Tensor, F: Tensor, Q: Tensor, R: Tensor) -> Tensor:
    """Posterior mean of the last state of an extended Kalman filter that is linearised about what was measured.

    Args:
        measured: states ``(B, N, 3)``; the filter starts from the first, with its noise.
        moved: the model's increments from each of them, ``(B, N, 3)``.
        F: derivatives of the following state by the state, ``(B, N, 3, 3)``.
        Q: covariance of a step ``(B, 3, 3)``.
        R: variances of the measurement ``(B, 3)``; measurements are taken one after the other, which is the same.
    """
    state, P = measured[:, 0], R[:, None] * torch.eye(_STATES)
    for k in range(measured.shape[1] - 1):
        off = (F[:, k] @ (state - measured[:, k])[..., None])[..., 0]
        state = measured[:, k] + moved[:, k] + off
        P = F[:, k] @ P @ F[:, k].transpose(-1, -2) + Q
        for i in range(_STATES):
            gain = P[:, :, i] / (P[:, i, i] + R[:, i])[:, None]
            state = state + gain * (measured[:, k + 1, i] - state[:, i])[:, None]
            P = P - gain[:, :, None] * P[:, i, None, :]
    return state
