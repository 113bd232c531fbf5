"""Reads a MATLAB file in a process of its own: `python -m dynssm_ros.signals.mat_file FILE ARRAYS.npz`.

Its vectors go to the second file, by number, and to standard output their names and what else is in it, or why it cannot be
read.
"""

from __future__ import annotations

import json
import os
import resource
import sys
from pathlib import Path
from typing import Any

import numpy as np

from dynssm_ros.signals.array_files import Arrays, one_line, vectors
from dynssm_ros.signals.recover import largest_unpacked

_OURS = 2 << 30  # bytes of address space for what is imported


def read(path: Path) -> tuple[Arrays, dict[str, str]]:
    """The vectors of a MATLAB file, or of its only struct if it has no others, and what else is in it."""
    from scipy.io import loadmat

    found: dict[str, Any] = {name: value for name, value in loadmat(path).items() if not name.startswith("__")}
    arrays, left_out = vectors(found)
    structs = [
        value for value in found.values() if isinstance(value, np.ndarray) and value.dtype.names and value.size == 1
    ]
    if not arrays and len(structs) == 1:
        struct = structs[0].reshape(-1)[0]
        return vectors({name: struct[name] for name in structs[0].dtype.names})
    return arrays, left_out


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
