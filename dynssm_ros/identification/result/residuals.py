"""How much of an error is systematic: repeats at the same place lap after lap, or follows from the signals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dynssm_ros.arrays import Indices, Vector
from dynssm_ros.identification.problem.windows import SimulationWindows
from dynssm_ros.signals.signal_map import STATE_SIGNALS

_FOLDS = 10
_PLACES = 20
_RIDGE = 3.0
_ORDERS = 500
_BEYOND_CHANCE = 5.0  # standard deviations; noise alone reached 2.2 in 15 drives
_INFLATED = 4.5  # noise alone reached 1.1 in 15 drives, and 3.9 in 4 where it hung together over a fifth of a second
_SURE = 3.0  # standard errors by which the explanation must be better than none


@dataclass(frozen=True)
class ExplainedVariance:
    """What of the errors at the end of the windows is no noise.

    Attributes:
        share: of the squared error, by channel, that the signals and the place predict where they were not fitted to,
            shape ``(3,)``.
        by_place: the same from the place on the lap alone; NaN without laps, or with those of several roads.
        sure: by how many standard errors the whole is better than no explanation.
        pattern: the signals that the errors go with most, by channel, with their correlation.
        stretch: where on the lap the mean error is farthest from zero, by channel, from and to (m); empty without laps.
    """

    share: Vector
    by_place: Vector
    sure: float
    pattern: dict[str, dict[str, float]]
    stretch: dict[str, tuple[float, float]]

    @property
    def is_there(self) -> bool:
        """Whether there is any beyond chance."""
        return self.sure > _SURE


@dataclass(frozen=True)
class ClusteredResiduals:
    """How errors are spread over time: noise is everywhere alike, a cause that is missing comes and goes.

    Attributes:
        sure: by how many standard deviations the size of the errors differs more between parts of the time than if the
            same errors had come in any order.
        inflation: how many times more the errors of a few seconds pull alike than independent ones would.
        when: the part of the recording with the largest errors (s).
    """

    sure: float
    inflation: float
    when: tuple[float, float]

    @property
    def is_there(self) -> bool:
        """Whether it is beyond chance."""
        return self.sure > _BEYOND_CHANCE or self.inflation > _INFLATED


def clustered(sizes: Vector, time: Vector, block: Indices, inflation: float, seed: int = 0) -> ClusteredResiduals:
    """Looks for errors that come together.

    Args:
        sizes: of the error of each window, squared and in units of the noise, shape ``(W,)``; that of each recording has the
            same mean, for some days' sensors are noisier.
        time: of each window (s), shape ``(W,)``.
        block: number of the block in time of each window, shape ``(W,)``.
        inflation: of the variance of what was fitted, by errors that hang together.
        seed: of the orders that are drawn.
    """
    count = np.bincount(block)

    def uneven(x: Vector) -> float:
        return float((count * (np.bincount(block, x) / count - x.mean()) ** 2).sum())

    rng = np.random.default_rng(seed)
    by_chance = np.array([uneven(rng.permutation(sizes)) for _ in range(_ORDERS)])
    worst = time[block == int(np.argmax(np.bincount(block, sizes) / count))]
    sure = (uneven(sizes) - by_chance.mean()) / max(by_chance.std(), 1e-12)
    return ClusteredResiduals(float(sure), inflation, (float(worst.min()), float(worst.max())))


def explained_variance(windows: SimulationWindows, errors: Vector, block: Indices) -> ExplainedVariance:
    """Explains errors by what was going on and where.

    Args:
        windows: the simulations.
        errors: at their ends, shape ``(W, 3)``.
        block: number of the block in time of each window, shape ``(W,)``; blocks are left out as a whole.
    """
    y = errors / np.maximum(np.sqrt((errors**2).mean(axis=0)), 1e-12)
    y = np.clip(y, -4.0, 4.0)
    signals = _signals(windows)
    X = _features(np.stack(list(signals.values()), axis=1))
    places = _places(windows)
    fold = block * _FOLDS // (block.max() + 1)
    alone = None if places is None else _cross_validated(places, y, fold)
    both = _cross_validated(X if places is None else np.concatenate([X, places], axis=1), y, fold)
    better = ((y**2) - (y - both) ** 2).sum(axis=1)
    sums = np.bincount(block, better)
    sure = float(sums.sum() / max(np.sqrt((sums**2).sum()), 1e-12))
    return ExplainedVariance(
        _share(y, both),
        np.full(3, np.nan) if alone is None else _share(y, alone),
        sure,
        {
            channel: {name: round(value, 2) for name, value in _strongest(signals, y[:, c]).items()}
            for c, channel in enumerate(STATE_SIGNALS)
        },
        {} if places is None else _stretches(windows, places, y),
    )


def _signals(windows: SimulationWindows) -> dict[str, Vector]:
    """What was going on in each window, on average."""
    at = windows.starts[:, None] + np.arange(windows.steps)
    v_x, v_y, omega, r, delta, r_cmd, delta_cmd = windows.data.rows[:, at].mean(axis=2)
    change = windows.data.rows[:, windows.starts + windows.steps] - windows.data.rows[:, windows.starts]
    span = windows.steps * windows.data.T_s
    return {
        "speed": v_x,
        "lateral acceleration": v_x * omega,
        "longitudinal acceleration": change[0] / span,
        "yaw acceleration": change[2] / span,
        "steering": delta + delta_cmd,
        "steering speed": change[4] / span,
        "throttle": r + r_cmd,
        "sideslip": v_y / np.maximum(v_x, 0.1),
        "time": windows.time,
    }


def _features(signals: Vector) -> Vector:
    """The signals and their squares; products of all of them would predict wildly where nothing alike was driven."""
    spread = signals.std(axis=0)
    z = (signals - signals.mean(axis=0)) / np.where(spread > 0, spread, 1.0)
    return np.concatenate([np.ones((len(z), 1)), z, z**2], axis=1)


def _places(windows: SimulationWindows) -> Vector | None:
    if not windows.data.on_one_lap:
        return None
    here = windows.context(windows.steps // 2)
    bin_ = np.minimum((here["s"] / here["lap_length"] * _PLACES).astype(int), _PLACES - 1)
    return np.asarray(np.eye(_PLACES)[bin_])


def _stretches(windows: SimulationWindows, places: Vector, y: Vector) -> dict[str, tuple[float, float]]:
    """The part of the lap, by channel, at which the mean error is farthest from zero in its standard errors."""
    count = np.maximum(places.sum(axis=0), 1.0)[:, None]
    mean = places.T @ y / count
    spread = np.sqrt(np.maximum(places.T @ y**2 / count - mean**2, 1e-12) / count)
    length = float(windows.context(0)["lap_length"][0]) / _PLACES
    worst = np.abs(mean / (spread + 1.0 / np.sqrt(len(y)))).argmax(axis=0)
    return {c: (float(k * length), float((k + 1) * length)) for c, k in zip(STATE_SIGNALS, worst, strict=True)}


def _cross_validated(X: Vector, y: Vector, fold: Indices) -> Vector:
    """What ridge regression on the other parts says of each part."""
    out = np.zeros_like(y)
    for part in np.unique(fold):
        rest = fold != part
        H = X[rest].T @ X[rest] + _RIDGE * np.eye(X.shape[1])
        out[~rest] = X[~rest] @ np.linalg.solve(H, X[rest].T @ y[rest])
    return np.asarray(np.clip(out, -4.0, 4.0))


def _share(y: Vector, predicted: Vector) -> Vector:
    left = ((y - predicted) ** 2).sum(axis=0) / np.maximum((y**2).sum(axis=0), 1e-12)
    return np.asarray(np.maximum(0.0, 1.0 - left))


def _strongest(signals: dict[str, Vector], y: Vector) -> dict[str, float]:
    known = {name: float(np.corrcoef(x, y)[0, 1]) for name, x in signals.items() if x.std() > 0 and y.std() > 0}
    return dict(sorted(known.items(), key=lambda item: -abs(item[1]))[:3])
