"""How much of an error is systematic: repeats at the same place lap after lap, or follows from the signals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from dynssm_ros.arrays import Indices, Vector, sums_by
from dynssm_ros.identification import tuning
from dynssm_ros.identification.problem.windows import SimulationWindows
from dynssm_ros.signals.signal_map import STATE_SIGNALS


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
        return self.sure > tuning.SURE_STD


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
        return self.sure > tuning.CLUSTERED_STD or self.inflation > tuning.CLUSTERED_INFLATION


class Left(NamedTuple):
    """What a car leaves: what is systematic, and what comes together in time."""

    systematic: ExplainedVariance
    clustered: ClusteredResiduals

    @property
    def is_there(self) -> bool:
        """Whether it is more than noise."""
        return self.systematic.is_there or self.clustered.is_there


def clustered(sizes: Vector, time: Vector, block: Indices, inflation: float) -> ClusteredResiduals:
    """Looks for errors that come together.

    Args:
        sizes: of the error of each window, squared and in units of the noise, shape ``(W,)``; that of each recording has the
            same mean, for some days' sensors are noisier.
        time: of each window (s), shape ``(W,)``.
        block: number of the block in time of each window, shape ``(W,)``.
        inflation: of the variance of what was fitted, by errors that hang together.
    """
    count = np.bincount(block)

    def uneven(x: Vector) -> float:
        return float((count * (np.bincount(block, x) / count - x.mean()) ** 2).sum())

    rng = np.random.default_rng(0)
    by_chance = np.array([uneven(rng.permutation(sizes)) for _ in range(tuning.SHUFFLES)])
    worst = time[block == int(np.argmax(np.bincount(block, sizes) / count))]
    sure = (uneven(sizes) - by_chance.mean()) / max(by_chance.std(), 1e-12)
    return ClusteredResiduals(float(sure), inflation, (float(worst.min()), float(worst.max())))


def lasting(windows: SimulationWindows, errors: Vector) -> Vector:
    """Share of the squared error that a simulation and the next have in common, ``(3,)``: noise is of one alone.

    Args:
        windows: the simulations.
        errors: at their ends, shape ``(W, 3)``.
    """
    y = errors / np.maximum(np.sqrt((errors**2).mean(axis=0)), 1e-12)
    y = np.clip(y, -tuning.FAR_SPREADS, tuning.FAR_SPREADS)
    follows = (np.diff(windows.starts) <= windows.steps) & (np.diff(windows.number) == 0)
    together = (y[:-1] * y[1:])[follows].sum(axis=0) / max(1, int(follows.sum()))
    return np.asarray(np.maximum(together / (y**2).mean(axis=0), 0.0))


def explained_variance(windows: SimulationWindows, errors: Vector, block: Indices) -> ExplainedVariance:
    """Explains errors by what was going on and where.

    Args:
        windows: the simulations.
        errors: at their ends, shape ``(W, 3)``.
        block: number of the block in time of each window, shape ``(W,)``; blocks are left out as a whole.
    """
    y = errors / np.maximum(np.sqrt((errors**2).mean(axis=0)), 1e-12)
    y = np.clip(y, -tuning.FAR_SPREADS, tuning.FAR_SPREADS)
    signals, places = _signals(windows), _places(windows)
    X = _features(np.stack(list(signals.values()), axis=1))
    fold = block * tuning.FOLDS // (block.max() + 1)
    both = _cross_validated(X if places is None else np.concatenate([X, places], axis=1), y, fold)
    sums = sums_by(block, ((y**2) - (y - both) ** 2).sum(axis=1))
    return ExplainedVariance(
        _share(y, both),
        np.full(3, np.nan) if places is None else _share(y, _cross_validated(places, y, fold)),
        float(sums.sum() / max(np.sqrt((sums**2).sum()), 1e-12)),
        {channel: _strongest(signals, y[:, c]) for c, channel in enumerate(STATE_SIGNALS)},
        {} if places is None else _stretches(windows, places, y),
    )


def _signals(windows: SimulationWindows) -> dict[str, Vector]:
    """What was going on in each window, on average."""
    v_x, v_y, omega, r, delta, r_cmd, delta_cmd = windows.driven
    rows, span = windows.data.rows, windows.steps * windows.data.T_s
    change = (rows[:, windows.starts + windows.steps] - rows[:, windows.starts]) / span
    return {
        "speed": v_x,
        "lateral acceleration": v_x * omega,
        "longitudinal acceleration": change[0],
        "yaw acceleration": change[2],
        "steering": delta + delta_cmd,
        "steering speed": change[4],
        "throttle": r + r_cmd,
        "sideslip": v_y / np.maximum(np.abs(v_x), 0.1),
        "time": windows.time,
    }


def _features(signals: Vector) -> Vector:
    """The signals and their squares; products of all of them would predict wildly where nothing alike was driven."""
    spread = signals.std(axis=0)
    z = (signals - signals.mean(axis=0)) / np.where(spread > 0, spread, 1.0)
    return np.concatenate([np.ones((len(z), 1)), z, z**2], axis=1)


def _places(windows: SimulationWindows) -> Vector | None:
    """In which stretch of the lap each window is, as an indicator; ``None``: not known."""
    if not windows.data.on_one_lap:
        return None
    here, count = windows.context(windows.steps // 2), tuning.LAP_STRETCHES
    return np.asarray(np.eye(count)[np.minimum((here["s"] / here["lap_length"] * count).astype(int), count - 1)])


def _stretches(windows: SimulationWindows, places: Vector, y: Vector) -> dict[str, tuple[float, float]]:
    """The part of the lap, by channel, at which the mean error is farthest from zero in its standard errors."""
    count = np.maximum(places.sum(axis=0), 1.0)[:, None]
    mean = places.T @ y / count
    spread = np.sqrt(np.maximum(places.T @ y**2 / count - mean**2, 1e-12) / count)
    length = float(windows.context(0)["lap_length"][0]) / tuning.LAP_STRETCHES
    worst = np.abs(mean / (spread + 1.0 / np.sqrt(len(y)))).argmax(axis=0)
    return {c: (float(k * length), float((k + 1) * length)) for c, k in zip(STATE_SIGNALS, worst, strict=True)}


def _cross_validated(X: Vector, y: Vector, fold: Indices) -> Vector:
    """What ridge regression on the other parts says of each part."""
    out = np.zeros_like(y)
    for part in np.unique(fold):
        rest = fold != part
        H = X[rest].T @ X[rest] + tuning.RIDGE * np.eye(X.shape[1])
        out[~rest] = X[~rest] @ np.linalg.solve(H, X[rest].T @ y[rest])
    return np.asarray(np.clip(out, -tuning.FAR_SPREADS, tuning.FAR_SPREADS))


def _share(y: Vector, predicted: Vector) -> Vector:
    left = ((y - predicted) ** 2).sum(axis=0) / np.maximum((y**2).sum(axis=0), 1e-12)
    return np.asarray(np.maximum(0.0, 1.0 - left))


def _strongest(signals: dict[str, Vector], y: Vector) -> dict[str, float]:
    """The three signals with which an error goes most, with their correlation."""
    known = {name: float(np.corrcoef(x, y)[0, 1]) for name, x in signals.items() if x.std() > 0 and y.std() > 0}
    return {name: round(known[name], 2) for name in sorted(known, key=lambda name: -abs(known[name]))[:3]}
