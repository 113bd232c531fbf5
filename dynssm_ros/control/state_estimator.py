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
from dynssm_ros.control.innovations import Innovations

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
        self._innovations = Innovations(min(1.0, T_s / _MEMORY_S), _CLEARLY, _WARM_UP)
        self.forget()

    def forget(self) -> None:
        """Begins anew, as after a gap."""
        self._states: Vector | None = None

    @property
    def gains(self) -> Vector:
        """The gain of each channel now."""
        return np.array(GAINS)[self._innovations.best]

    def update(self, measured: Vector, moved: Vector | None) -> Vector:
        """The state now. Without a finite measurement it is the measured one, and the observers move on.

        Args:
            measured: now, ``(n,)``.
            moved: by how much the model has it changed since the last measurement; ``None``: unknown, so that it begins
                anew.
        """
        sound = bool(np.all(np.isfinite(measured)))
        if moved is None or self._states is None or not np.all(np.isfinite(moved)):
            self._states = np.tile(measured, (len(GAINS), 1)) if sound else None
            self._innovations.reset(len(GAINS), len(measured))
            return measured
        expected = self._states + moved
        if not sound:
            self._states = expected
            return measured
        innovations = measured - expected
        self._innovations.update(innovations)
        self._states = expected + np.array(GAINS)[:, None] * innovations
        best = self._innovations.best
        return np.where(best == 0, measured, self._states[best, np.arange(len(measured))])
