"""Which of several estimates that run side by side has expected the measurements best lately."""

from __future__ import annotations

import numpy as np

from dynssm_ros.arrays import Indices, Vector


class Innovations:
    """Compares estimates by what they expected of each channel before it was measured; the first one is preferred.

    Args:
        forget: share by which each square replaces the mean of those before.
        clearly: of the first one's mean square, that another must be below to be the best.
        warm_up: measurements before another can be the best.
    """

    def __init__(self, forget: float, clearly: float, warm_up: int) -> None:
        self._forget, self._clearly, self._warm_up = forget, clearly, warm_up

    def reset(self, estimates: int, channels: int) -> None:
        """Begins anew."""
        self._squares = np.zeros((estimates, channels))
        self._count = 0

    def update(self, innovations: Vector) -> None:
        """Takes measured less expected of each estimate, ``(estimates, channels)``."""
        self._count += 1
        self._squares += max(self._forget, 1.0 / self._count) * (innovations**2 - self._squares)

    @property
    def best(self) -> Indices:
        """Number of the best estimate of each channel, ``(channels,)``."""
        best = np.argmin(self._squares, axis=0)
        clear = self._squares[best, np.arange(len(best))] < self._clearly * self._squares[0]
        return np.asarray(np.where(clear & (self._count > self._warm_up), best, 0))
