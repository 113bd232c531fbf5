"""The compiled loops of the predictor's step, of plants and of a fit's simulations. Without them numpy computes the same.

``pip`` and ``colcon`` build ``compiled.c`` where a C compiler is, and go on without one where none is. A library of another
version of that file is not used. ``DYNSSM_COMPILED=0`` in the environment switches it off.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
from functools import cached_property
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

LANES = 32
"""Rows that an operation is executed for at once; as in ``compiled.c``."""
_KINDS = {"p": ctypes.c_void_p, "i": ctypes.c_int64, "d": ctypes.c_double}
_FUNCTIONS = {
    "dynssm_over": "ppiiip",
    "dynssm_seen": "ppippp",
    "dynssm_known": "ppp",
    "dynssm_update": "pppp",
    "dynssm_step": "pppppp",
    "dynssm_along": "ppppippppp",
    "dynssm_rollout": "ppippp",
    "dynssm_window": "ppddip",
    "dynssm_simulate": "ppi",
    "dynssm_repeat": "pi",
}
"""The library's functions with their arguments: p a structure or the first number of an array, i a count, d a number."""
_SOURCE = Path(__file__).with_suffix(".c")


def _load() -> ctypes.PyDLL | None:
    if os.environ.get("DYNSSM_COMPILED") == "0":
        return None
    for suffix in EXTENSION_SUFFIXES:
        file = _SOURCE.with_name(f"_compiled{suffix}")
        try:
            library = ctypes.PyDLL(str(file))  # which keeps other threads off the arrays that it works in
            library.dynssm_source.restype = ctypes.c_char_p
            for name, arguments in _FUNCTIONS.items():
                function = getattr(library, name)
                function.argtypes, function.restype = [_KINDS[kind] for kind in arguments], ctypes.c_int64
            if library.dynssm_source().decode() == hashlib.sha256(_SOURCE.read_bytes()).hexdigest():
                return library
        except (OSError, AttributeError):
            continue
    return None


LIBRARY = _load()
"""``None`` where there is none; tests set it to that."""


def address(array: npt.NDArray[Any] | None) -> int | None:
    """Where the numbers of a contiguous array lie."""
    if array is None:
        return None
    buffer: Any = array
    try:
        return ctypes.addressof(ctypes.c_char.from_buffer(buffer))
    except (TypeError, ValueError):  # read-only or empty; this takes four times as long
        place: int = array.__array_interface__["data"][0]
        return place


class Structure(ctypes.Structure):
    """A structure of the library whose arrays live as long as it does."""

    @cached_property
    def address(self) -> int:
        """Where it lies, which the library's functions take."""
        return ctypes.addressof(self)

    def fill(self, **values: Any) -> None:
        """Sets fields: arrays by where they lie, others as they are.

        Raises:
            ValueError: an array is not contiguous.
        """
        kept: list[Any] = self.__dict__.setdefault("kept", [])
        for name, value in values.items():
            if isinstance(value, np.ndarray):
                if not value.flags.c_contiguous:
                    raise ValueError(f"{name}: an array with gaps; expected a contiguous one")
                kept.append(value)
                setattr(self, name, address(value))
            else:
                if isinstance(value, ctypes.Structure):
                    kept.append(value)
                setattr(self, name, value)


def _fields(integers: str = "", arrays: str = "", numbers: str = "") -> list[tuple[str, Any]]:
    kinds = (integers, ctypes.c_int64), (arrays, ctypes.c_void_p), (numbers, ctypes.c_double)
    return [(name, kind) for names, kind in kinds for name in names.split()]


class TapeStructure(Structure):
    """``Tape`` of ``compiled.c``."""

    _fields_ = [
        *_fields("", "code"),
        *_fields("operations", "work outputs"),
        *_fields("count"),
    ]


class CarStructure(Structure):
    """``Car`` of ``compiled.c``."""

    _fields_ = [
        ("step", TapeStructure),
        ("settle", TapeStructure),
        ("carry", TapeStructure),
        *_fields("states", "along"),
    ]


class FeaturesStructure(Structure):
    """``Features`` of ``compiled.c``."""

    _fields_ = [
        ("car", CarStructure),
        *_fields(
            "rows recent input_lags errors network throttles n",
            "places mean std scale input_scale throttle throttle_width moved found",
        ),
    ]


class RolloutStructure(Structure):
    """``Rollout`` of ``compiled.c``."""

    _fields_ = [
        ("features", FeaturesStructure),
        *_fields("steps mean_error judged"),
        *_fields("", "", "far minimum_speed least fading"),
        *_fields("", "moved now constant"),
    ]


class StepStructure(Structure):
    """``Step`` of ``compiled.c``."""

    _fields_ = [("features", FeaturesStructure), *_fields("", "", "minimum_speed least"), *_fields("", "alone")]


class LayerStructure(Structure):
    """``Layer`` of ``compiled.c``."""

    _fields_ = [
        *_fields(
            "n",
            "mean covariance noise physics recent width spread returning widening scale",
            "retained forget recently outlier quantile missed_grows hit_shrinks widest largest smallest_recent "
            "smallest_noise limit",
        ),
    ]


class SimulationStructure(Structure):
    """``Simulation`` of ``compiled.c``."""

    _fields_ = [
        ("settle", TapeStructure),
        ("step", TapeStructure),
        *_fields("signals states parameters", "signal_places settling parameter_places"),
        *_fields("cars windows", "starts"),
        *_fields("begin steps every"),
        *_fields("", "", "taken"),
        *_fields("", "next"),
    ]
