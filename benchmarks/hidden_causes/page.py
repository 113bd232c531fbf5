"""The results of the hidden-cause benchmark as a page."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from benchmarks.hidden_causes import foreign, multi_body
from benchmarks.hidden_causes.cases import OFF, Case, Hidden
from benchmarks.hidden_causes.outcomes import Outcome, by_size, rates
from dynssm_ros.vehicle.effects import EFFECTS

PAGE, FIGURE = "hidden_causes.md", "hidden_causes_confusion.png"
GOALS = {
    "strictly_first": ">= 95, 80, 80 %", "right_size": ">= 90 %", "covered": "85 to 95 %", "both_found": ">= 80 %",
    "false_alarms": "<= 2 % each",
}  # fmt: skip
_IN_WORDS = {
    "named_first": "the hidden effect, or an alternative reported with it, is named first",
    "strictly_first": "the same without alternatives",
    "right_size": "parameters of what was found are within 15 % or two standard deviations",
    "covered": "stated 90 % intervals hold what was hidden",
    "both_found": "both effects of a pair are found",
    "false_alarms": "something is named where nothing is hidden",
    "more_named": "more is named than the one effect that is hidden",
    "too_small": "what is missed is smaller than what the diagnosis says that it would name there",
}
_PLANTS = {
    "rk4": "one track, steps of 1 ms", "double_track": "four wheels", foreign.NAME: "another make",
    multi_body.NAME: "multi-body",
}  # fmt: skip
_MULTI_BODY = (
    " The multi-body car is CommonRoad's: a body on springs, wheels that spin, PAC2002 tyres with camber and combined slip, "
    "brakes on all wheels, an engine with a greatest power. Its first drives gave the library the effect `power_limit`; "
    "nothing else was tuned to it."
)


def page(outcomes: Sequence[tuple[Case, Outcome | None]], asked: str) -> str:
    """The results as Markdown.

    Args:
        outcomes: of the cases; ``None``: the car could not be driven.
        asked: the variables that the cases were asked for with.
    """
    return "\n".join(_lines(outcomes, asked)) + "\n"


def _lines(of: Sequence[tuple[Case, Outcome | None]], asked: str) -> Iterator[str]:
    outcomes = [outcome for _, outcome in of if outcome is not None]
    undriven, seeds = len(of) - len(outcomes), [case.seed for case, _ in of]
    plants = {plant: words for plant, words in _PLANTS.items() if any(case.plant == plant for case, _ in of)}
    yield "# Hidden causes"
    yield ""
    yield (
        f"Made by `python -m doit -f benchmarks/hidden_causes/dodo.py {asked}`: {len(outcomes)} simulated drives with hidden "
        f"effects, seeds {min(seeds)} to {max(seeds)}"
        + (f", without {undriven} whose car could not be driven" if undriven else "")
        + ". How they are drawn and what counts as just noticeable: `benchmarks/hidden_causes/cases.py`."
    )
    yield ""
    yield f"| rate | cases | share | 95 % interval | goal | {' | '.join(plants.values())} |"
    yield f"| --- | --- | --- | --- | --- |{' --- |' * len(plants)}"
    by_plant = [rates([o for case, o in of if o is not None and case.plant == plant]) for plant in plants]
    overall = rates(outcomes)
    for name, words in _IN_WORDS.items():
        rate = overall[name]
        if rate["of"]:
            low, high = rate["interval_95"]
            goal = GOALS.get(name, "")
            each = " | ".join(f"{one[name]['count']} of {one[name]['of']}" for one in by_plant)
            yield (
                f"| {words} | {rate['of']} | {100 * rate['share']:.0f} % | {100 * low:.0f} to {100 * high:.0f} % | {goal} "
                f"| {each} |"
            )
    yield ""
    yield (
        "Four wheels are a car that the equations do not have: an axle loses grip as load moves from one wheel to the other, "
        "and unequal forces at the steered wheels turn the car. An effect that is named there and not hidden may stand for "
        "this. The car of another make has brush tyres, forces that grow less than the load, and steering that gives way."
        + (_MULTI_BODY if multi_body.NAME in plants else "")
    )
    yield ""
    yield f"![What was hidden and what was named first]({FIGURE})"
    yield ""
    yield (
        "Cases of one effect or none; an alternative that is reported counts as named. What is listed as small, within the "
        "structure of the model, does not."
    )
    hidden = {name for outcome in outcomes for name in outcome.hidden}
    if never := [name for name in EFFECTS if name not in hidden]:
        yield ""
        yield f"So few cases did not come to {', '.join(f'`{name}`' for name in never)}."
    yield from _conditions(outcomes)
    wrong = [o for o in outcomes if not o.right or o.sized is False]
    if wrong:
        yield ""
        yield "## What came out wrong"
        yield ""
        yield "| case | hidden | named |"
        yield "| --- | --- | --- |"
        for o in wrong:
            yield f"| `{o.case}` | {_with_values(o.values)} | {_with_values(o.found)} |"


def _conditions(outcomes: Sequence[Outcome]) -> Iterator[str]:
    """What decides how hard the cases are: the sizes, and what the vehicle file tells."""
    yield ""
    yield "## How large, and what is known"
    yield ""
    yield (
        "Sizes are drawn evenly in their logarithm from just noticeable (on the reference drive, twice the log-likelihood "
        "falls by 49) to large (a car that is badly set up)."
    )
    yield ""
    yield "| size, within that range | cases of one effect | named first, without alternatives |"
    yield "| --- | --- | --- |"
    for words, rate in zip(("least third", "middle third", "greatest third"), by_size(outcomes), strict=True):
        yield f"| {words} | {rate['of']} | {rate['count']} |"
    yield ""
    yield (
        f"The vehicle file tells mass and geometry as they are. Its coefficients are off by {100 * OFF:g} % (standard "
        "deviation), and it says so. Those of the car of another make (and of the multi-body car) were calibrated on "
        "two minutes of a healthy drive, the former from nothing but the bounds, and then diagnosed."
    )


def _with_values(effects: Hidden) -> str:
    return "; ".join(
        f"{name} " + ", ".join(f"{key} {value:.3g}" for key, value in values.items())
        for name, values in effects.items()
    )
