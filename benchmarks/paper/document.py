"""The document: a pure function of the results, and the figures that it shows."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from benchmarks.page import render, save_figure
from benchmarks.paper import figures, tables
from benchmarks.paper.plan import MID_RANGE, Plan
from benchmarks.paper.reference import suspects
from benchmarks.paper.results import Comparison, Results
from benchmarks.paper.stale import signed
from benchmarks.paper.summary import EXACT, summary
from dynssm_ros.arrays import Vector
from dynssm_ros.files import replacing
from dynssm_ros.reporting.evaluation_figures import loss_components
from dynssm_ros.reporting.evaluation_report import COMMANDS_IN_WORDS

_CARS = {"real": "Full-size car", "sim": "Small car", "other": "1:10 car"}


def write(results: Results, path: Path) -> None:
    """Writes the document to ``path``, and its figures beside it."""
    pictures = {
        name: save_figure(figure, path.with_name(f"{path.stem}_{name}.png"), tight=True)
        for name, figure in draw(results)
    }
    write_signed(markdown(results, pictures), results.plan, path)


def write_signed(text: str, plan: Plan, path: Path) -> None:
    """Writes a page with the fingerprint of its plan."""
    with replacing(path) as aside:
        aside.write_text(signed(text, plan), encoding="utf-8")


def draw(results: Results) -> Iterator[tuple[str, Figure]]:
    """The figures by name; against persistence of the full-size car alone: the small one's errors differ by too much."""
    comparisons = _comparable(results, "real")
    relative: dict[str, dict[str, Vector]] = {}
    for c in comparisons:
        for model in (each for each in c.compared if each != "persistence"):
            found = {test: c.relative(model, test) for test in c.tests}
            relative[model] = found | relative.get(model, {})  # where studies share a test, the first one's
    if relative:
        yield "persistence", figures.against_persistence(relative)
    for c in results.comparisons:
        for base in c.bases:
            variants = c.variants(base)
            ablations = {variants[lacking]: c.rmse(model) for lacking, model in c.ablations(base).items()}
            yield f"ablations_{c.name}_{base}", figures.against_the_full_model(c.rmse(base), ablations)
    for model, training in results.losses.items():
        yield f"losses_{model}", loss_components(training["history"], training["best_epoch"])
    if tried := {results.plan.sweeps[name].model: rates for name, rates in results.rates.items() if rates}:
        yield "rates", figures.learning_rates(tried)


def markdown(results: Results, pictures: Mapping[str, str]) -> str:
    """The document; ``pictures``: addresses of the figures by their names."""
    models = results.plan.models
    planned = {comparison.car.reference for comparison in results.comparisons}
    coverage = tables.coverage_table([comparison for comparison in results.comparisons if comparison.tests])
    used = dict.fromkeys(study.commands for study in results.plan.studies.values())
    return render(
        "results",
        cars=[_car(results, data, title, pictures) for data, title in _CARS.items() if data in planned],
        commands={name: COMMANDS_IN_WORDS[name].partition(": ")[2] for name in used},
        costs=tables.cost_table(results).markdown() if results.costs else "",
        coverage=coverage.markdown() if coverage.rows else "",
        exact=EXACT,
        pictures={"rates": ""} | dict(pictures),
        plan=results.plan,
        rates=tables.rate_table(results).markdown() if any(results.rates.values()) else "",
        horizons={_CARS[car.reference].lower(): f"{car.horizon:g} s" for car in results.plan.cars.values()},
        mid_range=MID_RANGE,
        results=results,
        searches=tables.search_table(results).markdown() if any(results.tries.values()) else "",
        suspects=[*suspects(results.reference), *_below_persistence(results)],
        shipped={name: model.base for name, model in models.items() if model.base and model.base not in models},
        short=summary(results),
    )


def _below_persistence(results: Results) -> Iterator[str]:
    """Errors of the paper's model that are above those of persistence on recordings of a full-size car that the user gave."""
    paper = results.reference["open_loop"]["real"]["DynSSM"]["rmse"]
    for comparison in (each for each in _comparable(results, "real") if each.study.given):
        for test in comparison.tests:
            least = comparison.test(test)["persistence_rmse"]
            worse = [
                f"{channel} ({least[channel]:.3g}, {paper[channel]:.3g})"
                for channel in paper
                if paper[channel] > least[channel]
            ]
            if worse:
                yield (
                    f"DynSSM, full-size car: on {test} ({comparison.label}) predicting that nothing changes has lower errors "
                    f"than the paper's model in {', '.join(worse)}"
                )


def _car(results: Results, data: str, title: str, pictures: Mapping[str, str]) -> dict[str, Any]:
    """What the page says of the cars that are comparable with the paper's data set ``data``."""
    comparisons = _comparable(results, data)
    by_name = {comparison.name: comparison for comparison in comparisons}
    cars = [car for car in results.plan.cars.values() if car.reference == data]
    wanted = dict.fromkeys(car.coefficients for car in cars)
    coefficients = (tables.coefficient_table(by_name[name], results) for name in wanted if name in by_name)
    reference = results.reference["open_loop"].get(data)
    losses = dict.fromkeys(f"losses_{car.paper}" for car in cars)
    return {
        "title": title,
        "lacking": list(_lacking(results, data)),
        "published": comparisons and reference and {
            "table": tables.published_table(comparisons, reference).markdown(),
            "reductions": tables.reduction_table(comparisons, results.reference, data).markdown(),
        },
        "persistence": pictures.get("persistence") if data == "real" else None,
        "studies": [_study(comparison, results, pictures) for comparison in comparisons],
        "coefficients": [table.markdown() for table in coefficients if table is not None],
        "losses": [pictures[name] for name in losses if name in pictures],
    }  # fmt: skip


def _lacking(results: Results, data: str) -> Iterator[dict[str, str]]:
    """Each study that lacks something, and what."""
    for comparison in (each for each in results.comparisons if each.car.reference == data):
        words = "measured in part" if comparison.tests else "not measured"
        if not comparison.planned:
            given = f". {comparison.study.given.rstrip('.')}" if comparison.study.given else ""
            yield {
                "label": comparison.label, "words": f"{words}, no recording was given with `test=NAME=R.parquet`{given}"
            }  # fmt: skip
        elif comparison.reasons:
            yield {"label": comparison.label, "words": f"{words}; {'; '.join(dict.fromkeys(comparison.reasons))}"}


def _study(comparison: Comparison, results: Results, pictures: Mapping[str, str]) -> dict[str, Any]:
    study = comparison.study
    bases = [
        {
            "name": base,
            "table": tables.ablation_table(comparison, results, base).markdown(),
            "picture": pictures.get(f"ablations_{comparison.name}_{base}"),
        }
        for base in comparison.bases
    ]
    paper_model = tables.paper_model_table(comparison)
    return study.model_dump() | {
        "paper_model": paper_model.markdown() if paper_model else "",
        "title": f"{study.title[0].upper()}{study.title[1:]}",
        "errors": tables.error_table(comparison).markdown(),
        "relative": tables.relative_table(comparison).markdown(),
        "bases": bases,
    }


def _comparable(results: Results, data: str) -> list[Comparison]:
    """The studies with results on cars that are comparable with the paper's data set ``data``."""
    return [c for c in results.comparisons if c.car.reference == data and c.tests]
