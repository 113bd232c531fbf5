"""Optional parts of the installation: which library belongs to which extra, and how a missing one is reported."""

from __future__ import annotations

from importlib.util import find_spec

from dynssm_ros.errors import UserError

EXTRAS: dict[str, tuple[str, ...]] = {
    "train": ("torch", "onnx", "onnxscript", "scipy"),
    "race": ("casadi", "scipy"),
    "report": ("matplotlib", "jinja2", "scipy"),
    "ros": ("rclpy",),
}
"""Libraries by extra. The core (`pip install dynssm_ros`) has what extracts, replays and predicts."""


class MissingExtraError(UserError):
    """A library of an extra is not installed."""


def require(what: str, *extras: str) -> None:
    """Checks that the libraries of ``extras`` are installed, without importing them.

    Args:
        what: needs them, for the message.
        extras: names out of :data:`EXTRAS`.

    Raises:
        MissingExtraError: one is not; names the extra and how to install it.
    """
    missing = {library: extra for extra in extras for library in EXTRAS[extra] if find_spec(library) is None}
    if missing:
        names = ",".join(sorted(set(missing.values())))
        raise MissingExtraError(f"{what} needs {', '.join(missing)}: pip install 'dynssm_ros[{names}]'")
