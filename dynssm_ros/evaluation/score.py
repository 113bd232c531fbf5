"""What a model is worth on a recording, and what it is worth when it was trained with several seeds."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean, stdev
from typing import Any

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.evaluation.coefficients import CoefficientStatistics
from dynssm_ros.evaluation.metrics import by_channel, finite
from dynssm_ros.evaluation.regimes import Regime
from dynssm_ros.evaluation.rollout import Rollout
from dynssm_ros.evaluation.spread import SeedSpread, mean_and_std, spreads
from dynssm_ros.runtime.contract import WindowModel
from dynssm_ros.runtime.online import Learned
from dynssm_ros.signals.signal_map import STATE_SIGNALS

_WITH_STD = ("rmse", "max_error", "ade", "fde", "coverage_90", "explained")  # what is stated with its spread over seeds


@dataclass(frozen=True)
class Score:
    """What one model is worth on a recording.

    Attributes:
        model: what was scored.
        known: what its online layer knew where the rollouts start that are drawn; ``None`` without one.
        state: its one-step predictions of the rows after the scored ones, shape ``(N, 3)``.
        theta: its coefficients in every so-many-th row (``Evaluation.every``), shape ``(M, 17)``; ``None`` if it has none.
        rmse: one-step root mean square error by channel, shape ``(3,)`` (m/s, m/s, rad/s); so are the next two.
        max_error: largest absolute one-step error.
        explained: share of the measured increments that it predicts; 0 for persistence, 1 for a perfect model.
        coverage_90: share of errors inside the model's own 90 % interval; ``None`` if it states no variances.
        regime_rmse: RMSE in each driving regime, shape ``(R, 3)``.
        coefficients: statistics of the coefficients that it adapts; ``None`` if it adapts none.
        rollout: errors over the horizon.
        latency_us: wall-clock samples of single predictions (us).
    """

    model: WindowModel
    known: Learned | None
    state: Vector
    theta: Vector | None
    rmse: Vector
    max_error: Vector
    explained: Vector
    coverage_90: Vector | None
    regime_rmse: Vector
    coefficients: CoefficientStatistics | None
    rollout: Rollout
    latency_us: Vector

    @property
    def seed(self) -> int | None:
        """Seed of the training; ``None`` for models without training."""
        return None if self.model.card is None else self.model.card.training.get("seed")

    @property
    def latency(self) -> list[float]:
        """Median and 99th percentile of the time of a prediction (us)."""
        return [float(value) for value in np.percentile(self.latency_us, [50, 99])]

    def to_json(self, regimes: Sequence[Regime]) -> dict[str, Any]:
        """The entry of one model in ``results.json``, by the regimes of :attr:`regime_rmse`; not finite is ``None``."""
        by_quantity: dict[str, dict[str, Any]] = {}
        for regime, values in zip(regimes, self.regime_rmse, strict=True):
            entry = {"rows": regime.rows, "rmse": by_channel(values)}
            by_quantity.setdefault(regime.quantity, {})[regime.name] = entry
        return {
            "rmse": by_channel(self.rmse),
            "max_error": by_channel(self.max_error),
            "ade": finite(self.rollout.ade),
            "fde": finite(self.rollout.fde),
            "parameters": self.model.parameters,
            "flops": self.model.flops,
            "latency_us": dict(zip(("p50", "p99"), map(finite, self.latency), strict=True)),
            "coverage_90": None if self.coverage_90 is None else by_channel(self.coverage_90),
            "explained": by_channel(self.explained),
            "regimes": by_quantity,
            "coefficients": None if self.coefficients is None else self.coefficients.to_json(),
            "rollout": {
                "time_s": [finite(t) for t in self.rollout.time],
                "rmse": {name: [finite(v) for v in self.rollout.rmse[:, k]] for k, name in enumerate(STATE_SIGNALS)},
                "displacement": [finite(v) for v in self.rollout.displacement],
            },
        }


@dataclass(frozen=True)
class Group:
    """The scores of one model, one for each seed that it was trained with; a row of the tables."""

    name: str
    scores: tuple[Score, ...]

    @property
    def first(self) -> Score:
        """The score whose predictions stand for all where only one can be drawn."""
        return self.scores[0]

    @property
    def seeds(self) -> list[int]:
        """Seeds of the trainings; empty for models without training."""
        return [score.seed for score in self.scores if score.seed is not None]

    def mean(self, measure: Callable[[Score], Vector]) -> Vector:
        """Mean of ``measure`` over the seeds."""
        return mean_and_std([measure(score) for score in self.scores])[0]

    def std(self, measure: Callable[[Score], Vector]) -> Vector:
        """Standard deviation of ``measure`` over the seeds."""
        return mean_and_std([measure(score) for score in self.scores])[1]

    def spreads(self, measure: Callable[[Score], Vector | Sequence[float]]) -> list[SeedSpread]:
        """Mean and standard deviation of each entry of ``measure`` over the seeds."""
        return spreads([np.asarray(measure(score), dtype=np.float64) for score in self.scores])

    def to_json(self, regimes: Sequence[Regime]) -> dict[str, Any]:
        """The entry of one model: means over the seeds and, if there are several, their standard deviations."""
        entries = [score.to_json(regimes) for score in self.scores]
        measures = [{key: entry[key] for key in _WITH_STD} for entry in entries]
        several = len(entries) > 1
        return {**_merged(entries, _mean), "seeds": self.seeds, "std": _merged(measures, stdev) if several else None}


def grouped(scores: Mapping[str, Score]) -> dict[str, Group]:
    """Joins scores of the same model that was trained with several seeds, by its name; all others stay alone, by label.

    Models are the same if their cards have the same name and architecture. Where two of them share a seed too, nothing
    tells which is meant, so all of that name keep their own labels.
    """
    groups = {}
    for label, score in scores.items():
        siblings = [other for other in scores.values() if other.model.name == score.model.name]
        joined = len(siblings) > 1 and _differ_by_seed_only(siblings)
        name = score.model.name if joined else label
        groups[name] = Group(name, tuple(siblings) if joined else (score,))
    return groups


def _differ_by_seed_only(scores: Sequence[Score]) -> bool:
    recipes = [None if score.model.card is None else _without_seeds(score.model.card.architecture) for score in scores]
    same = recipes[0] is not None and all(recipe == recipes[0] for recipe in recipes)
    return same and len({score.seed for score in scores}) == len(scores)


def _without_seeds(tree: Any) -> Any:
    """A configuration less its seeds, also those of a model that it starts from."""
    if isinstance(tree, dict):
        return {key: _without_seeds(value) for key, value in tree.items() if key != "seed"}
    return tree


def _mean(values: Sequence[float]) -> float:
    return values[0] if len(set(values)) == 1 else fmean(values)


def _merged(trees: Sequence[Any], reduce: Callable[[Sequence[float]], float]) -> Any:
    """One JSON tree from several of the same form: ``reduce`` of the numbers at each place, ``None`` if any is."""
    first = trees[0]
    if any(tree is None for tree in trees):
        return None
    if isinstance(first, dict):
        return {key: _merged([tree[key] for tree in trees], reduce) for key in first}
    if isinstance(first, list):
        return [_merged(entries, reduce) for entries in zip(*trees, strict=True)]
    return first if isinstance(first, str) else reduce(trees)
