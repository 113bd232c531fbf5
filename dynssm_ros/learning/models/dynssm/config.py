"""Model file of a DynSSM: every size and every switch. Leaving out an optional block removes that component."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from dynssm_ros.configuration import StrictModel
from dynssm_ros.errors import ConfigurationError
from dynssm_ros.learning.losses import LossConfig
from dynssm_ros.learning.models.base import GruConfig, ModelConfig, TrainingConfig, steps_of
from dynssm_ros.learning.models.physics import PhysicsConfig


class SsmConfig(StrictModel):
    """State-space encoder: long memory, the operating context."""

    channels: int = Field(ge=1, description="width of the encoder")
    states: int = Field(ge=1, description="diagonal states per channel")
    layers: int = Field(default=1, ge=1)


class FusionConfig(StrictModel):
    """Feature fusion: both encoders and the latest normalised input to the latent memory z_t."""

    hidden: int = Field(ge=1)
    latent: int = Field(ge=1, description="size of z_t")


class AdaptationConfig(StrictModel):
    """Bounded parameter head."""

    hidden: int = Field(ge=1, description="size of the physics-conditioned feature c_t")
    alpha: float = Field(gt=0, le=1, description="alpha_theta, largest deviation as a fraction of the admissible range")


class ResidualConfig(StrictModel):
    """Gated residual correction on q_t."""

    hidden: tuple[int, ...] = Field(min_length=1)
    scale: float = Field(
        gt=0, description="lambda_r, largest correction in units of s_delta times the network's output"
    )
    inputs: Literal["raw", "normalised"] = Field(
        default="normalised", description="h_t and the physics' states in q_t raw as in the paper, or standardised"
    )


class InputsConfig(StrictModel):
    """What the encoders see of the window."""

    features: Literal["states", "increments"] = Field(
        default="states",
        description="normalised rows as in the paper; or, beyond the paper, their changes, which mean the same on any track",
    )
    history: float | None = Field(default=None, gt=0, description="latest part that the encoders read (s); null: all")
    physics_errors: bool = Field(
        default=False,
        description="beyond the paper: also the physics' own one-step errors over the window, which are known at run time "
        "and carry what another track or set-up changes",
    )


class InnovationConfig(StrictModel):
    """Beyond the paper: the physics' recent one-step errors are carried forward by an innovation filter."""

    history: float = Field(gt=0, description="how far the filter reaches back (s)")
    decay: float = Field(
        default=0.9, gt=0, lt=1, description="first value of the learned weight of a step over the next"
    )


class DynssmConfig(ModelConfig):
    """A DynSSM as it is trained. Leaving out an optional block removes that component (the paper's ablations)."""

    kind: Literal["dynssm"] = "dynssm"
    inputs: InputsConfig = Field(default_factory=InputsConfig)
    ssm: SsmConfig | None = None
    gru: GruConfig | None = None
    fusion: FusionConfig
    physics: PhysicsConfig | None = None
    adaptation: AdaptationConfig | None = None
    residual: ResidualConfig | None = None
    innovation: InnovationConfig | None = None
    loss: LossConfig
    training: TrainingConfig

    @model_validator(mode="after")
    def _consistent(self) -> DynssmConfig:
        if self.ssm is None and self.gru is None:
            raise ValueError("at least one encoder is needed: ssm or gru")
        if self.adaptation is not None and self.physics is None:
            raise ValueError("adaptation needs physics to adapt")
        if (self.inputs.physics_errors or self.innovation is not None) and self.physics is None:
            raise ValueError("inputs.physics_errors and innovation need physics, whose errors they are")
        if self.reads_changes and self.residual is not None and self.residual.inputs == "raw":
            raise ValueError("residual.inputs: raw goes with inputs as in the paper; expected normalised")
        if self.physics is None and self.residual is None:
            raise ValueError("without physics there must be a residual network to predict the increment")
        if self.physics is not None and self.adaptation is None and self.residual is None:
            raise ValueError("nothing to learn: neither adaptation nor residual (use the model single_track)")
        return self

    @property
    def reads_changes(self) -> bool:
        """Whether the encoders see changes from row to row, so that the first row of the window has none."""
        return self.inputs.features == "increments" or self.inputs.physics_errors

    def check_rows(self, T_s: float) -> None:
        """Checks that all parts of the window fit into it at the sampling time ``T_s`` (s).

        Raises:
            ConfigurationError: a part is longer than the window has rows for.
        """
        H, rows = self.rows(T_s), self.rows(T_s) - self.reads_changes
        wanted = rows if self.inputs.history is None else steps_of(self.inputs.history, T_s)
        if rows < 1 or wanted > rows:
            self._refuse("inputs.history", f"{wanted} rows", rows, T_s)
        if self.innovation and 1 + steps_of(self.innovation.history, T_s) > H:
            self._refuse(
                "innovation.history", f"reaches back over {1 + steps_of(self.innovation.history, T_s)} rows", H, T_s
            )

    def _refuse(self, field: str, given: str, rows: int, T_s: float) -> None:
        raise ConfigurationError(
            f"model {self.name}: {field}: {given}; a window of {self.history:g} s at T_s = {T_s:g} s has {rows}"
        )
