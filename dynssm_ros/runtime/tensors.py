"""Arrays in the bytes of a safetensors file."""

from __future__ import annotations

import json

from safetensors import SafetensorError
from safetensors.numpy import load

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
