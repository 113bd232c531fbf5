"""Figures of the anatomy of errors: one small one for each pattern, with the finding as its title."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dynssm_ros.arrays import Vector
from dynssm_ros.evaluation.residuals.anatomy import Anatomy
from dynssm_ros.evaluation.residuals.patterns import Pattern, Picture
from dynssm_ros.reporting.evaluation_figures import MEASURED, NO_MODEL, PALETTE, SYMBOLS, model_colours, sheet, styled
from dynssm_ros.signals.signal_map import STATE_SIGNALS

_HEIGHT = 2.5  # inches
_LONG_LABEL = 14  # letters, from which on labels are turned
_MARKED, _PLAIN = PALETTE[1], PALETTE[0]


@styled
def pattern_figure(pattern: Pattern) -> Figure:
    """What a pattern looks like; the part that it is about is orange."""
    picture = pattern.picture
    assert picture is not None
    figure, panel = sheet(_HEIGHT + (0.7 if any(len(label) > _LONG_LABEL for label in picture.labels) else 0.0))
    _DRAW[picture.kind](panel, picture)
    panel.set_title(f"{pattern.words}  ({100 * pattern.share:.2g} % of the squared error)", wrap=True)
    panel.set_xlabel(picture.title_x)
    panel.set_ylabel(picture.title_y)
    return figure


def _bars(panel: Axes, picture: Picture) -> None:
    marked = picture.mark or (-1, -1)
    colours = [_MARKED if marked[0] <= k <= marked[1] else _PLAIN for k in range(len(picture.y))]
    panel.bar(
        np.arange(len(picture.y)),
        picture.y,
        color=colours,
        yerr=_interval(picture),
        error_kw={"lw": 0.9, "ecolor": MEASURED},
    )
    panel.axhline(0.0, color=MEASURED, lw=0.8)
    turned = any(len(label) > _LONG_LABEL for label in picture.labels) or len(picture.labels) > 8
    panel.set_xticks(
        range(len(picture.labels)),
        picture.labels,
        rotation=40 if turned else 0,
        ha="right" if turned else "center",
        fontsize=8,
    )


def _bins(panel: Axes, picture: Picture) -> None:
    centres, widths = (picture.x[1:] + picture.x[:-1]) / 2, np.diff(picture.x)
    low, high = picture.mark or (np.inf, -np.inf)
    colours = [_MARKED if low <= centre <= high else _PLAIN for centre in centres]
    panel.bar(
        centres,
        picture.y,
        widths * 0.92,
        color=colours,
        yerr=_interval(picture),
        error_kw={"lw": 0.9, "ecolor": MEASURED},
    )
    panel.axhline(0.0, color=MEASURED, lw=0.8)


def _interval(picture: Picture) -> Vector | None:
    return None if picture.spread is None else 1.96 * picture.spread


def _comb(panel: Axes, picture: Picture) -> None:
    strongest = int(np.argmax(np.abs(picture.y - np.median(picture.y))))
    width = float(picture.x[1] - picture.x[0]) if len(picture.x) > 1 else 1.0
    low, high = picture.mark or (picture.x[strongest], picture.x[strongest])
    colours = [_MARKED if low <= place <= high else _PLAIN for place in picture.x]
    panel.bar(picture.x, picture.y, 0.9 * width, color=colours)
    panel.axhline(0.0, color=MEASURED, lw=0.8)


def _lags(panel: Axes, picture: Picture) -> None:
    if picture.mark is not None:
        panel.axvspan(*picture.mark, color=_MARKED, alpha=0.35, lw=0)
    panel.plot(picture.x, picture.y, color=_PLAIN, marker="o" if len(picture.x) < 60 else None, ms=3)
    panel.axvline(0.0, color=NO_MODEL, lw=0.8)
    panel.axhline(0.0, color=MEASURED, lw=0.8)


def _levels(panel: Axes, picture: Picture) -> None:
    panel.step(picture.x, picture.y, color=_PLAIN, where="mid")


_DRAW = {"bars": _bars, "bins": _bins, "comb": _comb, "lags": _lags, "levels": _levels}


@styled
def left_to_learn_figure(found: Anatomy) -> Figure:
    """Bars by channel and model: what a strong learner still takes off the squared error."""
    figure, panel = sheet(2.2)
    colours, width = model_colours(list(found.models)), 0.8 / len(found.models)
    for k, (label, model) in enumerate(found.models.items()):
        shares = [100 * model.left_to_learn[c].share if c in model.left_to_learn else np.nan for c in STATE_SIGNALS]
        filtered = [
            100 * model.left_to_learn[c].filtered if c in model.left_to_learn else np.nan for c in STATE_SIGNALS
        ]
        places = np.arange(len(STATE_SIGNALS)) + (k - (len(found.models) - 1) / 2) * width
        panel.bar(places, shares, 0.92 * width, color=colours[label], label=label)
        panel.bar(places, np.minimum(filtered, shares), 0.92 * width, color="white", alpha=0.55)
    panel.set_xticks(range(len(STATE_SIGNALS)), [SYMBOLS[c] for c in STATE_SIGNALS])
    panel.set_ylabel("left to learn\n(% of the squared error)")
    panel.legend()
    return figure


@styled
def autocorrelation_figure(curves: Mapping[str, Mapping[str, Vector]], T_s: float) -> Figure:
    """Autocorrelation of the errors over 2 s by channel, a line for each model."""
    figure, axes = sheet(2.4, 1, len(STATE_SIGNALS), sharey=True)
    colours = model_colours(list(curves))
    for panel, channel in zip(axes, STATE_SIGNALS, strict=True):
        for label, model in curves.items():
            curve = model[channel][1:]
            panel.plot(T_s * np.arange(1, len(curve) + 1), curve, color=colours[label], label=label)
        panel.axhline(0.0, color=MEASURED, lw=0.8)
        panel.set_title(SYMBOLS[channel])
        panel.set_xlabel("time after (s)")
    axes[0].set_ylabel("autocorrelation")
    axes[0].legend()
    return figure
