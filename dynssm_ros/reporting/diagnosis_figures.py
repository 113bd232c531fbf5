"""Figures of a diagnosis."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dynssm_ros.arrays import Vector
from dynssm_ros.evaluation.regimes import liveliest
from dynssm_ros.identification.problem.windows import SimulationWindows
from dynssm_ros.identification.result.improvement import Improvement
from dynssm_ros.reporting.evaluation_figures import (
    MEASURED,
    NO_MODEL,
    PALETTE,
    SYMBOLS,
    WIDTH,
    cut_at_holes,
    label,
    legend_above,
    sheet,
    styled,
)
from dynssm_ros.reporting.tables import text
from dynssm_ros.signals.signal_map import STATE_SIGNALS
from dynssm_ros.vehicle.effects import Effect

_BINS = 16
_FEWEST = 8  # simulations in a bin
_COLOURS = (NO_MODEL, PALETTE[1], PALETTE[0])  # as given, recalibrated, extended
_SECONDS = 15.0  # of the stretch that is shown in full
_PLACES = 400  # of the lap at which a cause is drawn
_BLOCKS = 24  # parts of the time
_MOST_RECORDINGS = 4  # that have panels of their own
_LONGEST = 2.2  # of the recalibrated car's error; what the car as given exceeds leaves the panel


@styled
def simulated_and_measured(improvement: Improvement) -> Figure:
    """The liveliest held-out stretch: measured, and simulations that start anew from measured states."""
    windows = improvement.windows
    rows, at = windows.data.rows, windows.starts
    shown = at[liveliest(windows.time, rows[:3, at].T, _SECONDS)]
    starts = [int(shown[0])]
    for start in shown:
        if start >= starts[-1] + windows.steps:
            starts.append(int(start))
    runs = replace(windows, starts=np.array(starts))
    figure, axes = sheet(5.4, 3, sharex=True)
    clock = windows.data.context["t"]  # of the recording that the stretch lies in
    whole = np.arange(starts[0], starts[-1] + windows.steps + 1)
    here = runs.starts[:, None] + np.arange(windows.steps + 1)
    for c, (panel, channel) in enumerate(zip(axes, STATE_SIGNALS, strict=True)):
        panel.plot(clock[whole], rows[c, whole], color=MEASURED, lw=2.2, alpha=0.75, label="measured")
        panel.set_ylabel(label(channel))
        low, high = np.ptp(rows[c, whole]) * np.array([-0.4, 0.4]) + [rows[c, whole].min(), rows[c, whole].max()]
        panel.set_ylim(low, high)
    for (name, car), colour in zip(improvement.cars.items(), _COLOURS, strict=True):
        predicted = runs.errors(car) + runs.target
        path = np.concatenate([np.moveaxis(rows[:3, runs.starts], 0, 1)[:, None], predicted], axis=1)
        path = np.concatenate([path, np.full((len(path), 1, 3), np.nan)], axis=1)  # lifts the pen
        t = clock[np.concatenate([here, here[:, -1:]], axis=1)]
        for c, panel in enumerate(axes):
            panel.plot(t.ravel(), path[..., c].ravel(), color=colour, lw=1.0, label=name)
    axes[-1].set_xlabel("time (s)")
    figure.align_ylabels()
    return legend_above(figure, axes[0])


@styled
def cause_pictures(windows: SimulationWindows, without: Vector, with_it: Vector, effect: Effect) -> Figure:
    """How much a cause takes away, where and when; and along the lap, if it is a matter of the place.

    Errors ``(W, 3)`` of held-out simulations are those of the car ``without`` it, but all other causes, and ``with_it``.
    """
    lap = np.linspace(0.0, 1.0, _PLACES)
    known = windows.data.context
    bend = np.interp(lap, known["s"] / known["lap_length"], known["bend"], period=1.0) if "bend" in known else None
    profile = effect.along_lap(lap, bend)
    figure = Figure(figsize=(WIDTH, 4.6 if profile else 2.8), layout="constrained")
    grid = figure.add_gridspec(2 if profile else 1, 3, height_ratios=[2.6, 1.4] if profile else None)
    size, there = (figure.add_subplot(grid[0, k]) for k in range(2))
    scale = np.maximum((without**2).mean(axis=0), 1e-300)
    left = np.sqrt((with_it**2).mean(axis=0) / scale)
    size.bar(range(3), np.ones(3), 0.7, color=_COLOURS[1])
    size.bar(range(3), left, 0.45, color=_COLOURS[2])
    size.set_xticks(range(3), [SYMBOLS[channel] for channel in STATE_SIGNALS])
    size.set_title("error: orange without, blue with")
    size.grid(axis="x", visible=False)
    gone = ((without**2 - with_it**2) / scale).mean(axis=1)
    at = windows.starts + windows.steps // 4
    if {"x", "y"} <= set(known):
        span = max(float(np.quantile(np.abs(gone), 0.95)), 1e-12)
        dots = there.scatter(
            known["x"][at], known["y"][at], c=gone, s=8, cmap="RdBu", vmin=-span, vmax=span, lw=0, rasterized=True
        )
        figure.colorbar(dots, ax=there, location="bottom", shrink=0.8, aspect=24)
        there.set_aspect("equal", adjustable="datalim")
        there.set_title("where: blue, error is gone")
    else:
        bins = _binned(windows.data.rows[0, at])
        there.plot(
            _of_bins(np.mean, windows.data.rows[0, at], bins), _of_bins(np.mean, gone, bins), "o-", color=_COLOURS[2]
        )
        there.axhline(0.0, color=MEASURED, lw=0.8)
        there.set_xlabel("speed (m/s)")
        there.set_title("at which speed error is gone")
    driven = [np.flatnonzero(windows.number == number) for number in np.unique(windows.number)[:_MOST_RECORDINGS]]
    panels = grid[0, 2].subgridspec(len(driven), 1).subplots(sharey=True, squeeze=False)[:, 0]
    for over, rows in zip(panels, driven, strict=True):
        _error_gone(over, windows.data.context["t"][windows.starts[rows]], gone[rows], _BLOCKS // len(driven))
    panels[0].set_title("when: error gone (1: mean)")
    panels[-1].set_xlabel("time (s)" if len(driven) == 1 else "time of each recording (s)")
    if profile:
        what, values = profile
        along = figure.add_subplot(grid[1, :])
        length = float(np.asarray(known["lap_length"]).flat[0]) if "lap_length" in known else 1.0
        along.plot(lap * length, values, color=_COLOURS[2])
        along.set(xlabel="position on the lap (m)", ylabel=what)
    return figure


def _error_gone(panel: Axes, t: Vector, gone: Vector, blocks: int) -> None:
    """Bars of the mean of ``gone`` in blocks of the times ``t`` (s) of one recording."""
    parts = np.array_split(np.argsort(t), max(1, min(blocks, len(gone) // _FEWEST)))
    first, last = (t[[part[k] for part in parts]] for k in (0, -1))
    panel.bar(
        first, [gone[part].mean() for part in parts], np.maximum(last - first, 0.1), align="edge", color=_COLOURS[2]
    )
    panel.axhline(0.0, color=MEASURED, lw=0.8)


@styled
def improvement_by_horizon(improvement: Improvement) -> Figure:
    """Errors of each car at each horizon, a panel per channel."""
    figure, axes = sheet(2.9, 1, 3)
    places = np.arange(len(improvement.horizons))
    width = 0.8 / len(improvement.rmse)
    for c, (panel, channel) in enumerate(zip(axes, STATE_SIGNALS, strict=True)):
        others = np.max([values[:, c] for values in list(improvement.rmse.values())[1:]])
        for k, (name, values) in enumerate(improvement.rmse.items()):
            at = places + (k - 1) * width
            panel.bar(at, np.minimum(values[:, c], _LONGEST * others), 0.9 * width, color=_COLOURS[k], label=name)
            for x, value in zip(at, values[:, c], strict=True):
                if value > _LONGEST * others:
                    panel.text(x, _LONGEST * others, text(float(value)), ha="center", va="bottom", fontsize=8)
        panel.set_xticks(places, [f"{ahead:.4g} s" for ahead in improvement.horizons])
        panel.set_title(label(channel), pad=14)
        panel.grid(axis="x", visible=False)
    return legend_above(figure, axes[0], ncols=3)


@styled
def evidence(tried: Mapping[str, float], named: Sequence[str]) -> Figure:
    """Improvement of each effect alone, the largest at the top; named causes are coloured."""
    ordered = sorted(tried.items(), key=lambda item: item[1])
    figure, panel = sheet(0.8 + 0.22 * max(len(ordered), 1))
    colours = [PALETTE[0] if name in named else NO_MODEL for name, _ in ordered]
    panel.barh(range(len(ordered)), [max(value, 1e-3) for _, value in ordered], color=colours)
    panel.set_yticks(range(len(ordered)), [name for name, _ in ordered])
    panel.set_xscale("symlog", linthresh=10.0)
    panel.set_xlabel("decrease of twice the negative log-likelihood by this effect alone")
    panel.grid(axis="y", visible=False)
    panel.margins(y=0.01)
    return figure


@styled
def errors_over_time(improvement: Improvement, number: int) -> Figure:
    """Errors one step and the horizon ahead over the time of one recording, of the recalibrated and of the extended car."""
    figure, axes = sheet(5.0, 3, 2, sharex=True)
    windows = improvement.windows
    chosen = np.flatnonzero(windows.number == number)
    t = windows.data.context["t"][windows.starts[chosen]]
    order = np.argsort(t)
    for column, h in zip(axes.T, (0, improvement.horizon), strict=True):
        for c, (panel, channel) in enumerate(zip(column, STATE_SIGNALS, strict=True)):
            for (name, values), colour in zip(list(improvement.errors.items())[1:], _COLOURS[1:], strict=True):
                line = cut_at_holes(t[order], values[chosen[order], h, c])
                panel.plot(*line, color=colour, lw=0.8, label=name)
            panel.axhline(0.0, color=MEASURED, lw=0.8)
            panel.set_ylabel(label(channel, " error"))
        column[0].set_title(f"{improvement.horizons[h]:.4g} s ahead")
        column[-1].set_xlabel("time (s)")
    figure.align_ylabels()
    return legend_above(figure, axes[0, 0], ncols=2)


@styled
def errors_over(abscissa: str, x: Vector, improvement: Improvement) -> Figure:
    """Mean and spread of the errors over what ``x`` ``(W,)`` is, one step and the horizon ahead, a column per channel."""
    figure, axes = sheet(4.6, 2, 3, sharex=True)
    bins = _binned(x)
    centre = _of_bins(np.mean, x, bins)
    for row, h in enumerate((0, improvement.horizon)):
        for c, channel in enumerate(STATE_SIGNALS):
            panel: Axes = axes[row, c]
            reach = 0.0
            for (name, errors), colour in zip(improvement.errors.items(), _COLOURS, strict=True):
                mean = _of_bins(np.mean, errors[:, h, c], bins)
                panel.plot(centre, mean, "o-", color=colour, ms=2.5, label=name)
                if colour != NO_MODEL:
                    spread = _of_bins(np.std, errors[:, h, c], bins)
                    panel.fill_between(centre, mean - spread, mean + spread, color=colour, alpha=0.15, lw=0)
                    reach = max(reach, float(np.nanmax(np.abs(mean) + spread)))
            panel.set_ylim(-1.25 * reach, 1.25 * reach) if reach > 0 else None
            panel.axhline(0.0, color=MEASURED, lw=0.8)
            if row == 0:
                panel.set_title(label(channel, " error"))
            else:
                panel.set_xlabel(abscissa)
        axes[row, 0].set_ylabel(f"{improvement.horizons[h]:.4g} s ahead")
    return legend_above(figure, axes[0, 0], ncols=3)


def _binned(x: Vector) -> list[npt.NDArray[np.intp]]:
    """Numbers of the values in equally wide bins; of none in bins that are nearly empty."""
    low, high = np.quantile(x, [0.005, 0.995])
    edges = np.linspace(low, high, _BINS + 1)[1:-1]
    number = np.searchsorted(edges, x)
    bins = [np.flatnonzero(number == k) for k in range(_BINS)]
    filled = [b if len(b) >= _FEWEST else b[:0] for b in bins]
    return filled if any(map(len, filled)) else [np.arange(len(x))]


def _of_bins(what: Callable[[Vector], Any], values: Vector, bins: list[npt.NDArray[np.intp]]) -> Vector:
    """A statistic of the values in each bin; NaN, where lines break, of none."""
    return np.array([what(values[b]) if len(b) else np.nan for b in bins])
