"""The figures of the document."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator

from benchmarks.paper.results import Entry
from benchmarks.paper.tables import validation_loss
from dynssm_ros.arrays import Vector
from dynssm_ros.evaluation.spread import SeedSpread
from dynssm_ros.reporting.evaluation_figures import NO_MODEL, PALETTE, STYLE, SYMBOLS, WIDTH
from dynssm_ros.signals.signal_map import STATE_SIGNALS

_MARKERS = "osD^vPX*<>"


def against_persistence(relative: Mapping[str, Mapping[str, Vector]]) -> Figure:
    """One-step RMSE of each model on each test as a multiple of persistence's, a panel for each state.

    Args:
        relative: by model, then by test, shape ``(3,)``; a model may lack tests.
    """
    models = list(relative)
    tests = list(dict.fromkeys(test for values in relative.values() for test in values))
    with mpl.rc_context(STYLE):
        figure, axes = _panels(models)
        places = np.arange(len(models), dtype=float)
        for k, axis in enumerate(axes):
            axis.axvline(1.0, color=NO_MODEL, linestyle="--", zorder=1)
            for j, test in enumerate(tests):
                shift = 0.5 * (j / max(1, len(tests) - 1) - 0.5)
                axis.plot(
                    [relative[model].get(test, np.full(3, np.nan))[k] for model in models], places + shift,
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


def against_the_full_model(full: Sequence[SeedSpread], ablations: Mapping[str, Sequence[SeedSpread]]) -> Figure:
    """One-step RMSE of each ablation as a multiple of the full model's, with the spread over seeds.

    Args:
        full: of the full model, one for each state; its own spread is the grey band.
        ablations: the same by what they lack.
    """
    with mpl.rc_context(STYLE):
        figure, axes = _panels(list(ablations))
        for k, axis in enumerate(axes):
            mean, std = full[k].mean, full[k].std
            axis.axvspan(1 - std / mean, 1 + std / mean, color=NO_MODEL, alpha=0.3, linewidth=0)
            axis.axvline(1.0, color=NO_MODEL, linestyle="--")
            ratios = [each[k].mean / mean for each in ablations.values()]
            axis.errorbar(
                ratios, np.arange(len(ablations)),
                xerr=[each[k].std / mean for each in ablations.values()], fmt="o", color=PALETTE[0], capsize=2.5,
            )  # fmt: skip
        axes[1].set_xlabel(
            "one-step RMSE over that of the full model (band and whiskers: standard deviation over seeds)"
        )
    return figure


def learning_rates(tried: Mapping[str, Mapping[float, Sequence[Entry]]]) -> Figure:
    """The lowest validation loss so far over the epochs, a panel for each model, a line for each training.

    Args:
        tried: by model, then by learning rate, for each training: what it says of itself.
    """
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 0.28 * WIDTH), layout="constrained")
        for axis, (model, rates) in zip(figure.subplots(1, len(tried), squeeze=False)[0], tried.items(), strict=True):
            for k, (rate, trainings) in enumerate(rates.items()):
                for n, training in enumerate(trainings):
                    best = np.minimum.accumulate(np.array(validation_loss(training), dtype=float))
                    label = f"{rate:g}" if n == 0 else None
                    axis.plot(np.arange(1, len(best) + 1), best, color=PALETTE[k % len(PALETTE)], label=label)
            axis.set(title=model, xlabel="epoch", yscale="log")
            axis.legend(fontsize=7)
        figure.supylabel("validation loss", fontsize=9)
    return figure


def _panels(rows: Sequence[str]) -> tuple[Figure, list[mpl.axes.Axes]]:
    """A panel for each state, sharing named rows, the first at the top."""
    figure = Figure(figsize=(WIDTH, 1.1 + 0.32 * len(rows)), layout="constrained")
    axes = list(figure.subplots(1, len(STATE_SIGNALS), sharey=True))
    axes[0].set_yticks(range(len(rows)), rows)
    axes[0].set_ylim(len(rows) - 0.5, -0.5)
    for axis, channel in zip(axes, STATE_SIGNALS, strict=True):
        axis.set_title(SYMBOLS[channel])
    return figure, axes
