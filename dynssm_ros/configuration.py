"""Configuration files: where they lie, how they are read, and how a wrong one is reported.

Wherever a vehicle, signal map or model is asked for, the name of a shipped file or a path serves.
"""

from __future__ import annotations

import os
import sysconfig
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from dynssm_ros.errors import ConfigurationError

PACKAGE = "dynssm_ros"
_DEEPEST, _MOST_VALUES = 50, 100_000
_REGISTERED: dict[str, list[Path]] = {}
_Model = TypeVar("_Model", bound=BaseModel)


class StrictModel(BaseModel):
    """Base of all configuration: immutable, unknown fields are errors, infinities and NaN too."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


def config_directories() -> Iterator[Path]:
    """Yields the folders that may hold shipped configuration, best first.

    The source tree (editable installs, ``colcon build --symlink-install``); ``share`` of the prefix that the package lies
    in (pip, colcon); ``share`` of the environment and of the ament prefixes, where the package is only linked to.
    """
    package = Path(__file__).resolve().parent
    yield package.parent / "config"
    ament = [Path(prefix) for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if prefix]
    for prefix in (*package.parents, Path(sysconfig.get_path("data")), *ament):
        yield prefix / "share" / PACKAGE / "config"


def config_root() -> Path:
    """The folder of the shipped configuration; a :class:`ConfigurationError` if the installation lacks it."""
    for directory in config_directories():
        if os.path.isdir(directory / "vehicles"):
            return directory
    raise ConfigurationError("shipped configuration not found: expected share/dynssm_ros/config beside the package")


def register_folder(kind: str, folder: Path) -> None:
    """Makes the YAML files of a folder known by name, as the shipped ones of ``kind`` are; a plugin calls it."""
    folders = _REGISTERED.setdefault(kind, [])
    if folder not in folders:
        folders.append(folder)


def find_config(kind: str, name_or_path: str | Path) -> Path:
    """Resolves the name of a file of ``kind`` (``vehicles``, ``signals``, ``models``), shipped or registered, or a path.

    What is neither is a :class:`ConfigurationError`.
    """
    path = Path(name_or_path)
    if os.path.isfile(path):  # unlike Path.is_file, False where looking is forbidden or the name impossible
        return path
    folders = [config_root() / kind, *_REGISTERED.get(kind, [])]
    for folder in folders:
        candidate = folder / f"{name_or_path}.yaml"
        if os.path.isfile(candidate):
            return candidate
    names = ", ".join(sorted(p.stem for folder in folders for p in folder.glob("*.yaml")))
    raise ConfigurationError(f"{kind}: '{name_or_path}' is neither a file nor a shipped name ({names})")


def read_yaml(path: Path) -> dict[str, Any]:
    """Reads a YAML mapping with the safe loader; what is none, or unreadable, is a :class:`ConfigurationError`."""
    try:
        return parse_yaml(path.read_bytes(), path)
    except OSError as error:
        raise ConfigurationError(f"{path}: cannot be read ({error})") from error


def parse_yaml(data: bytes, path: Path) -> dict[str, Any]:
    """The YAML mapping in ``data``, which was read from ``path``.

    Raises:
        ConfigurationError: not YAML, not a mapping, nested deeper than 50, or of more than 100,000 values, each alias
            counted as what it stands for.
    """
    try:
        text = data.decode("utf-8")
        _check_extent(text)
        content = yaml.load(text, _Loader)  # noqa: S506 - derived from the safe loader
    except UnicodeDecodeError as error:
        raise ConfigurationError(f"{path}: cannot be read ({error})") from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:  # a date that does not exist is a ValueError
        raise ConfigurationError(f"{path}: not valid YAML ({' '.join(str(error).split())})") from error
    if not isinstance(content, dict):
        raise ConfigurationError(f"{path}: expected a mapping of fields, got {type(content).__name__}")
    return content


def validate(schema: type[_Model], content: dict[str, Any], source: str | Path) -> _Model:
    """Builds ``schema`` from ``content``; the first violation is a one-line ConfigurationError with file, field and value.

    Validators find ``source`` in their context, to read files that ``content`` refers to.
    """
    try:
        return schema.model_validate(content, context={"source": source})
    except ValidationError as error:
        raise ConfigurationError(f"{source}: {describe(error)}") from error


def describe(error: ValidationError) -> str:
    """The first violation in one line: field, what is wrong, the value, and how many more there are."""
    problems = error.errors(include_url=False, include_context=False)
    first = problems[0]
    field = ".".join(str(part) for part in first["loc"])
    message = " ".join(first["msg"].removeprefix("Value error, ").split())
    if field and first["type"] != "missing":
        got = repr(first["input"])
        message += f" (got {got if len(got) <= 60 else got[:57] + '...'})"
    more = f"; {len(problems) - 1} more" if len(problems) > 1 else ""
    return f"{field}: {message}{more}" if field else f"{message}{more}"


def load(schema: type[_Model], kind: str, name_or_path: str | Path) -> _Model:
    """Finds, reads and validates a configuration file of ``kind``."""
    path = find_config(kind, name_or_path)
    return validate(schema, read_yaml(path), path)


def _check_extent(text: str) -> None:
    """Looks at the events of a YAML text, from which nothing is built yet."""
    count, sizes, begun = 0, dict[str | None, int](), list[tuple[str | None, int]]()
    for event in yaml.parse(text, _Loader):
        if isinstance(event, yaml.CollectionEndEvent):
            anchor, before = begun.pop()
            if anchor is not None:
                sizes[anchor] = count - before
        elif isinstance(event, yaml.NodeEvent):
            if isinstance(event, yaml.CollectionStartEvent):
                begun.append((event.anchor, count))
            count += sizes.get(event.anchor, 0) if isinstance(event, yaml.AliasEvent) else 1
        if len(begun) > _DEEPEST or count > _MOST_VALUES:
            raise ValueError(f"more than {_DEEPEST} levels or {_MOST_VALUES} values")


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """The safe loader, which here refuses a field that is given twice instead of taking the last.

    It is the one in C where PyYAML has it: it takes a tenth of the time, for which a swap of models holds a node up.
    """

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        names = Counter(key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode))
        name, count = names.most_common(1)[0] if names else ("", 0)
        if count > 1:
            raise yaml.constructor.ConstructorError(None, None, f"'{name}' is given twice", node.start_mark)
        content: dict[Any, Any] = super().construct_mapping(node, deep)
        return content
