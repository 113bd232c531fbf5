"""Which of several predictions has lately been nearer to what was measured than a reference."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from dynssm_ros.arrays import Vector

REMEMBERED_PATHS = 20
"""Paths that the mean is of, about."""
_LARGEST = 2.0  # a single path's logarithm counts as at most that
_NEAREST_M = 1e-9  # distances below it count as that large


class RunningComparison:
    """Running mean of the logarithm of a reference's distance from the measured path over that of each prediction.

    It is positive for a prediction that is nearer than the reference.

    Args:
        predictions: how many are compared.
    """

    def __init__(self, predictions: int) -> None:
        self.advantage = np.zeros(predictions)
        """The means, ``(predictions,)``."""
        self.paths = 0
        """Paths that were compared."""

    def add(self, reference: float, distances: Vector | Sequence[float]) -> None:
        """Takes the distances (m) of one path; NaN counts as infinite. Without a finite reference it says nothing."""
        if not math.isfinite(reference):
            return
        each = np.maximum(np.nan_to_num(distances, nan=math.inf, posinf=math.inf), _NEAREST_M)
        ratios = np.clip(math.log(max(reference, _NEAREST_M)) - np.log(each), -_LARGEST, _LARGEST)
        self.paths += 1
        self.advantage = self.advantage + (ratios - self.advantage) / min(self.paths, REMEMBERED_PATHS)
