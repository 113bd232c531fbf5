"""Models by kind: the built-in ones, those that a user registers, and their files (``config/models/*.yaml``)."""

from __future__ import annotations

import os
from collections.abc import Mapping
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any

from dynssm_ros import configuration
from dynssm_ros.errors import ConfigurationError
from dynssm_ros.learning.models.base import ModelConfig, TrainableModel
from dynssm_ros.learning.models.dynssm.network import DynSSM
from dynssm_ros.learning.models.ridge import Ridge
from dynssm_ros.learning.models.rls import Rls
from dynssm_ros.runtime.artifact import Normalisation
from dynssm_ros.vehicle import Vehicle

MODELS: dict[str, type[TrainableModel]] = {}  # model classes by kind


def register_model(model: type[TrainableModel]) -> type[TrainableModel]:
    """Makes a model known by its kind to model files, training and export. Use it as a decorator.

    Raises:
        ValueError: without a kind, or one that is taken.
    """
    if not model.KIND:
        raise ValueError(f"model {model.__name__}: expected KIND")
    if MODELS.get(model.KIND, model) is not model:
        raise ValueError(f"model kind {model.KIND}: taken by {MODELS[model.KIND].__name__}")
    MODELS[model.KIND] = model
    return model


for _model in (DynSSM, Rls, Ridge):
    register_model(_model)


def build_model(config: ModelConfig, vehicle: Vehicle, normalisation: Normalisation) -> TrainableModel:
    """An untrained model.

    Raises:
        ConfigurationError: a block of it does not fit the vehicle's sampling time.
    """
    return MODELS[config.kind](config, vehicle, normalisation)


def load_model_config(name_or_path: str | Path, overrides: dict[str, Any] | None = None) -> ModelConfig:
    """Reads a model file by its name (shipped, or of a plugin) or path.

    Args:
        name_or_path: ``base: NAME`` in the file takes another file's fields where it has none.
        overrides: fields that replace those of the file, block by block.

    Raises:
        ConfigurationError: not found, malformed or inconsistent.
    """
    path = configuration.find_config("models", name_or_path)
    return parse_model_config(merge(fields_of(path), overrides or {}), path)


def parse_model_config(content: dict[str, Any], source: str | Path) -> ModelConfig:
    """The configuration from the fields of a model file.

    Raises:
        ConfigurationError: an unknown kind, or fields that do not fit it.
    """
    kind = content.get("kind", DynSSM.KIND)
    if kind not in MODELS:
        raise ConfigurationError(f"{source}: kind: '{kind}'; expected one of {', '.join(sorted(MODELS))}")
    return configuration.validate(MODELS[kind].CONFIG, content, source)


def field_of(config: ModelConfig, name: str) -> Any:
    """A field of a model file by its dotted name, such as ``training.learning_rate``.

    Raises:
        ConfigurationError: the model file has none of that name.
    """
    try:
        return reduce(getitem, name.split("."), config.model_dump(mode="json"))
    except (KeyError, TypeError):
        raise ConfigurationError(
            f"{name}: no field of the model file; expected one, as training.learning_rate"
        ) from None


def overrides(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Fields by dotted names as blocks, for :func:`load_model_config`."""
    nested: dict[str, Any] = {}
    for name, value in settings.items():
        *blocks, field = name.split(".")
        inner = nested
        for block in blocks:
            inner = inner.setdefault(block, {})
        inner[field] = value
    return nested


def fields_of(path: Path, depth: int = 0) -> dict[str, Any]:
    """The fields of a model file, with those of its ``base`` where it has none.

    Raises:
        ConfigurationError: a file is not found or malformed, or they refer to each other in a circle.
    """
    content = configuration.read_yaml(path)
    base = content.pop("base", None)
    if base is None:
        return content
    if depth > 4:
        raise ConfigurationError(f"{path}: base: files refer to each other in a circle")
    return merge(fields_of(referred(path, base), depth + 1), content)


def referred(path: Path, name: str) -> Path:
    """The model file that ``path`` calls ``name``: one beside it, else as on the command line."""
    sibling = path.parent / f"{name}.yaml"
    return sibling if os.path.isfile(sibling) else configuration.find_config("models", name)


def merge(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    """The fields of ``base`` with those of ``over`` instead, block by block."""
    merged = dict(base)
    for key, value in over.items():
        both = isinstance(value, dict) and isinstance(merged.get(key), dict)
        merged[key] = merge(merged[key], value) if both else value
    return merged
