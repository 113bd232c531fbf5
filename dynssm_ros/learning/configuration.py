"""Model files (``config/models/*.yaml``): every size and every switch of a model, its losses and its training."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from pydantic import Field, PositiveFloat, field_validator, model_validator

from dynssm_ros import configuration
from dynssm_ros.configuration import StrictModel
from dynssm_ros.errors import ConfigurationError
from dynssm_ros.runtime.artifact import ModelKind
from dynssm_ros.vehicle import COEFFICIENTS
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


class DenseConfig(StrictModel):
    """Hidden dense layers of the Deep Dynamics model, all of the same width."""

    layers: int = Field(ge=1)
    width: int = Field(ge=1)


class FusionConfig(StrictModel):
    """Feature fusion: both encoders and the latest normalised input to the latent memory z_t."""

    hidden: int = Field(ge=1)
    latent: int = Field(ge=1, description="size of z_t")


class AdaptationConfig(StrictModel):
    """Bounded parameter head."""

    hidden: int = Field(ge=1, description="size of the physics-conditioned feature c_t")
    alpha: float = Field(gt=0, le=1, description="alpha_theta, largest deviation as a fraction of the admissible range")


class IdentificationConfig(StrictModel):
    """Beyond the paper: changes of a few coefficients are estimated from the physics' past errors in the window."""

    spread: dict[str, PositiveFloat] = Field(
        min_length=1,
        description="standard deviation of each coefficient's change, in its unit, before anything is seen",
    )
    noise: float = Field(
        default=0.03,
        gt=0,
        description="standard deviation of one-step errors that are not the coefficients', in units of s_delta",
    )
    steps: int = Field(ge=1, description="steps of the window that the estimate is of")
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
    rows: int | None = Field(default=None, ge=1, description="latest rows that the encoders read; null: all")
    physics_errors: bool = Field(
        default=False,
        description="beyond the paper: also the physics' own one-step errors over the window, which are known at run time "
        "and carry what another track or set-up changes",
    )


class MemoryConfig(StrictModel):
    """Beyond the paper: the physics' recent one-step errors are carried forward."""

    taps: int = Field(ge=1, description="steps that the error memory reaches back")
    decay: float = Field(
        default=0.9, gt=0, lt=1, description="first value of the learned weight of a step over the next"
    )


class HindcastConfig(StrictModel):
    """Beyond the paper: what the model would have predicted over the last steps judges what it predicts now."""

    steps: int = Field(ge=1, description="steps of the window that are predicted in hindsight")
    trust: bool = Field(
        default=True, description="scale each channel's increment by how well the last ones were predicted"
    )
    prior: float = Field(
        default=3.0,
        gt=0,
        description="least weight of full trust, in squared increments of size s_delta; validation picks",
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


class PhysicsConfig(StrictModel):
    """Analytical dynamics layer."""

    integrator: Integrator = "euler"
    substeps: int = Field(default=1, ge=1)
    nominal: Literal["vehicle", "mid_range", "calibrated"] = Field(
        default="vehicle",
        description="theta_0: the vehicle file's nominal values, the middle of the bounds, or the values that a calibration "
        "on the training data finds",
    )
    load_transfer: bool = Field(default=True, description="false: no load transfer, also if the vehicle file has it")


class LossConfig(StrictModel):
    """Weights and switches of the objective, Eq. (24)."""

    scale: Literal["target", "increment", "none"] = Field(
        default="increment",
        description="s_y: standard deviation of the target state (paper) or of its increment; none: errors as they are, "
        "in m/s, m/s and rad/s",
    )
    robust: float = Field(default=0.0, ge=0, description="Huber threshold in units of the scale; 0: squared error")
    parameters: float = Field(ge=0, description="lambda_theta")
    correction: float = Field(default=0.0, ge=0, description="lambda_corr; 0 switches the residual penalty off")
    physics: float = Field(default=0.0, ge=0, description="lambda_phy; 0 switches the physics anchor off")


class AugmentationConfig(StrictModel):
    """Beyond the paper: training windows changed at random, so that the model does not rely on what another track changes."""

    mirror: bool = Field(default=False, description="half of the windows with left and right exchanged")
    bank: float = Field(
        default=0.0, ge=0, description="constant disturbance of each state's increments: its spread in units of s_delta"
    )
    offset: float = Field(default=0.0, ge=0, description="spread of a constant offset of the steering (rad)")
    grip: float = Field(
        default=0.0,
        ge=0,
        description="spread of a change of the lateral forces, as a share of the lateral acceleration",
    )


class TrainingConfig(StrictModel):
    """Optimisation."""

    epochs: int = Field(ge=1)
    batch_size: int = Field(ge=1)
    learning_rate: float = Field(gt=0)
    schedule: Literal["cosine", "constant"] = Field(default="cosine", description="course of the learning rate")
    weight_decay: float = Field(default=0.0, ge=0)
    gradient_clip: float | None = Field(default=1.0, gt=0, description="largest norm of a gradient; null: any")
    patience: int = Field(ge=1, description="epochs without a better validation loss before it stops")
    seed: int = 0
    min_speed: float = Field(ge=0, description="windows that are slower anywhere are left out (m/s)")
    validation: Literal["blocks", "random"] = Field(
        default="blocks",
        description="blocks in time that share no row with the training windows, or single windows drawn at random, as "
        "the literature does, whose neighbours are trained on",
    )
    validation_block: float = Field(default=10.0, gt=0, description="length of the validation blocks (s)")
    validation_every: int = Field(default=6, ge=2, description="every n-th block (one window in n) is for validation")
    augmentation: AugmentationConfig = Field(default_factory=AugmentationConfig)


class FineTuningConfig(StrictModel):
    """Second stage of FTHD: a trained DDM is trained on."""

    starts_from: ModelConfig = Field(description="the DDM; in a file the name of its model file")
    frozen: int = Field(
        ge=0, description="layers that stay as the DDM has them, from the input on; the GRU is the first"
    )
    physics: float = Field(ge=0, description="weight of the unsupervised physics loss; the supervised loss has 1")


class ModelConfig(StrictModel):
    """A model as it is trained. Leaving out an optional block removes that component (the paper's ablations)."""

    name: str
    kind: ModelKind = "dynssm"
    H: int = Field(ge=1, description="rows of the history window")
    inputs: InputsConfig = Field(default_factory=InputsConfig)
    ssm: SsmConfig | None = None
    gru: GruConfig | None = None
    dense: DenseConfig | None = None
    fusion: FusionConfig | None = None
    physics: PhysicsConfig | None = None
    identification: IdentificationConfig | None = None
    adaptation: AdaptationConfig | None = None
    residual: ResidualConfig | None = None
    memory: MemoryConfig | None = None
    hindcast: HindcastConfig | None = None
    loss: LossConfig | None = None
    training: TrainingConfig
    fine_tuning: FineTuningConfig | None = None
    ridge_penalty: float = Field(default=1.0, gt=0, description="kind ridge: weight of the squared coefficients")

    @model_validator(mode="after")
    def _consistent(self) -> ModelConfig:
        needed, foreign = _BLOCKS[self.kind]
        if any(getattr(self, block) is None for block in needed):
            raise ValueError(f"kind {self.kind} needs the blocks {' and '.join(needed)}")
        for block in foreign:
            if getattr(self, block):
                raise ValueError(f"kind {self.kind} has no {block}")
        if self.kind == "dynssm":
            self._check_components()
        if self.fine_tuning is not None:
            self._check_fine_tuning(self.fine_tuning)
        return self

    def _check_components(self) -> None:
        if self.ssm is None and self.gru is None:
            raise ValueError("at least one encoder is needed: ssm or gru")
        if self.adaptation is not None and self.physics is None:
            raise ValueError("adaptation needs physics to adapt")
        self._check_inputs()
        if self.physics is None and self.residual is None:
            raise ValueError("without physics there must be a residual network to predict the increment")
        if self.physics is not None and self.adaptation is None and self.residual is None:
            raise ValueError("nothing to learn: neither adaptation nor residual (use the model single_track)")

    def _check_inputs(self) -> None:
        changes = self.inputs.features == "increments" or self.inputs.physics_errors
        rows = self.H - 1 if changes else self.H  # the first row's change is not in the window
        if (self.inputs.physics_errors or self.memory is not None) and self.physics is None:
            raise ValueError("inputs.physics_errors and memory need physics, whose errors they are")
        if self.identification is not None and self.adaptation is None:
            raise ValueError("identification needs adaptation, which starts from it")
        if self.identification is not None and self.identification.steps > self.H - 1:
            raise ValueError(
                f"identification.steps: {self.identification.steps}; a window of {self.H} rows has {self.H - 1}"
            )
        if rows < 1 or (self.inputs.rows or 1) > rows:
            raise ValueError(f"inputs.rows: {self.inputs.rows}; a window of {self.H} rows has {rows} of them")
        if changes and self.residual is not None and self.residual.inputs == "raw":
            raise ValueError("residual.inputs: raw goes with inputs as in the paper; expected normalised")
        if self.hindcast is not None and self.memory is None:
            raise ValueError("hindcast needs memory, which predicts in hindsight")
        needed = 1 + (self.memory.taps if self.memory else 0) + (self.hindcast.steps if self.hindcast else 0)
        if self.memory is not None and needed > self.H:
            raise ValueError(f"H: {self.H} rows; memory and hindcast reach back over {needed}")

    def _check_fine_tuning(self, fine_tuning: FineTuningConfig) -> None:
        start = fine_tuning.starts_from
        if start.kind != "ddm":
            raise ValueError(f"fine_tuning.starts_from: {start.name} is of kind {start.kind}; expected ddm")
        for ours, its, names in ((self, start, _NETWORK), (self.training, start.training, _SPLIT)):
            for name in names:
                if getattr(ours, name) != getattr(its, name):
                    raise ValueError(f"{name}: differs from that of {start.name}, which fine_tuning starts from")
        assert self.dense is not None
        if fine_tuning.frozen > self.dense.layers + 1:
            raise ValueError(
                f"fine_tuning.frozen: {fine_tuning.frozen} leaves nothing to train of GRU, {self.dense.layers} dense "
                "layers and the output layer"
            )

    @property
    def parts(self) -> int:
        """Stretches that further models are trained without, to fit the variance to."""
        wanted = self.hindcast.folds if self.hindcast and self.hindcast.uncertainty else 1
        return wanted if wanted > 1 else 0

    def with_training(self, **changes: Any) -> ModelConfig:
        """The same model with other training settings, which hold for the model that it starts from too."""
        updated: dict[str, Any] = {"training": self.training.model_copy(update=changes)}
        if self.fine_tuning is not None:
            start = self.fine_tuning.starts_from.with_training(**changes)
            updated["fine_tuning"] = self.fine_tuning.model_copy(update={"starts_from": start})
        return self.model_copy(update=updated)


_OF_DYNSSM = ("ssm", "fusion", "identification", "adaptation", "residual", "memory", "hindcast")
# the blocks that a kind needs, and those that it does not have
_BLOCKS: dict[ModelKind, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "dynssm": (("fusion", "loss"), ("dense", "fine_tuning")),
    "ridge": ((), ("fine_tuning",)),
    "ddm": (("gru", "dense", "physics", "loss"), (*_OF_DYNSSM, "fine_tuning")),
    "fthd": (("gru", "dense", "physics", "loss", "fine_tuning"), _OF_DYNSSM),
}
# what fine-tuning takes over: the network, and the split, without which it would validate on windows of the first stage
_NETWORK = ("H", "gru", "dense", "physics")
_SPLIT = ("seed", "min_speed", "validation", "validation_block", "validation_every")


def load_model_config(name_or_path: str | Path) -> ModelConfig:
    """Reads a model file by shipped name or path; ``base: NAME`` takes another file's fields where it has none.

    Raises:
        ConfigurationError: not found, malformed or inconsistent.
    """
    path = configuration.find_config("models", name_or_path)
    content = _with_base(path)
    fine_tuning = content.get("fine_tuning")
    if isinstance(fine_tuning, dict) and isinstance(fine_tuning.get("starts_from"), str):
        start = _with_base(_referred(path, fine_tuning["starts_from"]))
        content["fine_tuning"] = fine_tuning | {"starts_from": start}
    return configuration.validate(ModelConfig, content, path)


def _with_base(path: Path, depth: int = 0) -> dict[str, Any]:
    content = configuration.read_yaml(path)
    base = content.pop("base", None)
    if base is None:
        return content
    if depth > 4:
        raise ConfigurationError(f"{path}: base: files refer to each other in a circle")
    return _merge(_with_base(_referred(path, base), depth + 1), content)


def _referred(path: Path, name: str) -> Path:
    """The model file that ``path`` calls ``name``: one beside it, else as on the command line."""
    sibling = path.parent / f"{name}.yaml"
    return sibling if sibling.is_file() else configuration.find_config("models", name)


def _merge(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in over.items():
        both = isinstance(value, dict) and isinstance(merged.get(key), dict)
        merged[key] = _merge(merged[key], value) if both else value
    return merged
