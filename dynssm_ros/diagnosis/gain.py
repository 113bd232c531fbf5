"""What an extended car gains on laps that neither the fit nor the selection saw."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dynssm_ros.diagnosis.car import Car
from dynssm_ros.diagnosis.study import BLOCK
from dynssm_ros.diagnosis.windows import Windows

Vector = npt.NDArray[np.float64]

_DRAWS = 400


@dataclass(frozen=True)
class Gain:
    """Errors of several cars on the held-out rows.

    Attributes:
        horizons: times ahead (s), shape ``(n,)``.
        rmse: root mean square error at these times by car, each ``(n, 3)`` (m/s, m/s, rad/s).
        interval: 95 % interval of the reduction of the error from the first car to the last, shape ``(2, n, 3)``.
        time: of the starts (s), shape ``(W,)``.
        errors: at the horizon that the diagnosis is about, by car, each ``(W, 3)``.
        horizon: that horizon's number.
        windows: the simulations.
    """

    horizons: Vector
    rmse: Mapping[str, Vector]
    interval: Vector
    time: Vector
    errors: Mapping[str, Vector]
    horizon: int
    windows: Windows

    @property
    def reduction(self) -> Vector:
        """Share of the first car's error that is gone with the last, shape ``(n, 3)``."""
        cars = list(self.rmse.values())
        reduced: Vector = 1.0 - cars[-1] / np.maximum(cars[0], 1e-300)
        return reduced


def measure(windows: Windows, cars: Mapping[str, Car], steps: int, seed: int = 0) -> Gain:
    """Simulates ``cars`` from every start.

    Args:
        windows: on held-out rows.
        cars: by name, what was first and what is last.
        steps: of the horizon that the diagnosis is about.
        seed: of the bootstrap over blocks in time.
    """
    ahead = sorted({1, steps, windows.steps})
    at = np.array(ahead) - 1
    errors = {name: windows.errors(car)[:, at] for name, car in cars.items()}
    first, last = next(iter(errors.values())), list(errors.values())[-1]
    block = np.unique((windows.time // BLOCK).astype(int), return_inverse=True)[1]
    sums = [_block_sums(e**2, block) for e in (first, last)]
    rng = np.random.default_rng(seed)
    drawn = rng.integers(0, len(sums[0]), (_DRAWS, len(sums[0])))
    ratios = np.sqrt(sums[1][drawn].sum(axis=1) / np.maximum(sums[0][drawn].sum(axis=1), 1e-300))
    return Gain(
        np.array(ahead) * windows.data.T_s,
        {name: np.sqrt((e**2).mean(axis=0)) for name, e in errors.items()},
        1.0 - np.quantile(ratios, [0.975, 0.025], axis=0),
        windows.time,
        {name: e[:, ahead.index(steps)] for name, e in errors.items()},
        ahead.index(steps),
        windows,
    )


def _block_sums(values: Vector, block: npt.NDArray[np.intp]) -> Vector:
    out = np.zeros((block.max() + 1, *values.shape[1:]))
    np.add.at(out, block, values)
    return out
