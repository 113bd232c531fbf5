"""Models by name or folder."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from dynssm_ros.errors import ConfigurationError
from dynssm_ros.runtime.artifact import model_folder, open_artifact, shipped_models
from dynssm_ros.runtime.baselines import Persistence, SingleTrack, SingleTrackEwma
from dynssm_ros.runtime.contract import WindowModel, without_online
from dynssm_ros.runtime.kalman import SingleTrackEkf
from dynssm_ros.runtime.onnx_model import OnnxModel
from dynssm_ros.vehicle import Vehicle

_PHYSICS: dict[str, Callable[[Vehicle], WindowModel]] = {
    physics.name: physics for physics in (SingleTrack, SingleTrackEwma, SingleTrackEkf)
}
UNTRAINED = (Persistence.name, *_PHYSICS)
"""Names of the models that need no training."""


def load_model(name_or_dir: str | Path, vehicle: Vehicle | None = None) -> WindowModel:
    """Opens a model folder, a shipped one by its name, or one of the models that need no training.

    Args:
        name_or_dir: a model folder, the name of a shipped one, or one of :data:`UNTRAINED`.
        vehicle: needed for the single-track models.

    Raises:
        ArtifactError: the folder is not a usable model.
        ConfigurationError: no such model, or the vehicle is missing.
    """
    if os.path.isdir(model_folder(name_or_dir)):
        return OnnxModel(open_artifact(name_or_dir))
    if name_or_dir == Persistence.name:
        return Persistence()
    physics = _PHYSICS.get(str(name_or_dir))
    if physics is None:
        names = ", ".join((*UNTRAINED, *shipped_models()))
        raise ConfigurationError(f"model '{name_or_dir}': neither a model folder nor one of {names}")
    if vehicle is None:
        raise ConfigurationError(f"model {name_or_dir}: needs --vehicle")
    return physics(vehicle)


def open_models(models: Sequence[WindowModel | str | Path], vehicle: Vehicle | None = None) -> dict[str, WindowModel]:
    """Models by their names; where two have the same one, what was given disambiguates."""
    opened = {str(m): load_model(m, vehicle) if isinstance(m, (str, Path)) else m for m in models}
    return disambiguated(opened, lambda model: model.name)


def with_offline(models: Mapping[str, WindowModel]) -> dict[str, WindowModel]:
    """Models, each that has an online layer followed by itself without it."""
    both: dict[str, WindowModel] = {}
    for label, model in models.items():
        both |= {label: model} if model.online is None else {label: model, f"{label} (offline)": without_online(model)}
    return both


def disambiguated(opened: Mapping[str, Any], name: Callable[[Any], str]) -> dict[str, Any]:
    """What was opened, by name; where several have the same one, by what was given."""
    called = [name(each) for each in opened.values()]
    return {given if called.count(name(each)) > 1 else name(each): each for given, each in opened.items()}
