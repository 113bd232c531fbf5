"""Vectors in MATLAB and NumPy files. Nothing in them is unpickled."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from dynssm_ros.errors import BagError
from dynssm_ros.extras import require
from dynssm_ros.signals.recover import largest_unpacked

Arrays = dict[str, npt.NDArray[Any]]
_WIDEST = 64  # vectors of a matrix
OBJECT = ("s0", "s1", "s2", "arr")
"""Fields of what scipy reads of an object of MATLAB."""
_HDF5 = b"MATLAB 7.3"


def npz_arrays(path: Path) -> tuple[Arrays, dict[str, str]]:
    """The vectors of a ``.npz`` file by name, and what else is in it, with the reason why it is no column.

    Raises:
        BagError: not such a file, damaged, or it would unpack to more than a log can be.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(item.file_size for item in archive.infolist())
            names = archive.namelist()
            if "[Content_Types].xml" in names:
                raise BagError(f"{path}: an Excel workbook, which is not read; expected it exported as CSV")
            if names and not any(name.endswith(".npy") for name in names):
                raise BagError(f"{path}: a zip file with {names[0]}, not of NumPy; expected it unpacked")
        if size > largest_unpacked(path.stat().st_size):
            raise BagError(f"{path}: unpacks to {size >> 20} MB; expected at most 100 times its size")
        found: dict[str, Any] = {}
        with np.load(path, allow_pickle=False) as archive:
            for name in archive.files:
                found[name] = _array(archive, name)
    except BagError:
        raise
    except Exception as error:  # zipfile and numpy raise what their decoders do
        raise BagError(f"{path}: a zip file that cannot be read as NumPy's .npz ({one_line(error)})") from error
    return vectors(found)


def _array(archive: Any, name: str) -> Any:
    """A member of an archive; why there is none, where it would have to be unpickled."""
    try:
        return archive[name]
    except ValueError:
        return "Python objects, which are not unpickled"


def npy_arrays(path: Path) -> tuple[Arrays, dict[str, str]]:
    """As :func:`npz_arrays`, of a ``.npy`` file.

    Raises:
        BagError: not such a file, damaged, or of Python objects.
    """
    try:
        return vectors({"array": np.load(path, mmap_mode="r", allow_pickle=False)})
    except Exception as error:  # numpy raises what its decoders do
        raise BagError(f"{path}: cannot be read as NumPy's .npy ({one_line(error)})") from error


def mat_arrays(path: Path) -> tuple[Arrays, dict[str, str]]:
    """As :func:`npz_arrays`, of a MATLAB file up to version 7.2; of its only struct if it has no vectors beside it.

    A process of its own reads it, because a damaged file may end scipy's reader altogether.

    Raises:
        BagError: not such a file, damaged, or of version 7.3.
        MissingExtraError: there is no scipy.
    """
    with path.open("rb") as file:
        if file.read(len(_HDF5)) == _HDF5:
            raise BagError(
                f"{path}: a MATLAB file of version 7.3 (HDF5); expected one saved with save('{path.name}', '-v7')"
            )
    require(f"{path}: a MATLAB file", "matlab")
    with tempfile.TemporaryDirectory(prefix="dynssm-") as folder:
        found = Path(folder) / "arrays.npz"
        command = [sys.executable, "-m", "dynssm_ros.signals.mat_file", os.fspath(path), os.fspath(found)]
        done = subprocess.run(command, capture_output=True, check=False)  # noqa: S603 - a module of ours
        if done.returncode:
            raise BagError(f"{path}: cannot be read as a MATLAB file (its reader ended with status {done.returncode})")
        answer = json.loads(done.stdout)
        if isinstance(answer, str):
            raise BagError(f"{path}: cannot be read as a MATLAB file ({answer})")
        with np.load(found, allow_pickle=False) as archive:
            return {name: archive[f"{k}"] for k, name in enumerate(answer["names"])}, answer["left_out"]


def vectors(found: dict[str, Any]) -> tuple[Arrays, dict[str, str]]:
    """What is a vector of more than one number, and why the rest is not.

    Fields of a record array are vectors, and so are rows or columns of a matrix that are as long as all vectors, or as all
    matrices where there is no vector.
    """
    arrays: Arrays = {}
    left_out: dict[str, str] = {}
    matrices: Arrays = {}
    for name, value in found.items():
        values = np.asarray(value)
        if isinstance(value, str):
            left_out[name] = value[:80]
        elif values.dtype.names and values.dtype.names == OBJECT:
            left_out[name] = "an object of MATLAB, such as a table; save it as s = table2struct(T, 'ToScalar', true)"
        elif values.dtype.names and values.dtype.kind == "V" and values.size > 1 and values.dtype.hasobject is False:
            arrays |= {
                field: values[field].reshape(-1) for field in values.dtype.names if values[field].size == values.size
            }
        elif values.dtype.kind not in "biufMmSU":
            left_out[name] = f"no vector of numbers ({values.dtype})"
        elif values.size < 2:
            left_out[name] = "a single value"
        elif values.size != max(values.shape):
            matrices[name] = values
        else:
            arrays[name] = values.reshape(-1)
    lengths = {len(values) for values in arrays.values()} or {max(values.shape) for values in matrices.values()}
    length = lengths.pop() if len(lengths) == 1 else -1
    for name, values in matrices.items():
        if values.ndim == 2 and length in values.shape and values.size <= length * _WIDEST:
            rows = values if values.shape[1] == length else values.T
            arrays |= {f"{name}[{k}]": row for k, row in enumerate(rows)}
        else:
            left_out[name] = f"a matrix of {' x '.join(map(str, values.shape))}"
    return arrays, left_out


def one_line(error: BaseException) -> str:
    """The text of an error on one line, or its kind where it has none."""
    return " ".join(str(error).split()) or type(error).__name__
