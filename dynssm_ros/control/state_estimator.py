"""The state behind noisy measurements: what the model expected, moved towards what was measured.

How far is found from the data. For each channel observers with different gains run side by side, and the one whose
expectations have been closest to the measurements lately is believed: a gain of one, which is the measurement itself, unless
a smaller one is clearly better. So measurements without noise are left as they are, and nobody has to state the noise.

A constant-gain observer is the Kalman filter in its steady state. Choosing among several by their innovations is
multiple-model estimation (Magill 1965).
"""

from __future__ import annotations

import numpy as np

from dynssm_ros.arrays import Vector

GAINS = (1.0, 0.6, 0.36, 0.2, 0.1)
_MEMORY_S = 1.0  # over which expectations are compared
_CLEARLY = 0.95  # of the mean square of the measurement's own innovations
_WARM_UP = 10  # measurements before anything is believed but them


class StateEstimator:
    """Follows channels of which each measurement is noisy.

    Args:
        T_s: time between measurements (s).
    """

    def __init__(self, T_s: float) -> None:
        self._forget = min(1.0, T_s / _MEMORY_S)
        self.forget()

    def forget(self) -> None:
        """Begins anew, as after a gap."""
        self._states: Vector | None = None
        self._squares = np.zeros(0)
        self._count = 0

    @property
    def gains(self) -> Vector:
        """The gain of each channel now."""
        best = np.argmin(self._squares, axis=0)
        clear = self._squares[best, np.arange(len(best))] < _CLEARLY * self._squares[0]
        return np.array(GAINS)[np.where(clear & (self._count > _WARM_UP), best, 0)]

    def update(self, measured: Vector, moved: Vector | None) -> Vector:
        """The state now. Without a finite measurement it is the measured one, and the observers move on.

        Args:
            measured: now, ``(n,)``.
            moved: by how much the model has it changed since the last measurement; ``None``: unknown, so that it begins
                anew.
        """
        sound = bool(np.all(np.isfinite(measured)))
        if moved is None or self._states is None or not np.all(np.isfinite(moved)):
            self.forget()
            self._states = np.tile(measured, (len(GAINS), 1)) if sound else None
            self._squares = np.zeros((len(GAINS), len(measured)))
            return measured
        expected = self._states + moved
        if not sound:
            self._states = expected
            return measured
        innovations = measured - expected
        self._count += 1
        self._squares += max(self._forget, 1.0 / self._count) * (innovations**2 - self._squares)
        self._states = expected + np.array(GAINS)[:, None] * innovations
        rows = [GAINS.index(gain) for gain in self.gains]
        return np.where(np.array(rows) == 0, measured, self._states[rows, np.arange(len(measured))])
