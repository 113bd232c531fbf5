"""The figures of the documents."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator

from benchmarks.paper.results import Entry
from benchmarks.paper.tables import validation_loss
from dynssm_ros.arrays import Vector
from dynssm_ros.evaluation.spread import SeedSpread
from dynssm_ros.reporting.evaluation_figures import (
    MEASURED,
    NO_MODEL,
    PALETTE,
    SYMBOLS,
    WIDTH,
    legend_above,
    model_colours,
    sheet,
    styled,
)
from dynssm_ros.signals.signal_map import STATE_SIGNALS

_MARKERS = "osD^vPX*<>"
_STYLES = ("--", ":")
_CLOSE = 0.3  # s between level lines of which the lower one has its words below
_FAR = 20.0  # times the least error that the largest is, from which on they are drawn along a logarithm


@styled
def against_persistence(relative: Mapping[str, Mapping[str, Vector]]) -> Figure:
    """One-step RMSE of each model on each test as a multiple of persistence's ``(3,)``, a panel for each state; a
    model may lack tests.
    """
    tests = list(dict.fromkeys(test for values in relative.values() for test in values))
    figure, axes = _panels(list(relative))
    places = np.arange(len(relative), dtype=float)
    for k, axis in enumerate(axes):
        axis.axvline(1.0, color=NO_MODEL, linestyle="--", zorder=1)
        for j, test in enumerate(tests):
            shift = 0.5 * (j / max(1, len(tests) - 1) - 0.5)
            axis.plot(
                [each.get(test, np.full(3, np.nan))[k] for each in relative.values()], places + shift,
                linestyle="", marker=_MARKERS[j % len(_MARKERS)], markersize=4.5, color=PALETTE[j % len(PALETTE)],
                label=test,
            )  # fmt: skip
        axis.set_xscale("log")
        axis.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.minorticks_off()
    axes[1].set_xlabel("one-step RMSE over that of persistence (dashed: as good as no model)")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure


@styled
def against_the_full_model(full: Sequence[SeedSpread], ablations: Mapping[str, Sequence[SeedSpread]]) -> Figure:
    """One-step RMSE of each ablation, by what it lacks, as a multiple of the full model's for each state, with the
    spread over seeds; that of the full model is the grey band.
    """
    figure, axes = _panels(list(ablations))
    for k, axis in enumerate(axes):
        mean, std = full[k].mean, full[k].std
        axis.axvspan(1 - std / mean, 1 + std / mean, color=NO_MODEL, alpha=0.3, linewidth=0)
        axis.axvline(1.0, color=NO_MODEL, linestyle="--")
        ratios, spreads = zip(*((each[k].mean / mean, each[k].std / mean) for each in ablations.values()), strict=True)
        axis.errorbar(ratios, np.arange(len(ablations)), xerr=spreads, fmt="o", color=PALETTE[0], capsize=2.5)
        if max(ratios) > _FAR * min(ratios):
            axis.set_xscale("log")
    axes[1].set_xlabel("one-step RMSE over that of the full model (band and whiskers: standard deviation over seeds)")
    return figure


@styled
def learning_rates(tried: Mapping[str, Mapping[float, Sequence[Entry]]]) -> Figure:
    """The lowest validation loss so far over the epochs, a panel for each model, a line for each training, by
    learning rate.
    """
    figure, panels = sheet(0.28 * WIDTH, 1, len(tried), squeeze=False)
    for axis, (model, rates) in zip(panels[0], tried.items(), strict=True):
        for k, (rate, trainings) in enumerate(rates.items()):
            for n, training in enumerate(trainings):
                best = np.minimum.accumulate(np.array(validation_loss(training), dtype=float))
                label = f"{rate:g}" if n == 0 else None
                axis.plot(np.arange(1, len(best) + 1), best, color=PALETTE[k % len(PALETTE)], label=label)
        axis.set(title=model, xlabel="epoch", yscale="log")
        axis.legend(fontsize=7)
    figure.supylabel("validation loss", fontsize=9)
    return figure


@styled
def lap_over_speed_scale(
    laps: Mapping[str, Mapping[float, float | None]],
    bounds: Mapping[str, Mapping[float, float]],
    published: Mapping[str, float],
) -> Figure:
    """Lap times (s) on one line over the factor on its speed, by model; a lap that was not completed is a hollow mark at
    the top.

    ``bounds`` are what the line itself allows, ``published`` the paper's times by the names to show.
    """
    figure, axes = sheet(0.5 * WIDTH)
    top = 1.04 * max(lap for each in (*laps.values(), *bounds.values()) for lap in each.values() if lap is not None)
    colours = model_colours(list(laps))
    shift = 0.004 * (np.arange(len(laps)) - (len(laps) - 1) / 2)
    for k, (name, driven) in enumerate(laps.items()):
        # models that drive alike stay visible one inside the other
        size = 4 + 2 * (len(laps) - 1 - k)
        look: dict[str, Any] = {"color": colours[name], "marker": _MARKERS[k % len(_MARKERS)], "markersize": size}
        scales = sorted(driven)
        times = [np.nan if driven[scale] is None else driven[scale] for scale in scales]
        axes.plot(scales, times, label=name, zorder=3 + k / 10, **look)
        lost = [scale + shift[k] for scale in scales if driven[scale] is None]
        axes.plot(lost, [top] * len(lost), linestyle="", markerfacecolor="none", clip_on=False, **look)
    for style, (words, allowed) in zip(_STYLES, bounds.items(), strict=False):
        axes.plot(*zip(*sorted(allowed.items()), strict=True), color=MEASURED, linestyle=style, label=words)
    left = min(scale for driven in laps.values() for scale in driven)  # where all are slower than what is published
    for words, lap in published.items():
        axes.axhline(lap, color=NO_MODEL, linewidth=0.9, zorder=1)
        above = not any(0 < other - lap < _CLOSE for other in published.values())
        axes.annotate(
            f"{words}: {lap:.2f} s", (left, lap), textcoords="offset points", xytext=(0, 2 if above else -2),
            va="bottom" if above else "top", fontsize=8, ha="left",
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.5},
        )  # fmt: skip
    axes.set(xlabel="factor on the line's speed", ylabel="lap (s)", ylim=(None, top))
    return legend_above(figure, axes, ncols=3)


def _panels(rows: Sequence[str]) -> tuple[Figure, Any]:
    """A panel for each state, sharing named rows, the first at the top."""
    figure, axes = sheet(1.1 + 0.32 * len(rows), 1, len(STATE_SIGNALS), sharey=True)
    axes[0].set_yticks(range(len(rows)), rows)
    axes[0].set_ylim(len(rows) - 0.5, -0.5)
    for axis, channel in zip(axes, STATE_SIGNALS, strict=True):
        axis.set_title(SYMBOLS[channel])
    return figure, axes
