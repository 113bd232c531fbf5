"""What a strong learner finds in the errors: boosted trees on the window, tested on stretches that they were not fitted to.

The errors of the last steps predict the next one also where only the sensors are noisy: a linear filter takes that away
first. Its weights depend on speed and cornering, as the car's damping does. What the trees find beyond it follows from the
signals.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from dynssm_ros.arrays import Indices, Mask, Vector
from dynssm_ros.evaluation.residuals.errors import OneStepErrors
from dynssm_ros.evaluation.residuals.evidence import chances, robust_std, sums_of_blocks
from dynssm_ros.evaluation.residuals.patterns import Pattern, Picture
from dynssm_ros.signals.signal_map import STATE_SIGNALS

_ROWS = 4
"""Rows of the window that the trees see, one by one; older ones are seen as the change over :data:`_LONG_ROWS`."""
_LONG_ROWS = (12, 25)
_ERRORS = 5  # last errors of each channel
_FOLDS, _STRETCH_S = 3, 9.0  # of neighbouring rows, of which every third is tested; longer than errors remember
_MOST_ROWS = 8_000  # that are fitted: more change the share by less than 1 % and take their time
_TREES: dict[str, Any] = {
    "max_iter": 50,
    "max_leaf_nodes": 15,
    "learning_rate": 0.1,
    "min_samples_leaf": 40,
    "l2_regularization": 1.0,
}
_FAR = 10.0  # robust standard deviations to which what is fitted is limited
_RIDGE = 1e-3
_FASTEST = 2.0  # standard deviations of speed and cornering, beyond which the filter stays as it is: no extrapolation
_LEAST_ROWS, _LEAST_STRETCHES = 1500, 9
_LEAST_SHARE = 0.06
"""Of the squared error, from which on what the trees find is told as a pattern. Where only the sensors were noisy, they found
up to 5.1 % in 100 healthy drives: tyres at their limit pass noise on in ways that this filter does not follow."""


@dataclass(frozen=True)
class LeftToLearn:
    """What can still be learned of the errors of a channel, as shares of its squared error on stretches that were left out.

    Attributes:
        share: by trees on the window and the last errors; at least 0.
        filtered: of that by a linear filter of the last errors alone.
        p: chance that the trees find what they do beyond the filter.
        uses: what share is lost if a signal is shuffled, the most important first.
    """

    share: float
    filtered: float
    p: float
    uses: dict[str, float]

    def to_json(self) -> dict[str, Any]:
        """For ``results.json``."""
        return {
            "share": round(self.share, 4), "by_filter": round(self.filtered, 4), "p": self.p,
            "uses": {name: round(value, 4) for name, value in self.uses.items()},
        }  # fmt: skip


def left_to_learn(errors: OneStepErrors, *, importance: bool = True) -> dict[str, LeftToLearn]:
    """What a strong learner still finds in the errors of each channel; empty for short drives (less than 1500 rows).

    Args:
        errors: of the model.
        importance: whether to ask which signals it uses, which takes as long as half of the fits.
    """
    usable = np.flatnonzero(_has_history(errors))
    stretch = (errors.seconds[usable] / _STRETCH_S).astype(np.intp)
    if len(usable) < _LEAST_ROWS or len(np.unique(stretch)) < _LEAST_STRETCHES:
        return {}
    groups, X = _features(errors, usable)
    fold = stretch % _FOLDS
    edge = np.zeros(len(usable), bool)  # next to another fold: its windows overlap
    change = np.flatnonzero(np.diff(fold)) + 1
    for k in range(-_LONG_ROWS[-1], _LONG_ROWS[-1]):
        edge[np.clip(change + k, 0, len(edge) - 1)] = True
    from threadpoolctl import threadpool_limits

    with threadpool_limits(1):  # so few rows that threads wait for each other: they took half of all processor time
        return {
            channel: _learned(X, groups, errors.values[usable, c], fold, edge, errors.block[usable], importance)
            for c, channel in enumerate(STATE_SIGNALS)
        }


def learner_patterns(found: dict[str, LeftToLearn]) -> list[Pattern]:
    """What the trees find beyond a filter of the last errors."""
    out = []
    for channel, each in found.items():
        uses = [name for name, lost in each.uses.items() if lost > 0.1 * max(each.share - each.filtered, 0)][:3]
        share = max(0.0, each.share - each.filtered)
        if share < _LEAST_SHARE:
            continue
        source = ", ".join(uses) or "the window"
        told = f"{100 * share:.2g} % of the squared error of {channel} can still be learned from {source}"
        lost: Vector = 100 * np.array([*each.uses.values()], dtype=np.float64)
        title = f"% of the squared error of {channel}\nlost without"
        places = np.arange(len(lost), dtype=np.float64)
        picture = Picture("bars", places, lost, "", title, None, tuple(each.uses)) if len(lost) else None
        out.append(Pattern(channel, "learner", "learner", told, share, each.p, 1, {"uses": uses}, None, picture))
    return out


def _has_history(errors: OneStepErrors) -> Mask:
    """Rows before which the same run of rows is long enough."""
    back = max(_LONG_ROWS[-1], _ERRORS)
    first = np.searchsorted(errors.run, errors.run)
    return np.asarray(np.arange(len(errors)) - first >= back)


def _features(errors: OneStepErrors, usable: Indices) -> tuple[dict[str, list[int]], Vector]:
    """What the learner sees: columns by the name of the signal that they come from, and their values ``(M, n)``."""
    log, rows = errors.recording, errors.rows[usable]
    names = {name: log[name] for name in STATE_SIGNALS} | errors.inputs
    columns: list[Vector] = []
    groups: dict[str, list[int]] = {}

    def add(name: str, column: Vector) -> None:
        groups.setdefault(name, []).append(len(columns))
        columns.append(column)

    for name, values in names.items():
        add(name, values[rows])
        for k in range(1, _ROWS):
            add(name, values[rows] - values[rows - k])
        for k in _LONG_ROWS:
            add(name, values[rows] - values[rows - k])
    for c, channel in enumerate(STATE_SIGNALS):
        for k in range(1, _ERRORS + 1):
            add(f"last errors of {channel}", errors.values[usable - k, c])
    return groups, np.stack(columns, axis=1)


def _learned(
    X: Vector, groups: dict[str, list[int]], y: Vector, fold: Indices, edge: Mask, block: Indices, importance: bool
) -> LeftToLearn:  # fmt: skip
    from sklearn.ensemble import HistGradientBoostingRegressor

    centre, spread = float(np.median(y)), robust_std(y)
    aim = np.clip(y, centre - _FAR * spread, centre + _FAR * spread)
    recent = [k for name, group in groups.items() if name.startswith("last") for k in group]
    v_x, omega = (X[:, groups[name][0]] for name in ("v_x", "omega"))
    speed, bend = _usual(v_x), _usual(np.abs(v_x * omega))
    weights = (np.ones(len(y)), speed, speed**2, bend, bend**2, speed * bend)
    past = np.column_stack([np.ones(len(y)), *(X[:, recent] * each[:, None] for each in weights)])
    filtered, boosted = np.zeros_like(y), np.zeros_like(y)
    lost = dict.fromkeys(groups, 0.0)
    rng = np.random.default_rng(0)
    for part in range(_FOLDS):
        tested, rest = fold == part, np.flatnonzero((fold != part) & ~edge)
        filtered[tested] = past[tested] @ _ridge(past[rest], aim[rest])
        rest = rest[:: max(1, len(rest) // _MOST_ROWS)]
        left = aim[rest] - past[rest] @ _ridge(past[rest], aim[rest])
        trees = HistGradientBoostingRegressor(**_TREES, random_state=0).fit(X[rest], left)
        boosted[tested] = trees.predict(X[tested])
        if importance:
            some = np.flatnonzero(tested)
            some = some[:: max(1, len(some) // 1500)]
            target = y[some] - filtered[some]
            base = float(np.sum((target - boosted[some]) ** 2))
            for name, group in groups.items():
                mixed = X[some].copy()
                mixed[:, group] = mixed[rng.permutation(len(some))][:, group]
                lost[name] += (float(np.sum((target - trees.predict(mixed)) ** 2)) - base) / float(
                    np.sum(y[some] ** 2) + 1e-300
                )
    total = float(np.sum(y**2)) + 1e-300
    gain = (y - filtered) ** 2 - (y - filtered - boosted) ** 2
    sums = sums_of_blocks(gain, block)
    return LeftToLearn(
        max(0.0, 1.0 - float(np.sum((y - filtered - boosted) ** 2)) / total),
        max(0.0, 1.0 - float(np.sum((y - filtered) ** 2)) / total),
        float(chances(sums[:, None])[0]) if sums.sum() > 0 else 1.0,
        dict(sorted(((name, value / _FOLDS) for name, value in lost.items()), key=lambda each: -each[1]))
        if importance
        else {},
    )


def _usual(x: Vector) -> Vector:
    """In standard deviations off its mean, as far as a filter may go with it."""
    return np.asarray(np.clip((x - x.mean()) / max(float(x.std()), 1e-300), -_FASTEST, _FASTEST))


def _ridge(X: Vector, y: Vector) -> Vector:
    gram = X.T @ X
    return np.asarray(np.linalg.solve(gram + _RIDGE * np.diag(np.diag(gram) + 1e-300), X.T @ y))
