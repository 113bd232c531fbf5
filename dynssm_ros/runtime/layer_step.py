"""A row of a drive in one compiled call, of a model that is its physics and its online layer."""

from __future__ import annotations

import numpy as np

from dynssm_ros import compiled
from dynssm_ros.arrays import Vector
from dynssm_ros.compiled import address
from dynssm_ros.runtime.contract import WindowPrediction
from dynssm_ros.runtime.features import LayerFeatures
from dynssm_ros.runtime.online import CHANNELS, Learned, OnlineLayer, OnlineState, Seen

_THREES = 6  # what a row has three numbers of, beside features and weights


class LayerStep:
    """What the features, the state and the correction of an online layer do with a row, one after the other.

    Args:
        features: what the layer sees.
        layer: the model's.
        variance: of the physics' errors, ``(3,)``.
        rows: of a window.
    """

    def __init__(self, features: LayerFeatures, layer: OnlineLayer, variance: Vector, rows: int) -> None:
        self._shape = 1, CHANNELS, len(features.names)
        self._size = CHANNELS * len(features.names)
        self._structure: compiled.StepStructure | None = None
        if (seen := features.structure(rows)) is not None:
            self._structure = compiled.StepStructure()
            self._structure.fill(
                features=seen, minimum_speed=layer.minimum_speed, least=layer.least,
                alone=np.maximum(variance, layer.scale**2),
            )  # fmt: skip

    @property
    def is_possible(self) -> bool:
        """Whether there is the library, and the car's equations can be traced."""
        return compiled.LIBRARY is not None and self._structure is not None

    def __call__(
        self, state: OnlineState, window: Vector, last: tuple[Seen, Vector] | None, trusted: bool
    ) -> tuple[WindowPrediction, Learned]:
        """What is predicted from ``window`` ``(H, 7)``, and what is known there.

        Args:
            state: learns the step before, if there is one.
            window: of the row.
            last: what was seen of the row before, and its values ``(7,)``.
            trusted: see :attr:`Learned.trusted`.
        """
        assert compiled.LIBRARY is not None
        assert self._structure is not None
        row, size = np.empty(2 * self._size + _THREES * CHANNELS), self._size
        before = (None, None) if last is None else map(address, last[0])
        taught = compiled.LIBRARY.dynssm_step(
            self._structure.address, state.structure().address, address(window), *before, address(row)
        )
        if last is not None and taught:
            state.taught(last[1], window[-1, :CHANNELS] - window[-2, :CHANNELS])
        physics, stated, limits, following, variance, by_physics = row[2 * size :].reshape(_THREES, 1, CHANNELS)
        seen, theta = Seen(row[:size].reshape(self._shape), physics), state.coefficients.theta[None]
        learned = Learned(row[size : 2 * size].reshape(self._shape), stated, limits, theta, np.array([float(trusted)]))
        return WindowPrediction(following, theta, by_physics, variance, seen), learned
