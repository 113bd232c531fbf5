"""Figures of a diagnosis and of a battery of cases."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from dynssm_ros.diagnosis.gain import Gain
from dynssm_ros.evaluation.figures import MEASURED, NO_MODEL, PALETTE, SYMBOLS, UNITS, WIDTH, styled
from dynssm_ros.evaluation.metrics import CHANNELS

Vector = npt.NDArray[np.float64]

_BINS = 24
_COLOURS = (NO_MODEL, PALETTE[4], PALETTE[0])


@styled
def gain_by_horizon(gain: Gain) -> Figure:
    """Errors of each car at each horizon, a panel per channel."""
    figure = Figure(figsize=(WIDTH, 2.9), layout="constrained")
    axes = figure.subplots(1, 3)
    places = np.arange(len(gain.horizons))
    width = 0.8 / len(gain.rmse)
    for c, (panel, channel) in enumerate(zip(axes, CHANNELS, strict=True)):
        for k, (name, values) in enumerate(gain.rmse.items()):
            panel.bar(places + (k - 1) * width, values[:, c], 0.9 * width, color=_COLOURS[k], label=name)
        panel.set_xticks(places, [f"{ahead:g} s" for ahead in gain.horizons])
        panel.set_title(f"{SYMBOLS[channel]} ({UNITS[channel]})")
        panel.grid(axis="x", visible=False)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper left", ncols=3)
    return figure


@styled
def evidence(tried: Mapping[str, float], named: Sequence[str]) -> Figure:
    """Gain of each effect alone, the largest at the top; named causes are coloured."""
    ordered = sorted(tried.items(), key=lambda item: item[1])
    figure = Figure(figsize=(WIDTH, 0.8 + 0.22 * max(len(ordered), 1)), layout="constrained")
    panel = figure.subplots()
    colours = [PALETTE[1] if name in named else NO_MODEL for name, _ in ordered]
    panel.barh(range(len(ordered)), [max(value, 1e-3) for _, value in ordered], color=colours)
    panel.set_yticks(range(len(ordered)), [name for name, _ in ordered])
    panel.set_xscale("symlog", linthresh=10.0)
    panel.set_xlabel("improvement of the fit")
    panel.grid(axis="y", visible=False)
    return figure


@styled
def errors_over(label: str, x: Vector, errors: Mapping[str, Vector], line: bool = False) -> Figure:
    """Errors before and after against something.

    Args:
        label: of the abscissa.
        x: abscissa of each error, shape ``(W,)``.
        errors: by car, each ``(W, 3)``; the first and the last are shown.
        line: draw them all; else means and standard deviations in bins of equally many.
    """
    figure = Figure(figsize=(WIDTH, 4.6 if line else 3.0), layout="constrained")
    axes = figure.subplots(3, 1, sharex=True) if line else figure.subplots(1, 3)
    shown = {name: errors[name] for name in (next(iter(errors)), list(errors)[-1])}
    order = np.argsort(x)
    bins = np.array_split(order, min(_BINS, max(1, len(x) // 8)))
    for c, (panel, channel) in enumerate(zip(axes, CHANNELS, strict=True)):
        for (name, values), colour in zip(shown.items(), (PALETTE[1], PALETTE[0]), strict=False):
            if line:
                panel.plot(x[order], values[order, c], color=colour, lw=0.8, label=name)
                continue
            centre = [x[b].mean() for b in bins]
            mean = np.array([values[b, c].mean() for b in bins])
            spread = np.array([values[b, c].std() for b in bins])
            panel.plot(centre, mean, color=colour, label=name)
            panel.fill_between(centre, mean - spread, mean + spread, color=colour, alpha=0.18, lw=0)
        panel.axhline(0.0, color=MEASURED, lw=0.8)
        panel.set_ylabel(f"{SYMBOLS[channel]} error ({UNITS[channel]})")
        if not line or c == 2:
            panel.set_xlabel(label)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper left", ncols=2)
    return figure


@styled
def confusion(hidden: Sequence[str], named: Sequence[str], count: npt.NDArray[np.intp]) -> Figure:
    """Confusion matrix.

    Args:
        hidden: labels of the rows.
        named: labels of the columns.
        count: cases, shape ``(len(hidden), len(named))``.
    """
    figure = Figure(figsize=(WIDTH, 0.72 * WIDTH + 1.2), layout="constrained")
    panel = figure.subplots()
    panel.imshow(count / np.maximum(count.sum(axis=1, keepdims=True), 1), cmap="Blues", vmin=0, vmax=1.2)
    for i, j in np.argwhere(count > 0):
        panel.text(j, i, str(count[i, j]), ha="center", va="center", fontsize=8)
    panel.set_xticks(range(len(named)), named, rotation=90, fontsize=8)
    panel.set_yticks(range(len(hidden)), hidden, fontsize=8)
    panel.set(xlabel="named first", ylabel="hidden")
    panel.grid(visible=False)
    return figure
