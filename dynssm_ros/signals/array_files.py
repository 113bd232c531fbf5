"""Vectors in MATLAB and NumPy files. Nothing in them is unpickled."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from dynssm_ros.errors import BagError
from dynssm_ros.extras import require
from dynssm_ros.signals.recover import largest_unpacked

Arrays = dict[str, npt.NDArray[Any]]
_HDF5 = b"MATLAB 7.3"


def npz_arrays(path: Path) -> tuple[Arrays, dict[str, str]]:
    """The vectors of a ``.npz`` file by name, and what else is in it, with the reason why it is no column.

    Raises:
        BagError: not such a file, damaged, or it would unpack to more than a log can be.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(item.file_size for item in archive.infolist())
        if size > largest_unpacked(path.stat().st_size):
            raise BagError(f"{path}: unpacks to {size >> 20} MB; expected at most 100 times its size")
        found: dict[str, Any] = {}
        with np.load(path, allow_pickle=False) as archive:
            for name in archive.files:
                found[name] = _array(archive, name)
    except BagError:
        raise
    except Exception as error:  # zipfile and numpy raise what their decoders do
        raise BagError(f"{path}: a zip file that cannot be read as NumPy's .npz ({_one_line(error)})") from error
    return _vectors(found)


def _array(archive: Any, name: str) -> Any:
    """A member of an archive; why there is none, where it would have to be unpickled."""
    try:
        return archive[name]
    except ValueError as error:
        return _one_line(error)


def mat_arrays(path: Path) -> tuple[Arrays, dict[str, str]]:
    """The vectors of a MATLAB file up to version 7.2 by name, those of its only struct if it has no others, and what else
    is in it, with the reason why it is no column.

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
    from scipy.io import loadmat, whosmat

    try:
        elements = sum(int(np.prod(shape)) for _, shape, _ in whosmat(path))
        if 8 * elements > largest_unpacked(path.stat().st_size):
            raise BagError(f"{path}: unpacks to {elements >> 17} MB; expected at most 100 times its size")
        found = {name: value for name, value in loadmat(path).items() if not name.startswith("__")}
    except BagError:
        raise
    except Exception as error:  # scipy raises what its decoders do
        raise BagError(f"{path}: cannot be read as a MATLAB file ({_one_line(error)})") from error
    arrays, left_out = _vectors(found)
    structs = [
        name for name, value in found.items() if getattr(value, "dtype", np.dtype("O")).names and value.size == 1
    ]
    if not arrays and len(structs) == 1:
        struct = found[structs[0]].reshape(-1)[0]
        arrays, left_out = _vectors({name: struct[name] for name in struct.dtype.names})
    return arrays, left_out


def _vectors(found: dict[str, Any]) -> tuple[Arrays, dict[str, str]]:
    """What is a vector of more than one number, and why the rest is not; fields of a record array are vectors."""
    arrays: Arrays = {}
    left_out: dict[str, str] = {}
    for name, value in found.items():
        values = np.asarray(value)
        if isinstance(value, str):
            left_out[name] = value
        elif values.dtype.names and values.dtype.names == ("s0", "s1", "s2", "arr"):
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
            left_out[name] = f"a matrix of {' x '.join(map(str, values.shape))}"
        else:
            arrays[name] = values.reshape(-1)
    return arrays, left_out


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
