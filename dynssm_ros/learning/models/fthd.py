"""Fine-Tuning Hybrid Dynamics (FTHD): a trained DDM is trained on with a physics loss that needs no measured next state.

After Fang and Yu, "Fine-Tuning Hybrid Physics-Informed Neural Networks for Vehicle Dynamics Model Estimation", 2024. The
network is the DDM's, its first layers are frozen, and the objective becomes ``w_1 L_1 + w_2 L_2``:

- ``L_1``, supervised: the mean squared error of the next state, as for the DDM.
- ``L_2``, unsupervised: the derivative of the predicted states, by finite differences, against the accelerations
  ``f`` that the single-track model gives for the predicted coefficients. With ``s^_{t+1}`` predicted from the window
  that ends at ``t`` with coefficients ``theta^_t``, and ``s^_t`` from the window one row earlier,

      L_2 = mean | (s^_{t+1} - s^_t) - T_s f(s^_t, u_t; theta^_t) |^2

The papers leave open, or it is not known to us, and so it was chosen here: the difference is taken between the predictions
of two windows that follow each other, because within a single Euler step it would be zero whatever the coefficients; it
is multiplied by ``T_s``, so that both losses have the units of a state, ``w_1`` is 1 and ``w_2`` has no unit; ``f`` is the
model file's integrator over one step; validation windows are those of the DDM, and what is kept is the epoch with the
lowest ``L_1`` on them, the DDM itself included. ``w_2``, the learning rate and the number of frozen layers are in the model
file.

Because the window holds the measured ``s_t``, the loss is nearly the error of the step before: to first order
``s^_{t+1} - s^_t - T_s f(s^_t) = s_t - s^_t``. So it weighs what the supervised loss weighs, and does not add much to it.

The variant EKF-FTHD, which filters the states by an extended Kalman filter with learned noise covariances before the
training, is not built.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dynssm_ros.learning.models.ddm import DDM
from dynssm_ros.learning.models.dynssm.network import Output


def freeze(model: DDM, count: int) -> None:
    """Keeps the first ``count`` layers as they are; see :attr:`DDM.layers`."""
    for layer in model.layers[:count]:
        layer.requires_grad_(False)


def physics_loss(model: DDM, windows: Tensor, output: Output, unit: Tensor) -> Tensor:
    """``L_2`` above.

    Args:
        model: the network that is fine-tuned.
        windows: raw, with the row before the model's window, ``(B, H + 1, 7)``.
        output: of the model for the last ``H`` rows.
        unit: in which the error of each state counts, ``(3,)``.
    """
    assert output.theta is not None
    state = windows[:, -2, :3] + model(windows[:, :-1]).increment
    following = windows[:, -1, :3] + output.increment
    advance = model.physics(torch.cat([state, windows[:, -1, 3:]], dim=-1), output.theta)
    error: Tensor = (following - state - advance) / unit
    return error.square().mean()
