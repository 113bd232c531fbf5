"""The paper's own numbers (``benchmarks/paper/reference.yaml``), to be set beside what is measured."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from dynssm_ros import configuration


def load_reference() -> dict[str, Any]:
    """The paper's tables as they stand in the file, in SI units; data sets are ``real`` and ``sim``."""
    return configuration.read_yaml(Path(__file__).with_name("reference.yaml"))
