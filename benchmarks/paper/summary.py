"""The first half page of the results: what helps, by how much, and where a rival wins. All of it is computed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from benchmarks.paper.plan import AS_THEY_ARE
from benchmarks.paper.results import Comparison, Results
from dynssm_ros.reporting.tables import Column, Table, Value

_WITHOUT_A_NETWORK = ("ridge", "rls", "gp", "on_track")
_ALIKE = 0.02  # errors that differ by less are called equal
EXACT = 1e-5  # of the error of persistence: below are roundings in single precision
_ERRORS = ("one step", "path")


def summary(results: Results) -> dict[str, Any] | None:
    """Table and lines of the half page; ``None`` if nothing was measured."""
    measured = [c for c in results.comparisons if c.car.full in c.models and _simple(c, results)]
    if not measured:
        return None
    lines = [*_wins(measured, results), *_networks(results), *_parts(measured)]
    return {"table": _table(measured, results).markdown(), "lines": lines}


def errors(comparison: Comparison, model: str) -> dict[str, float]:
    """One number for all states one step ahead, and the ADE (m); roundings are as large as these may be."""
    own = _errors(comparison, model)
    if "persistence" not in comparison.models:
        return own
    least = _errors(comparison, "persistence")
    return {error: float(np.maximum(own[error], EXACT * least[error])) for error in _ERRORS}


def _errors(comparison: Comparison, model: str) -> dict[str, float]:
    rmse = np.array([each.mean for each in comparison.rmse(model)])
    with np.errstate(divide="ignore", invalid="ignore"):
        step = float(np.exp(np.log(rmse).mean()))
    return dict(zip(_ERRORS, (step, comparison.displacement(model)[0].mean), strict=True))


def _simple(comparison: Comparison, results: Results) -> list[str]:
    """Its models without a network."""
    models = results.plan.models
    closed = [m for m in comparison.compared if m in models and results.plan.configured(m).kind in _WITHOUT_A_NETWORK]
    return [*(m for m in comparison.compared if m in AS_THEY_ARE), *closed]


def _published(comparison: Comparison, results: Results) -> list[str]:
    """Its models that were published, the paper's among them."""
    return [m for m in comparison.compared if m not in _simple(comparison, results) and m != comparison.car.full]


def _best(comparison: Comparison, models: Sequence[str], error: str) -> str | None:
    found = {model: errors(comparison, model)[error] for model in models}
    finite = {model: value for model, value in found.items() if np.isfinite(value)}
    return min(finite, key=lambda model: finite[model]) if finite else None


def _table(measured: Sequence[Comparison], results: Results) -> Table:
    kinds = {"simple": _simple, "published": _published}
    columns = [Column("study"), Column("data")]
    for kind in kinds:
        for error in _ERRORS:
            columns += [Column(f"best {kind}, {error}"), Column("ours over it")]
    rows: list[list[Value]] = []
    for comparison in measured:
        own = errors(comparison, comparison.car.full)
        row: list[Value] = [comparison.label, comparison.study.data]
        for models in kinds.values():
            for error in _ERRORS:
                best = _best(comparison, models(comparison, results), error)
                over = None if best is None else own[error] / errors(comparison, best)[error]
                row += ["–" if best is None else f"`{best}`", over]
        rows.append(row)
    return Table(tuple(columns), rows)


def _wins(measured: Sequence[Comparison], results: Results) -> Iterator[str]:
    """Where a rival is ahead, by more than what is called equal."""
    ahead = []
    for comparison in measured:
        own = errors(comparison, comparison.car.full)
        rivals = [*_simple(comparison, results), *_published(comparison, results)]
        for error in _ERRORS:
            best = _best(comparison, rivals, error)
            if best and own[error] > (1 + _ALIKE) * errors(comparison, best)[error]:
                share = 100 * (own[error] / errors(comparison, best)[error] - 1)
                ahead.append(f"{comparison.label}, {error}: `{best}`, our errors are {share:.0f} % larger")
    equal = f"by more than {100 * _ALIKE:g} %"
    yield f"A rival wins {equal} in: {'; '.join(ahead)}." if ahead else f"No rival wins {equal} in any study."


def _networks(results: Results) -> Iterator[str]:
    """Whether the networks earned their place."""
    if results.networks:
        each = ", ".join(f"{kept} of {n} (`{model}`)" for model, (kept, n) in results.networks.items())
        yield (
            "Ours is the calibrated car with an online layer, and with a network if that takes errors off left-out parts of "
            f"the training's laps. It did in {each} trainings. Without it ours is as good as `rls`, which has the same layer."
        )


def _parts(measured: Sequence[Comparison]) -> Iterator[str]:
    """What each part of the models is worth: by how much errors grow without it."""
    for comparison in measured:
        for base in comparison.bases:
            own, words = errors(comparison, base), []
            for lacking, model in comparison.ablations(base).items():
                without = errors(comparison, model)
                changes = ", ".join(f"{100 * (without[error] / own[error] - 1):+.0f} % {error}" for error in _ERRORS)
                words.append(f"{comparison.variants(base)[lacking]} {changes}")
            yield f"`{base}` on {comparison.label}, errors without its parts: {'; '.join(words)}."
