"""Reads a MATLAB file in a process of its own: `python -m dynssm_ros.signals.mat_file FILE ARRAYS.npz`.

Its vectors go to the second file, by number, and to standard output their names and what else is in it, or why it cannot be
read.
"""

from __future__ import annotations

import json
import os
import resource
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from dynssm_ros.signals.array_files import OBJECT, Arrays, one_line, vectors
from dynssm_ros.signals.recover import largest_unpacked

_DEEPEST = 4  # structs in structs
_OURS = 2 << 30  # bytes of address space for what is imported


def read(path: Path) -> tuple[Arrays, dict[str, str]]:
    """The vectors of a MATLAB file, or of its structs and theirs if it has no others, and what else is in it.

    They are named by their fields, with the struct's name in front where several are named alike.
    """
    from scipy.io import loadmat

    found: dict[str, Any] = {name: value for name, value in loadmat(path).items() if not name.startswith("__")}
    arrays, left_out = vectors(found)
    if arrays or not any(map(_is_struct, found.values())):
        return arrays, left_out
    for _ in range(_DEEPEST):
        found = dict(field for item in found.items() for field in _fields(*item))
    leaves = Counter(name.rpartition(".")[2] for name in found)
    return vectors({name if leaves[leaf := name.rpartition(".")[2]] > 1 else leaf: one for name, one in found.items()})


def _is_struct(value: Any) -> bool:
    """Whether it is one struct; an object of MATLAB is none."""
    is_one = isinstance(value, np.ndarray) and value.dtype.names is not None and value.size == 1
    return bool(is_one) and value.dtype.names != OBJECT


def _fields(name: str, value: Any) -> list[tuple[str, Any]]:
    """The fields of a struct by their paths; anything else as it is."""
    if not _is_struct(value):
        return [(name, value)]
    struct = value.reshape(-1)[0]
    return [(f"{name}.{field}", struct[field]) for field in value.dtype.names]


def main() -> None:
    """Reads the file that the first argument names and writes the second."""
    source, target = map(Path, sys.argv[1:3])
    answered = os.dup(1)
    os.dup2(2, 1)  # what libraries print is no answer
    largest = 2 * largest_unpacked(source.stat().st_size) + _OURS
    resource.setrlimit(resource.RLIMIT_AS, (largest, largest))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    answer: Any
    try:
        arrays, left_out = read(source)
        np.savez(target, **{f"{k}": values for k, values in enumerate(arrays.values())})  # type: ignore[arg-type]
        answer = {"names": list(arrays), "left_out": left_out}
    except Exception as error:  # scipy raises what its decoders do
        answer = one_line(error)
    os.write(answered, json.dumps(answer).encode())


if __name__ == "__main__":
    main()
