"""Model file of a DynSSM: every size and every switch. Leaving out an optional block removes that component."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, PositiveFloat, field_validator, model_validator

from dynssm_ros.configuration import StrictModel
from dynssm_ros.errors import ConfigurationError
from dynssm_ros.learning.losses import LossConfig
from dynssm_ros.learning.models.base import GruConfig, ModelConfig, TrainingConfig, steps_of
from dynssm_ros.learning.models.physics import PhysicsConfig
from dynssm_ros.vehicle import COEFFICIENTS, Vehicle
from dynssm_ros.vehicle.single_track import Integrator


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


class EstimationConfig(StrictModel):
    """Beyond the paper: a few coefficients are estimated (MAP) from the physics' one-step errors in the window."""

    spread: dict[str, PositiveFloat] = Field(
        min_length=1,
        description="standard deviation of each coefficient's change before anything is seen, as a share of its range",
    )
    noise: float = Field(
        default=0.03,
        gt=0,
        description="standard deviation of one-step errors that are not the coefficients', in units of s_delta",
    )
    history: float = Field(gt=0, description="latest part of the window that the estimate is of (s)")
    rounds: int = Field(
        default=2, ge=1, description="of linearisation; one will do where changes are small and come one at a time"
    )

    @field_validator("spread")
    @classmethod
    def _known(cls, value: dict[str, float]) -> dict[str, float]:
        if unknown := [name for name in value if name not in COEFFICIENTS]:
            raise ValueError(f"unknown {', '.join(unknown)}; expected some of {' '.join(COEFFICIENTS)}")
        return value


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


class InWindowConfig(StrictModel):
    """Beyond the paper: errors that the prediction would have made over the last steps judge what it predicts now."""

    history: float = Field(gt=0, description="latest part of the window that is predicted retrospectively (s)")
    shrinkage: bool = Field(
        default=True, description="scale each channel's increment by how well the last ones were predicted"
    )
    shrinkage_weight: float = Field(
        default=3.0,
        gt=0,
        description="least weight of no shrinkage, in squared increments of size s_delta; validation picks",
    )
    limit: float | None = Field(
        default=None,
        gt=0,
        description="largest residual, in root mean squares of the errors that the physics made over these steps; null: any",
    )
    uncertainty: bool = Field(
        default=True, description="variance that follows the recent errors, instead of a constant"
    )
    folds: int = Field(
        default=1,
        ge=1,
        description="stretches of the recording; the variance is fitted to the errors on each by a model trained on the rest "
        "for a quarter of the epochs. 1, or too little data for it: to those on the validation blocks, whose laps the model "
        "knows",
    )


class DynssmConfig(ModelConfig):
    """A DynSSM as it is trained. Leaving out an optional block removes that component (the paper's ablations)."""

    kind: Literal["dynssm"] = "dynssm"
    inputs: InputsConfig = Field(default_factory=InputsConfig)
    ssm: SsmConfig | None = None
    gru: GruConfig | None = None
    fusion: FusionConfig
    physics: PhysicsConfig | None = None
    in_window_estimation: EstimationConfig | None = None
    adaptation: AdaptationConfig | None = None
    residual: ResidualConfig | None = None
    innovation: InnovationConfig | None = None
    in_window_errors: InWindowConfig | None = None
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
        if self.in_window_estimation is not None and self.adaptation is None:
            raise ValueError("in_window_estimation needs adaptation, which starts from it")
        if self.in_window_errors is not None and self.innovation is None:
            raise ValueError("in_window_errors needs innovation, which predicts retrospectively")
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

    @property
    def calibrates(self) -> bool:
        """As the physics says."""
        return self.physics is not None and self.physics.nominal == "calibrated"

    @property
    def stepping(self) -> tuple[Integrator, int]:
        """Those of the physics."""
        return (self.physics.integrator, self.physics.substeps) if self.physics else super().stepping

    @property
    def parts(self) -> int:
        """As ``in_window_errors.folds`` or the online layer says."""
        judge = self.in_window_errors
        return judge.folds if judge and judge.uncertainty and judge.folds > 1 else super().parts

    def modelled_vehicle(self, vehicle: Vehicle) -> Vehicle:
        """Without load transfer, if the physics has none."""
        return vehicle if self.physics is None else self.physics.modelled(vehicle)

    def check_rows(self, T_s: float) -> None:
        """Checks that all parts of the window fit into it at the sampling time ``T_s`` (s).

        Raises:
            ConfigurationError: a part is longer than the window has rows for.
        """
        H, rows = self.rows(T_s), self.rows(T_s) - self.reads_changes
        wanted = rows if self.inputs.history is None else steps_of(self.inputs.history, T_s)
        if rows < 1 or wanted > rows:
            self._refuse("inputs.history", f"{wanted} rows", rows, T_s)
        if self.in_window_estimation and steps_of(self.in_window_estimation.history, T_s) > H - 1:
            steps = steps_of(self.in_window_estimation.history, T_s)
            self._refuse("in_window_estimation.history", f"{steps} steps", H - 1, T_s)
        if self.innovation:
            back = steps_of(self.innovation.history, T_s)
            if self.in_window_errors:
                back += steps_of(self.in_window_errors.history, T_s)
            if 1 + back > H:
                self._refuse("innovation and in_window_errors", f"reach back over {1 + back} rows", H, T_s)

    def _refuse(self, field: str, given: str, rows: int, T_s: float) -> None:
        raise ConfigurationError(
            f"model {self.name}: {field}: {given}; a window of {self.history:g} s at T_s = {T_s:g} s has {rows}"
        )
