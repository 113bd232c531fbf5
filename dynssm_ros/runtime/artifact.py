"""The model folder: ``model.yaml``, ``weights.safetensors``, ``model.onnx``, ``metrics.json``, ``online.safetensors``.

It is self-contained - architecture, vehicle with bounds, normalisation, sampling time and the checksums of the other
files are in ``model.yaml`` - and nothing in it is ever unpickled. Whatever is wrong with a folder is found when it is
opened, not when the car drives.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from pydantic import Field, model_validator
from safetensors import SafetensorError, safe_open

from dynssm_ros import configuration
from dynssm_ros.configuration import StrictModel
from dynssm_ros.errors import ArtifactError, ConfigurationError
from dynssm_ros.files import checksum
from dynssm_ros.runtime.online import OnlineLayer, OnlineLayerCard, load_layer
from dynssm_ros.signals.inputs import WINDOW_COLUMNS
from dynssm_ros.signals.signal_map import Commands
from dynssm_ros.vehicle.integrators import Integrator
from dynssm_ros.vehicle.parameters import Vehicle

FORMAT_VERSION = 1
CARD, WEIGHTS, ONNX, METRICS = "model.yaml", "weights.safetensors", "model.onnx", "metrics.json"
ONLINE = "online.safetensors"


class Normalisation(StrictModel):
    """Scales found on the training data, in the units of the columns they belong to."""

    input_mean: tuple[float, ...] = Field(min_length=7, max_length=7, description="mean of each window column")
    input_std: tuple[float, ...] = Field(min_length=7, max_length=7, description="standard deviation of each column")
    state_scale: tuple[float, float, float] = Field(description="s_y: standard deviation of the target state")
    increment_scale: tuple[float, float, float] = Field(description="s_delta: standard deviation of the increment")

    @model_validator(mode="after")
    def _positive(self) -> Normalisation:
        for name in ("input_std", "state_scale", "increment_scale"):
            if min(getattr(self, name)) <= 0:
                raise ValueError(f"{name} must be positive everywhere")
        return self


class ModelCard(StrictModel):
    """``model.yaml``: all that is needed to use the model, and how it came about."""

    format_version: int = Field(default=FORMAT_VERSION, ge=1)
    name: str
    kind: str = Field(description="which model class the weights belong to")
    architecture: dict[str, Any] = Field(description="the model configuration it was trained from")
    vehicle: Vehicle
    sampling_time: float = Field(gt=0, description="T_s (s)")
    window: int = Field(gt=0, description="H, rows of the history window")
    columns: tuple[str, ...] = WINDOW_COLUMNS
    commands: Commands = Field(description="command protocol of the training data")
    held: tuple[str, ...] = Field(
        default=(),
        description="signals that kept their last sample until the next in the training data; live they do too",
    )
    integrator: Integrator = "euler"
    substeps: int = Field(default=1, ge=1)
    normalisation: Normalisation
    covariance: tuple[float, float, float] = Field(description="one-step error variances on validation data")
    online: OnlineLayerCard | None = Field(default=None, description="the online layer, if it has one")
    parameters: int = Field(ge=0, description="weights that training finds")
    flops: int = Field(ge=0, description="floating-point operations per prediction")
    training: dict[str, Any] = Field(default_factory=dict, description="data, split, seed, epochs")
    checksums: dict[str, str] = Field(description="SHA-256 of the other files")

    @model_validator(mode="after")
    def _consistent(self) -> ModelCard:
        if self.columns != WINDOW_COLUMNS:
            raise ValueError(f"columns {self.columns} are not {WINDOW_COLUMNS}")
        if set(self.checksums) != set(self.files):
            raise ValueError(f"checksums {sorted(self.checksums)} are not those of {', '.join(self.files)}")
        return self

    @property
    def files(self) -> tuple[str, ...]:
        """The folder's other files."""
        return (WEIGHTS, ONNX, METRICS, *([ONLINE] if self.online else []))


@dataclass(frozen=True)
class Artifact:
    """A checked model folder."""

    path: Path
    card: ModelCard

    @property
    def onnx(self) -> Path:
        """The deployed graph."""
        return self.path / ONNX

    @property
    def weights(self) -> Path:
        """The weights as trained."""
        return self.path / WEIGHTS

    def online_layer(self) -> OnlineLayer | None:
        """The online layer as trained, if it has one.

        Raises:
            ArtifactError: its file is damaged.
        """
        card = self.card
        if card.online is None:
            return None
        scale = np.array(card.normalisation.increment_scale)
        return load_layer(
            self.path / ONLINE, card.online, scale, card.vehicle, integrator=card.integrator, substeps=card.substeps
        )


def open_artifact(path: str | Path) -> Artifact:
    """Opens and checks a model folder.

    Raises:
        ArtifactError: a file is missing, changed or damaged, the format is newer, or a weight is not finite.
    """
    path = Path(path)
    if not path.is_dir():
        raise ArtifactError(f"{path}: no such model folder; `dynssm train` writes one")
    _require(path, CARD)
    card = read_card(path)
    for name, expected in card.checksums.items():
        _require(path, name)
        try:
            found = checksum(path / name)
        except OSError as error:
            raise ArtifactError(f"{path / name}: cannot be read ({error.strerror})") from error
        if found != expected:
            raise ArtifactError(f"{path / name}: does not match its checksum in {CARD}; damaged or exchanged")
    _check_weights(path / WEIGHTS)
    return Artifact(path, card)


def _require(path: Path, name: str) -> None:
    if not (path / name).is_file():
        raise ArtifactError(f"{path}: incomplete model folder, {name} is missing")


def read_card(path: Path) -> ModelCard:
    """Reads ``model.yaml`` of a model folder.

    Raises:
        ArtifactError: malformed, or of a newer format.
    """
    try:
        content = configuration.read_yaml(path / CARD)
        version = content.get("format_version")
        if isinstance(version, int) and version > FORMAT_VERSION:
            raise ArtifactError(
                f"{path / CARD}: format_version {version} is newer than this package reads ({FORMAT_VERSION})"
            )
        return configuration.validate(ModelCard, content, path / CARD)
    except ConfigurationError as error:
        raise ArtifactError(str(error)) from error


def write_card(card: ModelCard, folder: Path) -> None:
    """Writes ``model.yaml`` into ``folder``, which is being put together."""
    text = yaml.safe_dump(card.model_dump(mode="json"), sort_keys=False, default_flow_style=None, width=110)
    (folder / CARD).write_text(text, encoding="utf-8")


def _check_weights(file: Path) -> None:
    try:
        with safe_open(file, framework="numpy") as weights:
            for name in weights.keys():  # noqa: SIM118 - not a mapping
                if not np.isfinite(weights.get_tensor(name)).all():
                    raise ArtifactError(f"{file}: weight {name} holds NaN or infinity")
    except (SafetensorError, OSError) as error:
        raise ArtifactError(f"{file}: not a readable safetensors file ({error})") from error
