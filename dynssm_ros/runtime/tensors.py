"""Arrays in safetensors files."""

from __future__ import annotations

import json
from collections.abc import Mapping

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


def as_tensors(arrays: Mapping[str, Vector], about: dict[str, str] | None = None) -> bytes:
    """The content of a safetensors file with arrays by name and what they are ``about``.

    The library's own writer would raise another error than :class:`OSError` where the disk is full.
    """
    return save({name: np.asarray(array, order="C") for name, array in arrays.items()}, about)
