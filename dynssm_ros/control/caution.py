"""Margins that grow along the horizon with what the model has mispredicted lately: tightened constraints.

A bound is moved inwards by a multiple of the standard deviation of what it bounds: the deviation, step by step, between
what the last horizons predicted and what came (:mod:`dynssm_ros.control.evidence`).

Hewing, Kabzan, Zeilinger, "Cautious model predictive control using Gaussian process regression", 2019.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dynssm_ros.arrays import Indices, Vector

QUANTILE = 2.0
"""Standard deviations by which a bound is moved: it holds in 98 % of the horizons, before the next plan corrects it."""
_REMEMBERED = 20  # horizons that the deviations are of


class Margins(NamedTuple):
    """By how much bounds are moved inwards after each step of a horizon."""

    lateral: Vector  # distance from the borders (m), (N,)
    slip: Vector  # angles of front and rear axle (rad), (N, 2)

    @classmethod
    def none(cls, N: int) -> Margins:
        """Bounds where they are."""
        return cls(np.zeros(N), np.zeros((N, 2)))


class Caution:
    """Mean squared errors of ``sources`` predictions side by side, for each of the ``N`` steps of the horizon."""

    def __init__(self, sources: int, N: int) -> None:
        self._squares = np.zeros((sources, N, 3))
        self._count = np.zeros((sources, N, 1))

    def forget(self) -> None:
        """Begins anew."""
        self._squares[:] = self._count[:] = 0.0

    def update(self, source: Indices, step: Indices, lateral: Vector, slip: Vector) -> None:
        """Takes the errors of ``n`` predictions, all of shape ``(n,)`` but ``slip``.

        Args:
            source: which predicted.
            step: of its horizon, 0 the first; no pair of both twice.
            lateral: beside the measured path (m).
            slip: of the slip angles of front and rear axle (rad), ``(n, 2)``.
        """
        errors = np.column_stack([lateral, slip])
        sound = np.all(np.isfinite(errors), axis=1)
        at = source[sound], step[sound]
        self._count[at] += 1
        self._squares[at] += (errors[sound] ** 2 - self._squares[at]) / np.minimum(self._count[at], _REMEMBERED)

    def margins(self, weights: Vector) -> Margins:
        """For a mixture of the predictions with ``weights`` ``(sources,)``."""
        deviations = QUANTILE * np.sqrt(np.tensordot(weights, self._squares, 1))
        return Margins(deviations[:, 0], deviations[:, 1:])
