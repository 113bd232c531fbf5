"""Fine-Tuning Hybrid Dynamics (FTHD): a trained DDM is trained on with a physics loss that needs no measured next state.

After Fang and Yu, "Fine-Tuning Hybrid Physics-Informed Neural Networks for Vehicle Dynamics Model Estimation", 2024. The
network is the DDM's, the first three quarters of its layers are frozen, and it is trained on for as many epochs with the
same learning rate. The objective becomes ``w_1 L_1 + w_2 L_2``, published with w_1 = 0.999975 and w_2 = 0.000025:

- ``L_1``, supervised: the mean squared error of the next state, as for the DDM.
- ``L_2``, unsupervised: the derivative of the predicted states, by finite differences, against the accelerations
  ``f`` that the single-track model gives for the predicted coefficients. With ``s^_{t+1}`` predicted from the window
  that ends at ``t`` with coefficients ``theta^_t``, and ``s^_t`` from the window one row earlier,

      L_2 = mean | (s^_{t+1} - s^_t) / T_s - f(s^_t, u_t; theta^_t) |^2

The papers leave open, or it is not known to us, and so it was chosen here: the difference is taken between the predictions
of two windows that follow each other, because within a single Euler step it would be zero whatever the coefficients; ``f``
is the model file's integrator over one step; validation windows are those of the DDM, and what is kept is the epoch with the
lowest ``L_1`` on them, the DDM itself included. ``w_1`` is 1 here and ``w_2`` in the model file.

Because the window holds the measured ``s_t``, the loss is nearly the error of the step before: to first order
``s^_{t+1} - s^_t - T_s f(s^_t) = s_t - s^_t``. So it weighs what the supervised loss weighs, and does not add much to it.

The variant that filters the states is :mod:`benchmarks.rivals.ekf_fthd`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar, Literal

import torch
from pydantic import Field, ValidationInfo, field_validator, model_validator
from torch import Tensor
from typing_extensions import Self

from benchmarks.rivals.ddm import DDM, DdmConfig
from dynssm_ros.configuration import StrictModel
from dynssm_ros.learning.losses import LossConfig, Output, Scales, objective
from dynssm_ros.learning.models.base import ModelConfig, TrainableModel
from dynssm_ros.learning.models.registry import fields_of, referred
from dynssm_ros.runtime.artifact import Normalisation
from dynssm_ros.vehicle import Vehicle

# what fine-tuning takes over: the network, and the split, without which it would validate on windows of the first stage
_NETWORK = ("history", "gru", "dense", "physics")
_SPLIT = ("seed", "validation", "validation_block", "validation_every")


class FineTuningConfig(StrictModel):
    """Second stage of FTHD: a trained DDM is trained on."""

    starts_from: DdmConfig = Field(description="the DDM; in a file the name of its model file")
    frozen: float = Field(
        default=0.75, ge=0, lt=1, description="share of the layers that stay as the DDM has them; the GRU is the first"
    )
    physics: float = Field(ge=0, description="weight of the unsupervised physics loss; the supervised loss has 1")

    @field_validator("starts_from", mode="before")
    @classmethod
    def _by_name(cls, value: Any, info: ValidationInfo) -> Any:
        """The fields of the model file, if its name is given."""
        source = Path((info.context or {}).get("source", ""))
        return fields_of(referred(source, value)) if isinstance(value, str) else value


class FthdConfig(DdmConfig):
    """Model file of an FTHD."""

    kind: Literal["fthd", "ekf_fthd"] = "fthd"
    fine_tuning: FineTuningConfig

    @model_validator(mode="after")
    def _fits_its_start(self) -> FthdConfig:
        start = self.fine_tuning.starts_from
        if start.kind != "ddm":
            raise ValueError(f"fine_tuning.starts_from: {start.name} is of kind {start.kind}; expected ddm")
        for ours, its, names in ((self, start, _NETWORK), (self.training, start.training, _SPLIT)):
            for name in names:
                if getattr(ours, name) != getattr(its, name):
                    raise ValueError(f"{name}: differs from that of {start.name}, which fine_tuning starts from")
        return self

    @property
    def start(self) -> DdmConfig:
        return self.fine_tuning.starts_from

    def with_training(self, **changes: Any) -> Self:
        """The same model with other training settings, which hold for the DDM that it starts from too."""
        fine_tuning = self.fine_tuning.model_copy(update={"starts_from": self.start.with_training(**changes)})
        return super().with_training(**changes).model_copy(update={"fine_tuning": fine_tuning})


class FTHD(DDM):
    """The DDM's network in its second stage.

    Attributes:
        NEW: names of parameters and buffers that the DDM does not have.
    """

    KIND = "fthd"
    NEW: ClassVar[tuple[str, ...]] = ()
    CONFIG: ClassVar[type[ModelConfig]] = FthdConfig
    EXTRA_ROWS = 1  # the predictions of neighbouring windows are compared

    def __init__(self, config: FthdConfig, vehicle: Vehicle, normalisation: Normalisation) -> None:
        super().__init__(config, vehicle, normalisation)
        self.fine_tuning = config.fine_tuning

    def take_over(self, start: TrainableModel) -> None:
        """Takes the weights of the trained DDM and freezes its first layers; what is :attr:`NEW` stays."""
        own = self.state_dict()
        self.load_state_dict({name: own[name] for name in self.NEW} | start.state_dict())
        for layer in self.layers[: int(self.fine_tuning.frozen * len(self.layers))]:
            layer.requires_grad_(False)

    def terms(self, window: Tensor, target: Tensor, loss: LossConfig, scales: Scales) -> dict[str, Tensor]:
        before, output = consecutive(self, window)
        disagreement = physics_loss(self, window, before, output, scales[0])
        return objective(output, target, loss, scales) | {"physics": self.fine_tuning.physics * disagreement}


def consecutive(model: DDM, windows: Tensor) -> tuple[Output, Output]:
    """Predictions for the windows one row earlier and for those of the last rows, from rows ``(B, H + 1, 7)``.

    All go through the network at once, which costs little more than the half.
    """
    both = model(torch.cat([windows[:, :-1], windows[:, 1:]]))
    before, after = zip(*(part.chunk(2) if part is not None else (None, None) for part in both), strict=True)
    return Output(*before), Output(*after)


def physics_loss(model: DDM, windows: Tensor, before: Output, output: Output, unit: Tensor) -> Tensor:
    """``L_2`` above, in units ``unit`` of each state, ``(3,)``, from the outputs for the first (``before``) and the
    last ``H`` rows of raw windows ``(B, H + 1, 7)``.
    """
    assert output.theta is not None
    state = windows[:, -2, :3] + before.increment
    following = windows[:, -1, :3] + output.increment
    advance = model.physics(torch.cat([state, windows[:, -1, 3:]], dim=-1), output.theta)
    error: Tensor = (following - state - advance) / model.physics.vehicle.sampling_time / unit
    return error.square().mean()
