"""Configuration files: where they lie, how they are read, and how a wrong one is reported.

Wherever a vehicle, signal map or model is asked for, the name of a shipped file or a path serves.
"""

from __future__ import annotations

import os
import sysconfig
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from dynssm_ros.errors import ConfigurationError

PACKAGE = "dynssm_ros"
_Model = TypeVar("_Model", bound=BaseModel)


class StrictModel(BaseModel):
    """Base of all configuration: immutable, unknown fields are errors, infinities and NaN too."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


def config_directories() -> Iterator[Path]:
    """Yields the folders that may hold shipped configuration, best first.

    The source tree (editable installs), the ament prefixes (colcon), the environment's ``share`` (pip).
    """
    yield Path(__file__).resolve().parent.parent / "config"
    prefixes = [p for p in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if p]
    prefixes.append(sysconfig.get_path("data"))
    for prefix in prefixes:
        yield Path(prefix) / "share" / PACKAGE / "config"
    # colcon without an activated workspace: <prefix>/lib/pythonX.Y/site-packages/dynssm_ros/configuration.py
    yield Path(__file__).resolve().parents[4] / "share" / PACKAGE / "config"


def config_root() -> Path:
    """The folder of the shipped configuration.

    Raises:
        ConfigurationError: the installation lacks it.
    """
    for directory in config_directories():
        if (directory / "vehicles").is_dir():
            return directory
    raise ConfigurationError("shipped configuration not found: expected share/dynssm_ros/config beside the package")


def find_config(kind: str, name_or_path: str | Path) -> Path:
    """Resolves the name of a shipped file of ``kind`` (``vehicles``, ``signals``, ``models``) or a path.

    Raises:
        ConfigurationError: neither a file nor a shipped name.
    """
    path = Path(name_or_path)
    if path.is_file():
        return path
    shipped = config_root() / kind
    candidate = shipped / f"{name_or_path}.yaml"
    if candidate.is_file():
        return candidate
    names = ", ".join(sorted(p.stem for p in shipped.glob("*.yaml")))
    raise ConfigurationError(f"{kind}: '{name_or_path}' is neither a file nor a shipped name ({names})")


def read_yaml(path: Path) -> dict[str, Any]:
    """Reads a YAML mapping with the safe loader.

    Raises:
        ConfigurationError: unreadable, not YAML, or not a mapping.
    """
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"{path}: cannot be read ({error})") from error
    except yaml.YAMLError as error:
        raise ConfigurationError(f"{path}: not valid YAML ({' '.join(str(error).split())})") from error
    if not isinstance(content, dict):
        raise ConfigurationError(f"{path}: expected a mapping of fields, got {type(content).__name__}")
    return content


def validate(schema: type[_Model], content: dict[str, Any], source: str | Path) -> _Model:
    """Builds ``schema`` from ``content``; the first violation becomes a one-line error naming file, field and value.

    Raises:
        ConfigurationError: ``content`` does not fit ``schema``.
    """
    try:
        return schema.model_validate(content)
    except ValidationError as error:
        problems = error.errors(include_url=False, include_context=False)
        first = problems[0]
        field = ".".join(str(part) for part in first["loc"]) or "(whole file)"
        value = "" if first["type"] == "missing" else f" (got {_short(first['input'])})"
        more = f"; {len(problems) - 1} more" if len(problems) > 1 else ""
        message = first["msg"].removeprefix("Value error, ")
        raise ConfigurationError(f"{source}: {field}: {message}{value}{more}") from error


def load(schema: type[_Model], kind: str, name_or_path: str | Path) -> _Model:
    """Finds, reads and validates a configuration file of ``kind``."""
    path = find_config(kind, name_or_path)
    return validate(schema, read_yaml(path), path)


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
