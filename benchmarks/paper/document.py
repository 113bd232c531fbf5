"""The document: a pure function of the results, and the figures that it shows."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from matplotlib.figure import Figure

from benchmarks.paper import figures, tables
from benchmarks.paper.results import Comparison, Results
from benchmarks.paper.stale import signed
from benchmarks.paper.summary import summary
from dynssm_ros.arrays import Vector
from dynssm_ros.files import replacing
from dynssm_ros.reporting.evaluation_figures import loss_components
from dynssm_ros.reporting.evaluation_report import COMMANDS_IN_WORDS
from dynssm_ros.reporting.tables import Table

MADE_BY = "Made by `make paper`; no number here is typed by hand. The paper's own numbers are those of its tables."
_CARS = {"real": "Full-size car", "sim": "Small car", "other": "1:10 car"}
_DATA = {
    "development": "Development data: models and their settings were chosen with such data in sight.",
    "test": "Test data: nothing was chosen by it.",
}


def write(results: Results, path: Path) -> None:
    """Writes the document to ``path``, and its figures beside it."""
    drawn = dict(draw(results))
    for name, figure in drawn.items():
        with replacing(path.with_name(f"{path.stem}_{name}.png")) as aside:
            figures.save(figure, aside)
    with replacing(path) as aside:
        text = markdown(results, {name: f"{path.stem}_{name}.png" for name in drawn})
        aside.write_text(signed(text, results.plan), encoding="utf-8")


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
    tried = {
        results.plan.sweeps[name].model: {
            rate: [tables.validation_loss(each) for each in trainings] for rate, trainings in rates.items()
        }
        for name, rates in results.rates.items()
        if rates
    }
    if tried:
        yield "rates", figures.learning_rates(tried)


def markdown(results: Results, pictures: dict[str, str]) -> str:
    """The document.

    Args:
        results: of a run.
        pictures: addresses of the figures by their names.
    """
    return "\n\n".join(part.strip() for part in _parts(results, pictures)) + "\n"


def _parts(results: Results, pictures: dict[str, str]) -> Iterator[str]:
    yield "# Results"
    yield from summary(results)
    yield "## How it was measured"
    yield from _introduction(results)
    planned = {comparison.car.reference for comparison in results.comparisons}
    for data, title in _CARS.items():
        if data not in planned:
            continue
        comparisons = _comparable(results, data)
        yield f"## {title}"
        yield from _missing(results, data)
        if comparisons and data in results.reference.open_loop:
            yield from _against_published(results, data, comparisons)
        if data == "real" and "persistence" in pictures:
            yield f"![One-step errors relative to persistence]({pictures['persistence']})"
        for comparison in comparisons:
            yield from _study(comparison, results, pictures)
        yield from _coefficients(results, data)
        yield from _losses(results, data, pictures)
    yield from _rates(results, pictures)
    yield from _uncertainty(results)
    yield from _cost(results)


def _introduction(results: Results) -> Iterator[str]:
    made = results.made
    yield MADE_BY
    if made.quick:
        yield (
            f"> **Not results:** a quick run to try everything out, with {results.plan.epochs} epochs in each stage, "
            "one seed, short drives, and only the first split of each study."
        )
    if results.missing:
        lines = [f"> - {title}: {reason}" for title, reason in results.missing.items()]
        yield "\n".join(["> **Incomplete.** These steps could not be done:", ">", *lines])
    used = dict.fromkeys(study.commands for study in results.plan.studies.values())
    lines = [
        *(f"{name}: {value}" for name, value in made.protocol.items()),
        *(f"Commands `{name}`: {COMMANDS_IN_WORDS[name].partition(': ')[2]}." for name in used),
        "Splits: nothing of a test is trained on, calibrated on or used to stop training. The parts of a log are cut into "
        "stretches, and no window reaches across a cut. Rows below 5 m/s are left out for the full-size car.",
        "Car: the single-track models and DynSSM start from coefficients calibrated on the training part alone; DDM, FTHD "
        "and the paper's configuration have the paper's bounds.",
        *_names(results),
        f"Rollouts: over the paper's horizons (0.6 s, 0.3 s for the small car) from one row in {results.plan.stride}; "
        "predicted states are fed back, measured actuator feedback and commands are supplied. The displacement is between "
        "predicted and measured path, both integrated from velocities from the same pose.",
        "Several tests of a study are taken together by the root of the mean square of their RMSE, the largest maximum "
        "error, and the mean of all else. Bold is the best of a column.",
        "To repeat it: `make paper`, with the logs and tracks in `DYNSSM_DATA`; it continues after a kill. "
        '`benchmarks/paper/plan.yaml` is the plan. `ARGS="test=NAME=R.parquet"` adds a recording to be predicted.',
    ]
    yield "\n".join(f"- {line}" for line in lines)


def _names(results: Results) -> Iterator[str]:
    """The model files of names that only this page has."""
    models = results.plan.models
    shipped = {name: model.base for name, model in models.items() if model.base and model.base not in models}
    if shipped:
        yield f"Models: {', '.join(f'`{name}` is `{base}`' for name, base in shipped.items())}, each for the car of its name."


def _missing(results: Results, data: str) -> Iterator[str]:
    """A line for each study that lacks something."""
    for comparison in results.comparisons:
        if comparison.car.reference != data:
            continue
        if not comparison.planned:
            yield f"*{comparison.label}*: not measured, no recording was given with `test=NAME=R.parquet`."
        elif comparison.reasons:
            what = "not measured" if not comparison.tests else "measured in part"
            yield f"*{comparison.label}*: {what}; {'; '.join(dict.fromkeys(comparison.reasons))}."


def _against_published(results: Results, data: str, comparisons: Sequence[Comparison]) -> Iterator[str]:
    reference = results.reference.open_loop[data]
    yield "### Against the published models"
    yield (
        "The paper's open-loop table, and the same models trained and measured here. The tests are not the paper's, so "
        "compare the models with each other first."
    )
    yield tables.published_table(comparisons, reference).markdown()
    yield "How far errors lie below those of DDM on the same test, in percent:"
    yield tables.reduction_table(comparisons, results.reference, data).markdown()


def _study(comparison: Comparison, results: Results, pictures: dict[str, str]) -> Iterator[str]:
    yield f"### {comparison.study.title[0].upper()}{comparison.study.title[1:]}, commands `{comparison.study.commands}`"
    yield comparison.study.text
    yield _DATA[comparison.study.data]
    yield tables.error_table(comparison).markdown()
    yield tables.relative_table(comparison).markdown()
    for base in comparison.bases:
        yield f"Ablations of `{base}`, one-step RMSE:"
        yield tables.ablation_table(comparison, results, base).markdown()
        picture = pictures.get(f"ablations_{comparison.name}_{base}")
        if picture:
            yield f"![Ablations of {base} against itself]({picture})"
    if comparison.study.remark:
        yield comparison.study.remark


def _coefficients(results: Results, data: str) -> Iterator[str]:
    by_name = {comparison.name: comparison for comparison in _comparable(results, data)}
    wanted = dict.fromkeys(car.coefficients for car in results.plan.cars.values() if car.reference == data)
    for comparison in (by_name[name] for name in wanted if name in by_name):
        table: Table | None = tables.coefficient_table(comparison, results)
        if table is not None:
            yield "### Coefficients"
            yield "What the models do with the physical coefficients inside their bounds."
            yield table.markdown()


def _losses(results: Results, data: str, pictures: dict[str, str]) -> Iterator[str]:
    papers = dict.fromkeys(car.paper for car in results.plan.cars.values() if car.reference == data)
    for picture in (pictures.get(f"losses_{model}") for model in papers):
        if picture:
            yield "### Terms of the loss"
            yield "Of the paper's model over the epochs, seed 0; the paper shows the same figure."
            yield f"![Terms of the loss over the epochs]({picture})"


def _rates(results: Results, pictures: dict[str, str]) -> Iterator[str]:
    if any(results.rates.values()):
        yield "## Learning rates of the rivals"
        yield "What each was trained with, and rates beside it. Published settings and ours are in [rivals](rivals.md)."
        yield tables.rate_table(results).markdown()
        if "rates" in pictures:
            yield f"![Validation loss over the epochs]({pictures['rates']})"


def _uncertainty(results: Results) -> Iterator[str]:
    table = tables.coverage_table([comparison for comparison in results.comparisons if comparison.tests])
    if table.rows:
        yield "## Stated uncertainty"
        yield (
            "Share of one-step errors inside the interval that the model claims to hold 90 % of them: below 90 it was too "
            "sure, above too cautious."
        )
        yield table.markdown()


def _cost(results: Results) -> Iterator[str]:
    if results.costs:
        yield "## Cost"
        yield (
            "Of one prediction. All models were timed in one run, in turn, one window per call: trained ones in ONNX "
            "Runtime on one core, the others in numpy. FLOPs are matrix products as torch counts them, of the single-track "
            "models every operation as numpy executes it. The paper's latencies are of its own machine."
        )
        yield tables.cost_table(results).markdown()


def _comparable(results: Results, data: str) -> list[Comparison]:
    """The studies with results on cars that are comparable with the paper's data set ``data``."""
    return [c for c in results.comparisons if c.car.reference == data and c.tests]
