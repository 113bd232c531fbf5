"""Array types of the whole package, named once."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Vector = npt.NDArray[np.float64]
"""Real numbers in double precision; docstrings say the shape."""
Indices = npt.NDArray[np.intp]
"""Row numbers."""
Mask = npt.NDArray[np.bool_]
"""Which rows or entries are meant."""
