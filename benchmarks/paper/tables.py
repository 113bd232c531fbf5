"""The tables of the document: the paper's numbers beside the measured ones."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks.paper.plan import MID_RANGE
from benchmarks.paper.results import Comparison, Entry, Results, by_name
from dynssm_ros.evaluation.coefficients import coefficient_unit
from dynssm_ros.evaluation.spread import SeedSpread, spreads
from dynssm_ros.reporting.evaluation_figures import UNITS
from dynssm_ros.reporting.tables import Column, Table, Value, text
from dynssm_ros.runtime.baselines import SingleTrack
from dynssm_ros.signals.signal_map import STATE_SIGNALS
from dynssm_ros.vehicle import COEFFICIENTS

TITLES = {"v_x": "v_x", "v_y": "v_y", "omega": "ω"}
_PHYSICS_ONLY = {
    MID_RANGE: "physics only, θ_0 in the middle of the bounds",
    SingleTrack.name: "physics only, calibrated",
}
_THEIR_PHYSICS_ONLY = "single_track"  # in the reference; its coefficients are nominal, not calibrated
_ERRORS = ("ADE", "FDE")


def published_table(comparisons: Sequence[Comparison], reference: Mapping[str, Entry]) -> Table:
    """The paper's open-loop table, and the same models measured on each study that has them."""
    columns = (
        Column("model"),
        Column("test"),
        *(Column(f"{TITLES[channel]} {what}", UNITS[channel]) for channel in STATE_SIGNALS for what in ("RMSE", "max")),
        *(Column(name, "m") for name in _ERRORS),
    )
    rows: list[list[Value]] = []
    for name, row in reference.items():
        pairs = [row[what][channel] for channel in STATE_SIGNALS for what in ("rmse", "max_error")]
        rows.append([f"{name}, the paper's", "the paper's", *pairs, row["ade"], row["fde"]])
    for comparison in (each for each in comparisons if each.car.ddm in each.models):
        car = comparison.car
        for model in comparison.those(car.ddm, car.fthd, car.paper, car.full):
            errors = zip(comparison.rmse(model), comparison.max_error(model), strict=True)
            spreads = [*(each for pair in errors for each in pair), *comparison.displacement(model)]
            rows.append([f"`{model}`", comparison.label, *(each.mean for each in spreads)])
    return Table(columns, rows)


def reduction_table(comparisons: Sequence[Comparison], reference: Entry, data: str) -> Table:
    """How much lower the errors are than DDM's, in percent; above 0 is better."""
    columns = (
        Column("model"),
        Column("test"),
        *(Column(TITLES[channel], "%") for channel in STATE_SIGNALS),
        *(Column(name, "%") for name in _ERRORS),
    )
    own, base = (
        [*by_name(row["rmse"]), row["ade"], row["fde"]]
        for row in map(reference["open_loop"][data].get, ("DynSSM", "DDM"))
    )
    rows: list[list[Value]] = [["DynSSM, the paper's table", "the paper's", *_reductions(own, base)]]
    if data == "real":
        claims = 100 * by_name(reference["claims"]["rmse"])
        rows.append(["DynSSM, the paper's abstract: up to, over DDM or FTHD", "the paper's", *claims, None, None])
    for comparison in (each for each in comparisons if each.car.ddm in each.models):
        base = _errors(comparison, comparison.car.ddm)
        rows += [
            [f"`{model}`", comparison.label, *_reductions(_errors(comparison, model), base)]
            for model in comparison.those(comparison.car.paper, comparison.car.full)
        ]
    return Table(columns, rows)


def _errors(comparison: Comparison, model: str) -> list[float]:
    return [each.mean for each in (*comparison.rmse(model), *comparison.displacement(model))]


def _reductions(own: Sequence[float], base: Sequence[float]) -> Iterator[float]:
    """By how much errors are lower than others, in percent."""
    for ours, theirs in zip(own, base, strict=True):
        yield 100 * (1 - (ours / theirs if theirs else math.inf))


def error_table(comparison: Comparison) -> Table:
    """One-step RMSE and displacement of all models of a study but the ablations, all tests taken together."""
    columns = (
        Column("model"),
        *(Column(TITLES[channel], UNITS[channel], "RMSE", "min") for channel in STATE_SIGNALS),
        *(Column(name, "m", "", "min") for name in _ERRORS),
    )
    rows: list[list[Value]] = [
        [f"`{model}`", *comparison.rmse(model), *comparison.displacement(model)] for model in comparison.compared
    ]
    rows_scored = sum(comparison.test(test)["rows"] for test in comparison.tests)
    together = " on all tests together" if len(comparison.tests) > 1 else ""
    horizon = " or ".join(dict.fromkeys(f"{comparison.test(test)['horizon_s']:g} s" for test in comparison.tests))
    return Table(
        columns, rows, f"Errors{together}: {rows_scored:,} one-step predictions of each model, rollouts over {horizon}. "
        f"{_seeds(comparison)}"
    )  # fmt: skip


def paper_model_table(comparison: Comparison) -> Table | None:
    """The paper's model beside DDM and FTHD and what is wanted of it; ``None`` if a study does not compare them."""
    car = comparison.car
    rivals = comparison.those(car.ddm, car.fthd)
    if not (rivals and comparison.those(car.paper)):
        return None
    paper, wanted = str(car.paper), {str(error): value for error, value in comparison.study.wanted.items()}
    columns = [Column(f"error of `{paper}`"), Column("mean"), *([Column("wanted at most")] if wanted else [])]
    columns += [*(Column(f"over that of `{rival}`") for rival in rivals), Column("reached")]
    rows: list[list[Value]] = []
    theirs = [_errors(comparison, rival) for rival in rivals]
    for k, (error, own) in enumerate(zip((*STATE_SIGNALS, *_ERRORS), _errors(comparison, paper), strict=True)):
        over = [own / each[k] for each in theirs]
        lacks = ["what is wanted"] if own > wanted.get(error, math.inf) else []
        lacks += [f"`{rival}`" for rival, ratio in zip(rivals, over, strict=True) if not ratio < 1.0]
        row: list[Value] = [TITLES.get(error, error), own, *([wanted.get(error)] if wanted else []), *over]
        rows.append([*row, f"no: {', '.join(lacks)}" if lacks else "yes"])
    return Table(tuple(columns), rows, "Reached: below what is wanted, where that is stated, and below DDM and FTHD.")


def relative_table(comparison: Comparison) -> Table:
    """One-step RMSE as a multiple of persistence's, test by test."""
    columns = (
        Column("model"),
        *(Column(TITLES[channel], "", f"{test}:", "min") for test in comparison.tests for channel in STATE_SIGNALS),
    )
    rows: list[list[Value]] = [
        [f"`{model}`", *(float(v) for test in comparison.tests for v in comparison.relative(model, test))]
        for model in comparison.compared
    ]
    return Table(columns, rows, "One-step RMSE over that of persistence; above 1 is worse than no model at all.")


def ablation_table(comparison: Comparison, results: Results, base: str) -> Table:
    """A model and its ablations: errors and what they cost; the paper's numbers beside those of its own model."""
    paper = results.reference["ablation"].get(comparison.car.reference, {}) if base == comparison.car.paper else {}
    shown = [Column(TITLES[channel], UNITS[channel], "", "min") for channel in STATE_SIGNALS]
    shown += [Column("parameters"), Column("FLOPs"), Column("latency p50", "µs")]
    columns = [Column("variant")]
    for column in shown:
        columns += [column, *([Column(f"{column.title}, the paper's", column.unit)] if paper else [])]
    variants = {model: model for model in comparison.those(*_PHYSICS_ONLY)}
    variants |= comparison.ablations(base) | {"full": base}
    names = _PHYSICS_ONLY | {"full": "full model"} | comparison.variants(base)
    rows: list[list[Value]] = []
    for lacking, model in variants.items():
        theirs = (
            None if lacking == SingleTrack.name else paper.get(_THEIR_PHYSICS_ONLY if lacking == MID_RANGE else lacking)
        )
        cost = results.costs.get(SingleTrack.name if model == MID_RANGE else model)
        own: list[Value] = list(comparison.rmse(model))
        own += [cost["parameters"], cost["flops"], cost["latency_us"]["p50"]] if cost else [None] * 3
        published = [*by_name(theirs["rmse"]), *_cost(theirs)] if theirs else [None] * 6
        pairs = [[mine, other] if paper else [mine] for mine, other in zip(own, published, strict=True)]
        rows.append([names[lacking], *(value for pair in pairs for value in pair)])
    return Table(tuple(columns), rows, f"{better_ablations(comparison, base)} {_seeds(comparison)}")


def _cost(row: Entry) -> list[Value]:
    """What the paper says of a model's cost: parameters, FLOPs, latency in microseconds."""
    return [row["parameters"], row["flops"], 1e6 * row["latency"]]


def better_ablations(comparison: Comparison, base: str) -> str:
    """Says which ablations beat the model itself by more than the spread of both over the seeds.

    A variant that was trained once is taken to vary as the full model does.
    """
    full = comparison.rmse(base)
    if comparison.seeds(base) < 2:
        return "The full model was trained once, so the spread over seeds is not known."
    found = []
    for lacking, model in comparison.ablations(base).items():
        once = comparison.seeds(model) < 2
        for channel, own, whole in zip(STATE_SIGNALS, comparison.rmse(model), full, strict=True):
            if whole.mean - own.mean > math.hypot(whole.std if once else own.std, whole.std):
                percent = text(100 * (1 - own.mean / whole.mean))
                found.append(f"{comparison.variants(base)[lacking]} in {TITLES[channel]} by {percent} %")
    if not found:
        return "No ablation is better than the full model beyond the spread over seeds."
    return f"Better than the full model beyond the spread over seeds: {', '.join(found)}."


def rate_table(results: Results) -> Table:
    """The learning rates that were tried: what the validation windows of the training part say."""
    columns = (
        Column("model"), Column("trained on"), Column("learning rate"), Column("validation loss"),
        Column("over that of the mean change"), Column("best epoch"), Column("chosen"),
    )  # fmt: skip
    rows: list[list[Value]] = []
    for name, tried in results.rates.items():
        sweep = results.plan.sweeps[name]
        chosen = getattr(results.plan.configured(sweep.model).training, "learning_rate", None)
        for rate, trainings in tried.items():
            losses = [np.array([min(validation_loss(t), default=np.nan), t["unexplained"]]) for t in trainings]
            epochs = ", ".join(str(t["best_epoch"]) for t in trainings)
            shown = [f"`{sweep.model}`", sweep.split, f"{rate:g}"]
            rows.append([*shown, *spreads(losses), epochs, "yes" if rate == chosen else ""])
    return Table(
        columns, rows, "Without restarts; one training each, or several where one would mislead: then ± is the standard "
        "deviation over seeds. The loss is the mean squared error in m/s, m/s and rad/s; over that of predicting the mean "
        "change, 1 is a training that has learned nothing."
    )  # fmt: skip


def search_table(results: Results) -> Table:
    """The settings that were tried: what the validation windows of the training part say."""
    columns = (
        Column("model"), Column("trained on"), Column("instead of its own"), Column("validation loss"),
        *(Column(TITLES[channel], UNITS[channel], "RMSE") for channel in STATE_SIGNALS), Column("best epoch"),
    )  # fmt: skip
    rows: list[list[Value]] = []
    for name, tried in results.tries.items():
        search = results.plan.searches[name]
        for attempt, trainings in tried.items():
            losses = [
                np.array([min(validation_loss(t), default=np.nan), *by_name(t["validation_rmse"])]) for t in trainings
            ]
            other = ", ".join(settings(search.tries[attempt])) if attempt else "–"
            epochs = ", ".join(str(t["best_epoch"]) for t in trainings)
            rows.append([f"`{search.model}`", search.split, other, *spreads(losses), epochs])
    return Table(
        columns, rows, "Each row differs from the first in the settings that it names. Loss and RMSE are those of the "
        "validation windows, one step ahead; ± is the standard deviation over seeds, where there are several."
    )  # fmt: skip


def settings(change: Mapping[str, Any], block: str = "") -> Iterator[str]:
    """The fields of a change of a model file, as ``block.field value``."""
    for name, value in change.items():
        if isinstance(value, Mapping):
            yield from settings(value, f"{block}{name}.")
        else:
            yield f"{block}{name} {f'{value:g}' if isinstance(value, float) else value}"


def validation_loss(metrics: Entry) -> list[float]:
    """Over the epochs of a training."""
    found: list[float] = metrics["history"].get("validation/prediction", [])
    return found


def coefficient_table(comparison: Comparison, results: Results) -> Table | None:
    """The adapted coefficients against their bounds; ``None`` if no model adapts any."""
    paper = results.reference["coefficients"].get(comparison.car.reference, {})
    models = comparison.those(comparison.car.paper, comparison.car.full)
    statistics = {model: found for model in models if (found := _coefficients(comparison.entries(model)))}
    if not statistics:
        return None
    columns = [Column("coefficient"), *([Column("bounds, the paper's"), Column("the paper's")] if paper else [])]
    for model in statistics:
        columns += [Column("bounds", "", f"`{model}`"), Column("adapted"), Column("at a bound", "%")]
    rows: list[list[Value]] = []
    for name in COEFFICIENTS:
        unit = coefficient_unit(name)
        theirs = paper.get(name)
        row: list[Value] = [f"{name} ({unit})" if unit else name]
        if paper:
            row += [_range(*theirs["bounds"]), _plus_minus(theirs["mean"], theirs["std"])] if theirs else ["–", "–"]
        for found in statistics.values():
            bounds, mean, std, at_bound = found[name]
            row += [_range(*bounds), _plus_minus(mean, std), 100 * at_bound]
        rows.append(row)
    kept = "".join(f" `{model}` keeps its own constant." for model in models if model not in statistics)
    return Table(tuple(columns), rows, f"Mean ± standard deviation over the predictions; {comparison.label}.{kept}")


def coverage_table(comparisons: Sequence[Comparison]) -> Table:
    """How often the error lies inside the model's own 90 % interval."""
    columns = (Column("test"), Column("model"), *(Column(TITLES[channel], "%") for channel in STATE_SIGNALS))
    rows: list[list[Value]] = []
    for comparison in comparisons:
        for model in comparison.those(comparison.car.paper, comparison.car.full):
            if (covered := comparison.coverage(model)) is not None:
                shares = [SeedSpread(100 * s.mean, 100 * s.std, s.n) for s in covered]
                rows.append([comparison.label, f"`{model}`", *shares])
    return Table(columns, rows)


def cost_table(results: Results) -> Table:
    """Size, operations and time of all models but the ablations, side by side, and the paper's."""
    columns = (
        Column("model"), Column("parameters"), Column("FLOPs"), Column("latency p50", "µs"), Column("p99", "µs"),
        Column("physics step"),
    )  # fmt: skip
    ablations = {each for c in results.comparisons for base in c.bases for each in c.ablations(base).values()}
    rows: list[list[Value]] = [
        [f"{name}, {'AV-21' if data == 'real' else 'ORCA'}, the paper's", *_cost(row), None, "–"]
        for data, models in results.reference["open_loop"].items()
        for name, row in models.items()
    ]
    for name, cost in results.costs.items():
        if name not in ablations:
            latency = cost["latency_us"]
            # how the physics of a trained model is integrated
            times = f", {cost['substeps']} times" if cost["integrator"] and cost["substeps"] > 1 else ""
            step = f"{cost['integrator'] or '–'}{times}"
            rows.append([f"`{name}`", cost["parameters"], cost["flops"], latency["p50"], latency["p99"], step])
    return Table(columns, rows)


def _coefficients(entries: Sequence[Entry]) -> dict[str, tuple[Sequence[float], float, float, float]]:
    """Bounds, mean, standard deviation and share at a bound over all entries; empty if they have none."""
    each = [entry["coefficients"] for entry in entries]
    if any(found is None for found in each):
        return {}
    statistics = {}
    for name in COEFFICIENTS:
        mean, std, at_bound = (np.array([found[name][key] for found in each]) for key in ("mean", "std", "at_bound"))
        spread = math.sqrt(float((std**2).mean() + mean.var()))  # within the entries and between them
        statistics[name] = (each[0][name]["bounds"], float(mean.mean()), spread, float(at_bound.mean()))
    return statistics


def _seeds(comparison: Comparison) -> str:
    most = max(map(comparison.seeds, comparison.models), default=1)
    if most < 2:
        return "One seed each."
    return f"± is the standard deviation over {most} seeds; models without it were trained once."


def _range(lower: float, upper: float) -> str:
    return f"{lower:g} … {upper:g}"


def _plus_minus(mean: float, std: float) -> str:
    return f"{text(mean)} ± {text(std)}"
