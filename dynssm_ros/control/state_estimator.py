"""The state behind noisy measurements: what the model expected, moved towards what was measured.

For each channel observers with different gains run side by side. The one whose expectations have been closest to the
measurements lately is believed: a gain of one, which is the measurement itself, unless a smaller one is clearly better.
Nobody has to state the noise.

Choosing among steady-state Kalman filters by their innovations is multiple-model estimation (Magill 1965).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dynssm_ros.arrays import Indices, Vector

GAINS = (1.0, 0.6, 0.36, 0.2, 0.1)
_MEMORY_S = 1.0  # over which expectations are compared
_CLEARLY = 0.95  # of the mean square of the measurement's own innovations
_WARM_UP = 10  # measurements before anything is believed but them


class Observers:
    """Estimates of ``n`` channels with several gains side by side. The first gain is preferred.

    Args:
        gains: shares of what was not expected by which the estimates move.
        forget: share by which each squared error replaces the mean of those before.
        clearly: of the first one's mean square, that another must be below to be the best.
        warm_up: measurements before another can be the best.
    """

    def __init__(self, gains: Sequence[float], forget: float, clearly: float, warm_up: int) -> None:
        self.gains = np.array(gains)
        self._forget, self._clearly, self._warm_up = forget, clearly, warm_up

    def reset(self, start: Vector) -> None:
        """Begins anew at ``start`` ``(n,)``."""
        self.states = np.tile(start, (len(self.gains), 1))
        self._squares, self._count = np.zeros_like(self.states), 0

    def correct(self, measured: Vector) -> None:
        """Takes what was measured, ``(n,)``, and by it how well each observer has expected it."""
        innovations = measured - self.states
        self._count += 1
        self._squares += max(self._forget, 1.0 / self._count) * (innovations**2 - self._squares)
        self.states = self.states + self.gains[:, None] * innovations

    @property
    def best(self) -> Indices:
        """Number of the best observer of each channel, ``(n,)``."""
        best = np.argmin(self._squares, axis=0)
        clear = self._squares[best, np.arange(len(best))] < self._clearly * self._squares[0]
        return np.asarray(np.where(clear & (self._count > self._warm_up), best, 0))

    @property
    def estimate(self) -> Vector:
        """That of the best ones, ``(n,)``."""
        return np.asarray(self.states[self.best, np.arange(self.states.shape[1])])


class StateEstimator:
    """Follows channels of which each measurement is noisy, ``T_s`` (s) apart."""

    def __init__(self, T_s: float) -> None:
        self._observers = Observers(GAINS, min(1.0, T_s / _MEMORY_S), _CLEARLY, _WARM_UP)
        self.forget()

    def forget(self) -> None:
        """Begins anew, as after a gap."""
        self._is_known = False

    @property
    def gains(self) -> Vector:
        """The gain of each channel now."""
        return self._observers.gains[self._observers.best]

    def update(self, measured: Vector, moved: Vector | None) -> Vector:
        """The state now. Without a finite measurement it is the measured one, and the observers move on.

        ``moved`` is by how much the model has it changed since the last measurement; without it all begins anew.
        """
        is_sound = bool(np.all(np.isfinite(measured)))
        if moved is None or not self._is_known or not np.all(np.isfinite(moved)):
            self._observers.reset(measured)
            self._is_known = is_sound
            return measured
        self._observers.states += moved
        if not is_sound:
            return measured
        self._observers.correct(measured)
        return np.where(self._observers.best == 0, measured, self._observers.estimate)
