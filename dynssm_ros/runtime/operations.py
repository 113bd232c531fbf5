"""The number of floating-point operations of a computation in numpy."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from dynssm_ros.arrays import Vector


def count_operations(call: Callable[[Vector], object], argument: Vector) -> int:
    """Floating-point operations of ``call(argument)``, as numpy reports them while it executes them.

    Every sum, product, quotient or elementary function of one element that depends on ``argument`` counts once.
    """
    count = 0

    class Counted(np.ndarray[Any, np.dtype[np.float64]]):
        def __array_ufunc__(self, ufunc: np.ufunc, method: Any, *inputs: Any, **options: Any) -> Any:
            nonlocal count
            plain = [each.view(np.ndarray) if isinstance(each, Counted) else each for each in inputs]
            result = np.asarray(getattr(ufunc, method)(*plain, **options))
            count += result.size if method == "__call__" else plain[0].size  # a reduction visits what it reduces
            return result.view(Counted)

    call(argument.view(Counted))
    return count
