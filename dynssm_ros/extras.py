"""Optional parts: libraries by extra and how a missing one is reported; modules of the user's own."""

from __future__ import annotations

import os
import sys
from importlib import import_module
from importlib.util import find_spec

from dynssm_ros.errors import ConfigurationError, UserError

EXTRAS: dict[str, tuple[str, ...]] = {
    "train": ("torch", "onnx", "onnxscript", "scipy"),
    "race": ("casadi", "scipy"),
    "report": ("matplotlib", "plotly", "jinja2", "scipy"),
    "matlab": ("scipy",),
    "formula": ("sklearn",),
    "residuals": ("sklearn", "scipy", "threadpoolctl"),
    "scale": ("joblib",),
    "sweep": ("optuna",),
    "ray": ("joblib", "ray"),
    "dask": ("joblib", "dask", "distributed"),
    "ros": ("rclpy",),
}
"""Libraries by extra. The core (`pip install dynssm_ros`) has what extracts, replays and predicts."""


class MissingExtraError(UserError):
    """A library of an extra is not installed."""


def missing_libraries(*extras: str) -> dict[str, str]:
    """Libraries of ``extras`` that are not installed, each with its extra; nothing is imported."""
    return {library: extra for extra in extras for library in EXTRAS[extra] if find_spec(library) is None}


def require(what: str, *extras: str) -> None:
    """Raises a :class:`MissingExtraError` that says what to install where ``what`` needs a missing library of ``extras``."""
    missing = missing_libraries(*extras)
    if missing:
        names = ",".join(sorted(set(missing.values())))
        raise MissingExtraError(f"{what} needs {', '.join(missing)}: pip install 'dynssm_ros[{names}]'")


def load_plugins() -> None:
    """Imports the modules that ``DYNSSM_PLUGINS`` names, apart by commas; they register effects, models or plants.

    They are installed, on ``PYTHONPATH``, or in the current folder; else it is a :class:`ConfigurationError`.
    """
    names = [name.strip() for name in os.environ.get("DYNSSM_PLUGINS", "").split(",") if name.strip()]
    if names and os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # last: it shadows nothing
    name = ""
    try:
        for name in names:
            import_module(name)
    except ImportError as error:
        raise ConfigurationError(f"DYNSSM_PLUGINS: module {name} cannot be imported ({error})") from error
