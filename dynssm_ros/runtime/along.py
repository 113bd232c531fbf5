"""An online layer along a recording: what it knew at each row."""

from __future__ import annotations

import numpy as np

from dynssm_ros import compiled
from dynssm_ros.arrays import Indices, Vector
from dynssm_ros.runtime.online import Learned, OnlineLayer, Seen


class Along:
    """An online layer that learns along a recording, block of rows after block."""

    def __init__(self, layer: OnlineLayer) -> None:
        self._state = layer.start()
        self._last: tuple[int, Seen, Vector, Vector] | None = None

    def over(self, seen: Seen, rows: Vector, increments: Vector, ends: Indices) -> Learned:
        """Learns the next block, row after row; returns what was known at each.

        Args:
            seen: of the windows that end at ``ends``.
            rows: those rows, ``(N, 7)``.
            increments: measured from them to the next (m/s, m/s, rad/s), ``(N, 3)``.
            ends: row numbers, ascending. The layer learns a step once the row after it is one of them.
        """
        if compiled.LIBRARY is not None and len(ends):
            return self._over_compiled(seen, rows, increments, ends)
        state = self._state
        one = state.learned(np.zeros_like(state.mean))
        known = Learned(*(np.empty((len(ends), *part.shape[1:])) for part in one))
        for k, row in enumerate(ends.tolist()):
            if self._last is not None and self._last[0] == row - 1:
                state.update(*self._last[1:])
            else:
                state.interrupt()
            self._last = row, Seen(seen.features[k].copy(), seen.physics[k]), rows[k], increments[k]
            for column, now in zip(known, state.learned(seen.features[k]), strict=True):
                column[k] = now[0]
        return known

    def _over_compiled(self, seen: Seen, rows: Vector, increments: Vector, ends: Indices) -> Learned:
        """:meth:`over` by the compiled loop, but for the coefficients."""
        state, count = self._state, len(ends)
        if self._last is not None and self._last[0] == ends[0] - 1:
            state.update(*self._last[1:])
        else:
            state.interrupt()
        follows = np.diff(ends, prepend=ends[0]) == 1
        weights, stated, limits, taught = state.along(seen, increments, follows)
        theta = np.empty((count, len(state.coefficients.nominal)))
        for k, (following, useful) in enumerate(zip(follows.tolist(), taught.tolist(), strict=True)):
            if useful:
                state.coefficients.step(rows[k - 1], increments[k - 1])
            elif k and not following:
                state.interrupt()
            theta[k] = state.coefficients.theta
        self._last = int(ends[-1]), Seen(seen.features[-1].copy(), seen.physics[-1]), rows[-1], increments[-1]
        return Learned(weights, stated, limits, theta, np.ones(count))
