"""A missing term as a formula: sparse regression over signals, kept where it carries over to parts that were left out.

Where a car leaves errors that no effect of the library explains, the acceleration that it lacks is regressed on products of
signals, a few at a time (Brunton, Proctor and Kutz 2016; of a model's discrepancy: Kaheman et al. 2019). Terms are chosen one
by one by orthogonal matching pursuit (Pati, Rezaiifar and Krishnaprasad 1993), by scikit-learn (extra ``formula``). A
formula that takes no more than a smooth curve over one signal does is none: its products stand for the curve.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from dynssm_ros.arrays import Indices, Vector, sums_by
from dynssm_ros.identification import tuning
from dynssm_ros.identification.problem.car import CarEstimate
from dynssm_ros.identification.problem.recordings import CrossValidation
from dynssm_ros.identification.problem.windows import SimulationWindows
from dynssm_ros.identification.search.confirmation import standard_error
from dynssm_ros.signals.signal_map import STATE_SIGNALS

_SIGNALS = ("v_x", "v_y", "omega", "throttle", "steering", "t")


@dataclass(frozen=True)
class Formula:
    """A term that the equations of a car lack.

    Attributes:
        channel: of whose derivative it is a part, one of ``STATE_SIGNALS``.
        terms: coefficients by product of signals, in SI units.
        share: of the squared error of parts that were left out, that it takes.
        improvement: by part, what it takes of the squared error there, in units of its variance, ``(U,)``.
        std: standard error of the sum of :attr:`improvement`, from stretches of a simulation of the fit.
        curve_share: the same as :attr:`share` of the best smooth curve over one signal.
    """

    channel: str
    terms: dict[str, float]
    share: float
    improvement: Vector
    std: float
    curve_share: float

    @property
    def holds(self) -> bool:
        """Whether it carries over to what it was not fitted to: surely, and more than a curve over one signal."""
        total = float(self.improvement.sum())
        return total > max(tuning.SURE_STD * self.std, standard_error(self.improvement)) and self.share > max(
            tuning.NEGLIGIBLE_SHARE, self.curve_share
        )


class _Missing(NamedTuple):
    """What a car lacks in short simulations from measured states."""

    signals: Vector
    """Means of :data:`_SIGNALS`, ``(M, 6)``."""
    acceleration: Vector
    """Measured less simulated, ``(M, 3)`` (m/s^2, m/s^2, rad/s^2)."""
    fold: Indices
    """Part of the drive that is left out together, ``(M,)``."""
    block: Indices
    """Stretch of the simulations of the fit, within which errors hang together, ``(M,)``."""


def formulas(windows: SimulationWindows, car: CarEstimate, left_out: CrossValidation) -> tuple[Formula, ...]:
    """The terms, one for each channel at most, that a car lacks and that carry over.

    Args:
        windows: simulations of the fit.
        car: as fitted, with its causes.
        left_out: how these windows are left out.
    """
    missing = _missing(windows, car, left_out)
    found = (_formula(missing, channel) for channel in range(len(STATE_SIGNALS)))
    return tuple(formula for formula in found if formula is not None and formula.holds)


def _missing(windows: SimulationWindows, car: CarEstimate, left_out: CrossValidation) -> _Missing:
    """Short simulations, end to end within those of the fit, that start at measured rows.

    The signals are of rows before the start and after the end, whose noise is not that of the two.
    """
    T_s = windows.data.T_s
    steps = max(1, min(round(tuning.FORMULA_SPAN_S / T_s), windows.steps))
    shifts = np.arange(0, windows.steps - steps + 1, steps)
    starts = (windows.starts[:, None] + shifts).ravel()
    short = replace(windows, starts=starts, steps=steps, warm=windows.warm, every=steps, filtered=False)
    acceleration = -short.errors(car)[:, 0] / (steps * T_s)
    width = max(1, round(tuning.FORMULA_BESIDE_S / T_s))
    rows, last = windows.data.rows, windows.data.rows.shape[1] - 1
    beside = np.concatenate([np.arange(-width, 0), np.arange(steps + 1, steps + width + 1)])
    states = rows[:3, np.clip(starts[:, None] + beside, 0, last)].mean(axis=2)
    inputs = (rows[3:5] + rows[5:7])[:, starts[:, None] + np.arange(steps)].mean(axis=2)
    signals = np.stack([*states, *inputs, windows.data.context["t"][starts]], axis=1)
    unit = np.unique(left_out.recordings.unit, return_inverse=True)[1]
    fold, block = (np.repeat(number, len(shifts)) for number in (unit, np.arange(len(windows))))
    return _Missing(signals, acceleration, fold, block)


def _formula(missing: _Missing, channel: int) -> Formula | None:
    """The terms of a channel, chosen anew without each part to say how much they take there; then the fewest of them."""
    y = missing.acceleration[:, channel]
    spread = float(np.sqrt(np.mean(np.clip(y, *np.quantile(y, [0.01, 0.99])) ** 2)))
    if spread == 0.0:
        return None
    y = np.clip(y / spread, -tuning.FAR_SPREADS, tuning.FAR_SPREADS)
    names, X = _library(missing.signals)
    scale = np.sqrt((X**2).mean(axis=0))
    kept = np.flatnonzero(scale > 0)
    names, X, scale = [names[k] for k in kept], X[:, kept] / scale[kept], scale[kept]

    def better(path: Callable[[Vector, Vector], Vector]) -> Vector:
        """By how much each squared error is less with a path of coefficients that its part did not see, ``(n, M)``."""
        predicted = np.empty((tuning.FORMULA_TERMS, len(y)))
        for part in np.unique(missing.fold):
            rest = missing.fold != part
            predicted[:, ~rest] = np.clip(X[~rest] @ path(X[rest], y[rest]), -tuning.FAR_SPREADS, tuning.FAR_SPREADS).T
        return np.asarray(y**2 - (y - predicted) ** 2)

    better_by = better(_pursued)
    best = int(np.argmax(better_by.sum(axis=1)))
    found = _pursued(X, y)
    order = sorted(np.flatnonzero(found[:, best]).tolist(), key=lambda k: int(np.argmax(found[k] != 0.0)))
    same = better(lambda X, y: _fitted(X, y, order))
    more = same[len(order) - 1] - same[: len(order)]
    few = next(n for n, each in enumerate(more) if each.sum() <= standard_error(sums_by(missing.block, each)))
    coefficients = spread * _fitted(X, y, order)[:, few] / scale
    improvement = sums_by(missing.fold, better_by[best])
    return Formula(
        STATE_SIGNALS[channel],
        {names[k]: float(coefficients[k]) for k in order[: few + 1]},
        float(improvement.sum() / (y**2).sum()),
        improvement,
        standard_error(sums_by(missing.block, better_by[best])),
        max(_curve_share(signal, y, missing.fold) for signal in missing.signals.T),
    )


def _curve_share(signal: Vector, y: Vector, fold: Indices) -> float:
    """Share of the squared ``y`` ``(M,)`` of parts left out that a piecewise linear curve over a ``signal`` takes."""
    knots = np.unique(np.quantile(signal, np.linspace(0.0, 1.0, tuning.CURVE_KNOTS)))
    if len(knots) < 2:
        return 0.0
    at = np.clip(np.interp(signal, knots, np.arange(len(knots))), 0.0, len(knots) - 1.0)
    hats = np.maximum(0.0, 1.0 - np.abs(at[:, None] - np.arange(len(knots))))
    left = np.empty_like(y)
    for part in np.unique(fold):
        rest = fold != part
        H = hats[rest].T @ hats[rest] + np.eye(len(knots))  # as if each knot had one row more, at zero
        left[~rest] = y[~rest] - hats[~rest] @ np.linalg.solve(H, hats[rest].T @ y[rest])
    return 1.0 - float((left**2).sum() / (y**2).sum())


def _fitted(X: Vector, y: Vector, order: Sequence[int]) -> Vector:
    """Coefficients ``(P, n)`` by least squares of the first of some terms, of the first two, and so on."""
    path = np.zeros((X.shape[1], tuning.FORMULA_TERMS))
    for n in range(tuning.FORMULA_TERMS):
        some = order[: n + 1]
        path[some, n] = np.linalg.lstsq(X[:, some], y, rcond=None)[0]
    return path


def _library(signals: Vector) -> tuple[list[str], Vector]:
    """Products of up to three signals, time once at most: names, and values ``(M, P)``."""
    from sklearn.preprocessing import PolynomialFeatures

    products = PolynomialFeatures(tuning.FORMULA_DEGREE).fit(signals)
    # of what changes over the drive a trend is all that carries over
    kept = products.powers_[:, _SIGNALS.index("t")] <= 1
    return list(products.get_feature_names_out(_SIGNALS)[kept]), np.asarray(products.transform(signals))[:, kept]


def _pursued(X: Vector, y: Vector) -> Vector:
    """Coefficients ``(P, n)`` with one term, with two, and so on."""
    from sklearn.linear_model import orthogonal_mp

    path = orthogonal_mp(X, y, n_nonzero_coefs=tuning.FORMULA_TERMS, return_path=True)
    return np.asarray(path).reshape(X.shape[1], -1)
