"""The figure of several races together."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from dynssm_ros.reporting.evaluation_figures import MEASURED, NO_MODEL, WIDTH, model_colours, styled

_MARKERS = "osD^vPX*"
_STYLES = ("--", ":")
_CLOSE = 0.3  # s between level lines of which the lower one has its words below


@styled
def lap_over_speed_scale(
    laps: Mapping[str, Mapping[float, float | None]],
    bounds: Mapping[str, Mapping[float, float]],
    published: Mapping[str, float],
) -> Figure:
    """Lap times on one line over the factor on its speed; a lap that was not completed is a hollow mark at the top.

    Args:
        laps: times (s) by model and factor.
        bounds: what the line itself allows (s), by a few words and factor.
        published: the paper's times (s) by the names to show.
    """
    figure = Figure(figsize=(WIDTH, 0.5 * WIDTH), layout="constrained")
    axes = figure.subplots()
    times = [lap for by_pace in laps.values() for lap in by_pace.values() if lap is not None]
    top = 1.04 * max([*times, *(time for by_pace in bounds.values() for time in by_pace.values())])
    colours = model_colours(list(laps))
    shift = 0.004 * (np.arange(len(laps)) - (len(laps) - 1) / 2)
    for k, (name, by_pace) in enumerate(laps.items()):
        # models that drive alike stay visible one inside the other
        look: dict[str, Any] = {
            "color": colours[name],
            "marker": _MARKERS[k % len(_MARKERS)],
            "markersize": 4 + 2 * (len(laps) - 1 - k),
        }
        paces = sorted(by_pace)
        values = [by_pace[speed_scale] for speed_scale in paces]
        axes.plot(paces, [np.nan if lap is None else lap for lap in values], label=name, zorder=3 + k / 10, **look)
        lost = [speed_scale + shift[k] for speed_scale, lap in zip(paces, values, strict=True) if lap is None]
        axes.plot(lost, [top] * len(lost), linestyle="", markerfacecolor="none", clip_on=False, **look)
    for style, (words, by_pace) in zip(_STYLES, bounds.items(), strict=False):
        axes.plot(*zip(*sorted(by_pace.items()), strict=True), color=MEASURED, linestyle=style, label=words)
    left = min(
        speed_scale for by_pace in laps.values() for speed_scale in by_pace
    )  # where all are slower than what is published
    for words, lap in published.items():
        axes.axhline(lap, color=NO_MODEL, linewidth=0.9, zorder=1)
        above = not any(0 < other - lap < _CLOSE for other in published.values())
        axes.annotate(
            f"{words}: {lap:.2f} s", (left, lap), textcoords="offset points", xytext=(0, 2 if above else -2),
            va="bottom" if above else "top", fontsize=8, ha="left",
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.5},
        )  # fmt: skip
    axes.set(xlabel="factor on the line's speed", ylabel="lap (s)", ylim=(None, top))
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper left", ncols=3)
    return figure
