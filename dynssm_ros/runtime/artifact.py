"""The model folder: ``model.yaml``, ``weights.safetensors``, ``model.onnx``, ``metrics.json``, ``online.safetensors``.

A model whose network does not act beside its online layer has no ``model.onnx``: it is the calibrated physics and the layer.

It is self-contained - architecture, vehicle with bounds, normalisation, sampling time and the checksums of the other
files are in ``model.yaml`` - and nothing in it is ever unpickled. Whatever is wrong with a folder is found when it is
opened, not when the car drives.
"""

from __future__ import annotations

import hashlib
import math
import os
import stat
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import yaml
from pydantic import Field, model_validator

from dynssm_ros import configuration
from dynssm_ros.configuration import StrictModel
from dynssm_ros.errors import ArtifactError, ConfigurationError
from dynssm_ros.runtime.online import OnlineLayer, OnlineLayerCard, load_layer
from dynssm_ros.runtime.tensors import read_tensors
from dynssm_ros.signals.inputs import WINDOW_COLUMNS
from dynssm_ros.signals.signal_map import Commands
from dynssm_ros.vehicle.integrators import Integrator
from dynssm_ros.vehicle.parameters import Vehicle
from dynssm_ros.vehicle.single_track import standing_speed

FORMAT_VERSION = 2  # 2: models without a network have no graph; features are no outputs of it
CARD, WEIGHTS, ONNX, METRICS = "model.yaml", "weights.safetensors", "model.onnx", "metrics.json"
ONLINE = "online.safetensors"
_LARGEST = {CARD: 1 << 20, METRICS: 10 << 20, ONLINE: 10 << 20, WEIGHTS: 100 << 20, ONNX: 100 << 20}
"""Bytes of each file."""


Variance = Annotated[float, Field(gt=0)]


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
    slowest: float | None = Field(
        default=None, description="least v_x that it was trained on (m/s), negative backwards; null: not noted"
    )
    covariance: tuple[Variance, Variance, Variance] = Field(
        description="one-step error variances on validation data; without a network on the training laps"
    )
    network: bool = Field(
        default=True,
        description="whether a network acts; false: the physics and the online layer alone, without a graph",
    )
    online: OnlineLayerCard | None = Field(default=None, description="the online layer, if it has one")
    parameters: int = Field(ge=0, description="weights that training finds")
    flops: int = Field(ge=0, description="floating-point operations per prediction")
    training: dict[str, Any] = Field(default_factory=dict, description="data, split, seed, epochs")
    laps: tuple[str, ...] = Field(default=(), description="fingerprints of what it was trained on")
    checksums: dict[str, str] = Field(description="SHA-256 of the other files")

    @model_validator(mode="after")
    def _consistent(self) -> ModelCard:
        if not self.network and (self.online is None or self.online.error_rows is None):
            raise ValueError("network: false goes with an online layer that has error_rows; expected one")
        if self.columns != WINDOW_COLUMNS:
            raise ValueError(f"columns {self.columns} are not {WINDOW_COLUMNS}")
        if not math.isclose(self.sampling_time, self.vehicle.sampling_time):
            raise ValueError(
                f"sampling_time {self.sampling_time:g} s is not the vehicle's ({self.vehicle.sampling_time:g} s)"
            )
        if set(self.checksums) != set(self.files):
            raise ValueError(f"checksums {sorted(self.checksums)} are not those of {', '.join(self.files)}")
        return self

    @property
    def least(self) -> float:
        """``v_x`` (m/s) below which nothing that was learned speaks: a car that stands or reverses, unless trained on."""
        stands = float(standing_speed(self.vehicle.constants.wheelbase))
        return stands if self.slowest is None else min(self.slowest, stands)

    @property
    def files(self) -> tuple[str, ...]:
        """The folder's other files."""
        return (WEIGHTS, *([ONNX] if self.network else []), METRICS, *([ONLINE] if self.online else []))


@dataclass(frozen=True)
class Artifact:
    """A checked model folder.

    Attributes:
        path: of the folder.
        card: its ``model.yaml``.
        graph: content of its ``model.onnx``, as it was checked; empty without a network.
        prior: content of its ``online.safetensors``; empty without an online layer.
    """

    path: Path
    card: ModelCard
    graph: bytes
    prior: bytes

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
            ArtifactError: its file is damaged, or its numbers are none of such a layer.
        """
        card = self.card
        if card.online is None:
            return None
        scale = np.array(card.normalisation.increment_scale)
        return load_layer(
            self.prior,
            self.path / ONLINE,
            card.online,
            scale=scale,
            vehicle=card.vehicle,
            integrator=card.integrator,
            substeps=card.substeps,
            least=card.least,
        )


def model_folder(name_or_path: str | Path) -> Path:
    """The model folder at a path or, where there is none, the shipped one of that name."""
    if not os.path.isdir(name_or_path) and str(name_or_path) in (shipped := shipped_models()):
        return shipped[str(name_or_path)]
    return Path(name_or_path)


def shipped_models() -> dict[str, Path]:
    """Folders of the shipped models by name."""
    return {
        card.parent.name: card.parent for card in sorted((configuration.config_root() / "models").glob(f"*/{CARD}"))
    }


def open_artifact(path: str | Path) -> Artifact:
    """Opens and checks a model folder, or a shipped one by its name.

    Raises:
        ArtifactError: a file is missing, changed, damaged or too large, the format is newer, or a weight is not finite.
    """
    folder = model_folder(path)
    return parse_artifact(folder, read_folder(folder))


def read_folder(path: str | Path, root: str = "") -> dict[str, bytes]:
    """Reads the files of a model folder, each once: what is checked is what is used, whoever writes there meanwhile.

    Args:
        path: of the folder, or a shipped one's name.
        root: folder below which all files must be, links followed; empty: anywhere.

    Raises:
        ArtifactError: no such folder, a file that cannot be read, is too large or none at all, or lies elsewhere.
    """
    folder = model_folder(path)
    if not os.path.isdir(folder):  # unlike Path.is_dir, False where looking is forbidden or the name impossible
        raise ArtifactError(f"{path}: no such model folder; `dynssm train` writes one")
    return {name: _read(folder / name, root) for name in _LARGEST if os.path.lexists(folder / name)}


def parse_artifact(path: Path, files: Mapping[str, bytes]) -> Artifact:
    """Checks the ``files`` of a model folder, as :func:`read_folder` gives them.

    Raises:
        ArtifactError: as :func:`open_artifact`.
    """
    card = _parse_card(path, files)
    for name, expected in card.checksums.items():
        if hashlib.sha256(_content(path, files, name)).hexdigest() != expected:
            raise ArtifactError(f"{path / name}: does not match its checksum in {CARD}; damaged or exchanged")
    weights, _ = read_tensors(files[WEIGHTS], f"{path / WEIGHTS}: not a readable safetensors file")
    for name, weight in weights.items():
        if not np.isfinite(weight).all():
            raise ArtifactError(f"{path / WEIGHTS}: weight {name} holds NaN or infinity")
    return Artifact(path, card, files[ONNX] if card.network else b"", files[ONLINE] if card.online else b"")


def _read(file: Path, root: str) -> bytes:
    """The content of a file of a model folder; without waiting where it is none."""
    try:
        handle = os.open(file, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        with open(handle, "rb") as opened:
            status, largest = os.fstat(handle), _LARGEST[file.name]
            if not stat.S_ISREG(status.st_mode) or status.st_size > largest:
                raise ArtifactError(f"{file}: {status.st_size} bytes; expected a file of at most {largest}")
            if root and not Path(os.readlink(f"/proc/self/fd/{handle}")).is_relative_to(os.path.realpath(root)):
                raise ArtifactError(f"{file}: is a link out of {root}; expected a file in it (parameter model_root)")
            return opened.read(largest)
    except OSError as error:
        raise ArtifactError(f"{file}: cannot be read ({error.strerror})") from error


def _content(path: Path, files: Mapping[str, bytes], name: str) -> bytes:
    if name not in files:
        raise ArtifactError(f"{path}: incomplete model folder, {name} is missing")
    return files[name]


def read_card(path: Path) -> ModelCard:
    """Reads ``model.yaml`` of a model folder.

    Raises:
        ArtifactError: malformed, or of a newer format.
    """
    return _parse_card(path, {CARD: _read(path / CARD, "")})


def _parse_card(path: Path, files: Mapping[str, bytes]) -> ModelCard:
    try:
        content = configuration.parse_yaml(_content(path, files, CARD), path / CARD)
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
