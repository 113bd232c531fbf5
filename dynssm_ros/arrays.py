"""Array types and formulas of the whole package, named once."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Vector = npt.NDArray[np.float64]
"""Real numbers in double precision; docstrings say the shape."""
Indices = npt.NDArray[np.intp]
"""Row numbers."""
Mask = npt.NDArray[np.bool_]
"""Which of them."""


def sums_by(number: Indices, values: Vector) -> Vector:
    """Sums of the rows of ``values`` with the same number, in the order of the numbers that there are."""
    kinds, row = np.unique(number, return_inverse=True)
    out = np.zeros((len(kinds), *values.shape[1:]))
    np.add.at(out, row, values)
    return out


def normal_equations(J: Any, r: Any, precision: Any) -> tuple[Any, Any]:
    """``J^T J + precision`` and ``J^T r``: the equations of a maximum a posteriori estimate, after Gauss and Newton.

    Calibration, diagnosis and the estimation within a model's window solve them, in numpy and in torch.

    Args:
        J: derivatives of the residuals in units of their standard deviation, ``(..., n, K)``.
        r: residuals in the same units, ``(n,)`` or ``(..., n, 1)``.
        precision: inverse covariance of the prior, ``(K, K)``.
    """
    transposed = J.swapaxes(-1, -2)
    return transposed @ J + precision, transposed @ r
