"""Arrays in safetensors files."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load, save

from dynssm_ros.arrays import Vector
from dynssm_ros.errors import ArtifactError


def read_tensors(data: bytes, refusal: str) -> tuple[dict[str, Vector], dict[str, str]]:
    """The arrays of a safetensors file by name, and what it says of itself.

    Args:
        data: content of the file.
        refusal: what the error begins with, naming the file.

    Raises:
        ArtifactError: it is none.
    """
    try:
        arrays = load(data)  # which checks the header too
        about = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")]).get("__metadata__") or {}
    except (SafetensorError, ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise ArtifactError(f"{refusal} ({error})") from error
    return arrays, about


def write_tensors(path: Path, arrays: Mapping[str, Vector], about: dict[str, str] | None = None) -> None:
    """Writes arrays by name, and what they are ``about``, to a safetensors file.

    Raises:
        OSError: cannot be written; the library's own writer raises another error where the disk is full.
    """
    path.write_bytes(save({name: np.asarray(array, order="C") for name, array in arrays.items()}, about))
