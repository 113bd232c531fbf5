"""The results of the hidden-cause benchmark as a page."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from benchmarks.hidden_causes import foreign, multi_body
from benchmarks.hidden_causes.cases import OFF, Case, Hidden
from benchmarks.hidden_causes.outcomes import Outcome, by_size, processor_seconds, rates
from benchmarks.page import render
from dynssm_ros.reporting.evaluation_figures import WIDTH, sheet, styled
from dynssm_ros.vehicle.effects import EFFECTS

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
    "recalibrated": "verdict `recalibrate` with a coefficient of the axle of which the file has 5 % too much grip",
    "more_named": "more is named than the one effect that is hidden",
    "too_small": "what is missed is smaller than what the diagnosis says that it would name there",
}
_PLANTS = {
    "rk4": "one track", "double_track": "four wheels", foreign.NAME: "another make",
    multi_body.NAME: "multi-body",
}  # fmt: skip


def hidden_causes_page(outcomes: Sequence[tuple[Case, Outcome | None]], arguments: Sequence[str], figure: str) -> str:
    """The results as Markdown; an outcome is ``None`` where the car could not be driven. ``arguments``: of doit's
    command.
    """
    known = [outcome for _, outcome in outcomes if outcome is not None]
    plants = {plant: words for plant, words in _PLANTS.items() if any(case.plant == plant for case, _ in outcomes)}
    hidden = {name for outcome in known for name in outcome.hidden}
    thirds = zip(("least third", "middle third", "greatest third"), by_size(known), strict=True)
    return render(
        "hidden_causes",
        arguments=arguments,
        figure=figure,
        multi_body=multi_body.NAME in plants,
        never=[name for name in EFFECTS if name not in hidden],
        off=OFF,
        outcomes=known,
        plants=list(plants.values()),
        rates=_rates(known, [[o for c, o in outcomes if o is not None and c.plant == plant] for plant in plants]),
        seconds=processor_seconds(known),
        seeds=[case.seed for case, _ in outcomes],
        sizes=[[words, str(rate["of"]), str(rate["count"])] for words, rate in thirds],
        undriven=len(outcomes) - len(known),
        wrong=[
            [f"`{o.case}`", _with_values(o.values), _with_values(o.found)]
            for o in known
            if not o.right or o.sized is False
        ],
    )


def _rates(known: Sequence[Outcome], by_plant: Sequence[Sequence[Outcome]]) -> Iterator[list[str]]:
    """A row for each rate of which there are cases, with those of each plant."""
    overall, each = rates(known), [rates(some) for some in by_plant]
    for name, words in _IN_WORDS.items():
        if (rate := overall[name])["of"]:
            low, high = rate["interval_95"]
            shares = [f"{100 * rate['share']:.0f} %", f"{100 * low:.0f} to {100 * high:.0f} %", GOALS.get(name, "")]
            yield [words, str(rate["of"]), *shares, *(f"{one[name]['count']} of {one[name]['of']}" for one in each)]


def _with_values(effects: Hidden) -> str:
    return "; ".join(
        f"{name} " + ", ".join(f"{key} {value:.3g}" for key, value in values.items())
        for name, values in effects.items()
    )


@styled
def confusion(hidden: Sequence[str], named: Sequence[str], count: npt.NDArray[np.intp]) -> Figure:
    """Which effect was named first (columns) where which was hidden (rows); ``count`` has the cases."""
    figure, panel = sheet(0.72 * WIDTH + 1.2)
    share = count / np.maximum(count.sum(axis=1, keepdims=True), 1)
    panel.imshow(share, cmap="Blues", vmin=0, vmax=1.2)
    for i, j in np.argwhere(count > 0):
        ink = "white" if share[i, j] > 0.5 else "black"
        panel.text(j, i, str(count[i, j]), ha="center", va="center", fontsize=8, color=ink)
    panel.set_xticks(range(len(named)), named, rotation=90, fontsize=8)
    panel.set_yticks(range(len(hidden)), hidden, fontsize=8)
    panel.set(xlabel="named first", ylabel="hidden")
    panel.grid(visible=False)
    return figure
