"""Model files (``config/models/*.yaml``): every size and every switch of a model, its losses and its training."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from pydantic import Field, model_validator

from dynssm_ros import configuration
from dynssm_ros.configuration import StrictModel
from dynssm_ros.errors import ConfigurationError
from dynssm_ros.vehicle.single_track import Integrator


class SsmConfig(StrictModel):
    """State-space encoder: long memory, the operating context."""

    channels: int = Field(ge=1, description="width of the encoder")
    states: int = Field(ge=1, description="diagonal states per channel")
    layers: int = Field(default=1, ge=1)


class GruConfig(StrictModel):
    """Recurrent encoder: short transients."""

    hidden: int = Field(ge=1)
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


class PhysicsConfig(StrictModel):
    """Analytical dynamics layer."""

    integrator: Integrator = "euler"
    substeps: int = Field(default=1, ge=1)
    nominal: Literal["vehicle", "mid_range"] = Field(
        default="vehicle", description="theta_0: the vehicle file's nominal values, or the middle of the bounds"
    )


class LossConfig(StrictModel):
    """Weights and switches of the objective, Eq. (24)."""

    scale: Literal["target", "increment"] = Field(
        default="increment", description="s_y: standard deviation of the target state (paper) or of its increment"
    )
    robust: float = Field(default=0.0, ge=0, description="Huber threshold in units of the scale; 0: squared error")
    parameters: float = Field(ge=0, description="lambda_theta")
    correction: float = Field(default=0.0, ge=0, description="lambda_corr; 0 switches the residual penalty off")
    physics: float = Field(default=0.0, ge=0, description="lambda_phy; 0 switches the physics anchor off")


class TrainingConfig(StrictModel):
    """Optimisation."""

    epochs: int = Field(ge=1)
    batch_size: int = Field(ge=1)
    learning_rate: float = Field(gt=0)
    weight_decay: float = Field(default=0.0, ge=0)
    patience: int = Field(ge=1, description="epochs without a better validation loss before it stops")
    seed: int = 0
    min_speed: float = Field(ge=0, description="windows that are slower anywhere are left out (m/s)")
    validation_block: float = Field(default=10.0, gt=0, description="length of the validation blocks (s)")
    validation_every: int = Field(default=6, ge=2, description="every n-th block is for validation")


class ModelConfig(StrictModel):
    """A model as it is trained. Leaving out an optional block removes that component (the paper's ablations)."""

    name: str
    kind: Literal["dynssm", "ridge"] = "dynssm"
    H: int = Field(ge=1, description="rows of the history window")
    physics_errors: bool = Field(
        default=False,
        description="beyond the paper: the encoders also see the physics' own one-step errors over the window, which are "
        "known at run time and carry what another track or set-up changes",
    )
    ssm: SsmConfig | None = None
    gru: GruConfig | None = None
    fusion: FusionConfig | None = None
    physics: PhysicsConfig | None = None
    adaptation: AdaptationConfig | None = None
    residual: ResidualConfig | None = None
    loss: LossConfig | None = None
    training: TrainingConfig
    ridge_penalty: float = Field(default=1.0, gt=0, description="kind ridge: weight of the squared coefficients")

    @model_validator(mode="after")
    def _consistent(self) -> ModelConfig:
        if self.kind == "ridge":
            return self
        if self.fusion is None or self.loss is None:
            raise ValueError("kind dynssm needs the blocks fusion and loss")
        if self.ssm is None and self.gru is None:
            raise ValueError("at least one encoder is needed: ssm or gru")
        if self.adaptation is not None and self.physics is None:
            raise ValueError("adaptation needs physics to adapt")
        if self.physics_errors and (self.physics is None or self.H == 1):
            raise ValueError("physics_errors needs physics, and a window of two rows or more")
        if self.physics is None and self.residual is None:
            raise ValueError("without physics there must be a residual network to predict the increment")
        if self.physics is not None and self.adaptation is None and self.residual is None:
            raise ValueError("nothing to learn: neither adaptation nor residual (use the model single_track)")
        return self


def load_model_config(name_or_path: str | Path) -> ModelConfig:
    """Reads a model file by shipped name or path; ``base: NAME`` takes another file's fields where it has none.

    Raises:
        ConfigurationError: not found, malformed or inconsistent.
    """
    path = configuration.find_config("models", name_or_path)
    return configuration.validate(ModelConfig, _with_base(path), path)


def _with_base(path: Path, depth: int = 0) -> dict[str, Any]:
    content = configuration.read_yaml(path)
    base = content.pop("base", None)
    if base is None:
        return content
    if depth > 4:
        raise ConfigurationError(f"{path}: base: files refer to each other in a circle")
    sibling = path.parent / f"{base}.yaml"
    parent = sibling if sibling.is_file() else configuration.find_config("models", base)
    return _merge(_with_base(parent, depth + 1), content)


def _merge(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in over.items():
        both = isinstance(value, dict) and isinstance(merged.get(key), dict)
        merged[key] = _merge(merged[key], value) if both else value
    return merged
