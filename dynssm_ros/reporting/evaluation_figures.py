"""Figures, each a function of plain arrays that returns a :class:`~matplotlib.figure.Figure`, and their style.

States are of shape ``(N, 3)``, errors of models by model name; ``std`` is their standard deviation over the seeds, 0 for a
single one. Colours are Okabe and Ito's, continued by Paul Tol's, which stay apart for colour-blind readers; measured values
are black, persistence is grey. Nothing here touches pyplot's global state, so figures can be drawn in any thread and without
a display.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import PercentFormatter, ScalarFormatter

from dynssm_ros.arrays import Vector
from dynssm_ros.evaluation.coefficients import coefficient_label, range_used, resting
from dynssm_ros.evaluation.metrics import explained
from dynssm_ros.evaluation.regimes import liveliest
from dynssm_ros.reporting.tables import percent, text
from dynssm_ros.signals.signal_map import STATE_SIGNALS
from dynssm_ros.vehicle import COEFFICIENTS, Vehicle

SYMBOLS = {"v_x": "$v_x$", "v_y": "$v_y$", "omega": r"$\omega$"}
UNITS = {"v_x": "m/s", "v_y": "m/s", "omega": "rad/s"}
MEASURED = "#1a1a1a"
OUTSIDE = "#e9e9e9"  # of the bounds
NO_MODEL = "#9a9a9a"
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#332288", "#882255", "#999933")
WIDTH = 9.6  # inches; the width of a report's text
MAX_POINTS = 1500  # more points on a line than this are not seen
_ROOM_FOR_TICKS = 30  # letters of tick labels in a third of the width
OUTLYING = 3.0  # a model whose largest value exceeds the models' median by this factor may leave the panel
MAX_BAR = 2.0  # bars end at this multiple of persistence, and say how long they are
STYLE: dict[Any, Any] = {
    "font.size": 9.5,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.edgecolor": "#666666",
    "grid.color": "#e6e6e6",
    "grid.linewidth": 0.7,
    "xtick.color": "#444444",
    "ytick.color": "#444444",
    "legend.frameon": False,
    "lines.linewidth": 1.3,
}
_FORMULA = re.compile(r"([^$]|\$(\\omega|[A-Za-z]+_(\w|\{\w+\}))\$)*")  # texts whose only formulas are symbols of ours
Drawn = TypeVar("Drawn")
_P = ParamSpec("_P")


def styled(draw: Callable[_P, Figure]) -> Callable[_P, Figure]:
    """Decorator: draws in the package's style, and names of users, with ``$`` in them, as they are."""

    @wraps(draw)
    def in_style(*args: _P.args, **kwargs: _P.kwargs) -> Figure:
        with mpl.rc_context(STYLE):
            return names_as_they_are(draw(*args, **kwargs))

    return in_style


def names_as_they_are(figure: Figure) -> Figure:
    """Has texts drawn as formulas only where these are symbols with an index or omega; what else has ``$`` is a name."""
    for each in figure.findobj(Text):
        each.set_parse_math(_FORMULA.fullmatch(each.get_text()) is not None)
    return figure


def sheet(height: float, rows: int = 1, columns: int = 1, **grid: Any) -> tuple[Figure, Any]:
    """A figure as wide as a report's text, and its panel or array of panels, as ``Figure.subplots`` gives them."""
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    return figure, figure.subplots(rows, columns, **grid)


def legend_above(figure: Figure, panel: Axes, ncols: int = 4) -> Figure:
    """Explains what is drawn in one panel above all of them."""
    figure.legend(*panel.get_legend_handles_labels(), loc="outside upper left", ncols=ncols)
    return figure


def label(channel: str, what: str = "") -> str:
    """A channel of the state, or ``what`` of it, with its unit."""
    return f"{SYMBOLS[channel]}{what} ({UNITS[channel]})"


def model_colours(names: list[str]) -> dict[str, str]:
    """A colour for each model, grey for persistence."""
    others = [name for name in names if name != "persistence"]
    return {"persistence": NO_MODEL} | {name: PALETTE[k % len(PALETTE)] for k, name in enumerate(others)}


def model_lines(models: Mapping[str, Drawn]) -> Iterator[tuple[str, Drawn, dict[str, Any]]]:
    """Name and values of each model, and the style of its lines; the first model lies on top."""
    colours = model_colours(list(models))
    for depth, (name, values) in enumerate(models.items()):
        yield name, values, {"color": colours[name], "zorder": 3 - 0.1 * depth, "label": name}


@styled
def predicted_and_measured(time: Vector, measured: Vector, predicted: Mapping[str, Vector]) -> Figure:
    """One-step predictions over the liveliest 12 s: values at the left, errors at the right; ``time`` in s."""
    shown = liveliest(time, measured, 12.0)
    figure, axes = sheet(6.2, 3, 2, sharex=True)
    t = time[shown]
    for k, channel in enumerate(STATE_SIGNALS):
        values, errors = axes[k]
        values.plot(t, measured[shown, k], color=MEASURED, lw=2.2, alpha=0.75, label="measured")
        for _, states, style in model_lines(predicted):
            values.plot(t, states[shown, k], lw=1.0, **style)
            errors.plot(t, states[shown, k] - measured[shown, k], lw=1.0, **style)
        errors.axhline(0.0, color=MEASURED, lw=0.8)
        values.set_ylabel(label(channel))
        errors.set_ylabel(label(channel, " error"))
    axes[0, 0].set_title("Predicted one step ahead, and measured")
    axes[0, 1].set_title("Error: predicted minus measured")
    for bottom in axes[2]:
        bottom.set_xlabel("time (s)")
    figure.align_ylabels()
    return legend_above(figure, axes[0, 0])


@styled
def increments(current: Vector, measured: Vector, predicted: Mapping[str, Vector]) -> Figure:
    """Predicted against measured change of the state from ``current`` on, a row of panels per model."""
    shown = {name: states for name, states in predicted.items() if name != "persistence"} or dict(predicted)
    colours = model_colours(list(predicted))
    figure, axes = sheet(0.5 + 2.6 * len(shown), len(shown), 3, squeeze=False)
    truth = measured - current
    every = slice(None, None, max(1, len(truth) // 4000))
    for row, (name, states) in zip(axes, shown.items(), strict=True):
        share = explained(truth, states - current)
        for k, channel in enumerate(STATE_SIGNALS):
            panel: Axes = row[k]
            limit = max(float(np.percentile(np.abs(truth[:, k]), 99.7)), 1e-12) * 1.05
            panel.plot([-limit, limit], [-limit, limit], color=MEASURED, lw=0.8)
            panel.axhline(0.0, color=NO_MODEL, lw=0.8, ls="--")
            dots: dict[str, Any] = {"color": colours[name], "ms": 2.5, "alpha": 0.35, "mew": 0, "rasterized": True}
            panel.plot(truth[every, k], (states - current)[every, k], ".", **dots)
            panel.set(xlim=(-limit, limit), ylim=(-limit, limit))
            worth = f"{percent(share[k])} explained" if share[k] > 0 else "none explained"
            panel.set_title(f"{SYMBOLS[channel]}: {worth}", fontsize=9.5)
            panel.set_xlabel(f"measured change ({UNITS[channel]})")
            panel.locator_params(nbins=4)
            panel.ticklabel_format(style="sci", scilimits=(-3, 3), useMathText=True)
        row[0].set_ylabel(f"{name}\npredicted change")
    return figure


@styled
def relative_errors(rmse: Mapping[str, Vector], std: Mapping[str, Vector], persistence: Vector) -> Figure:
    """One-step RMSE ``(3,)`` as a share of persistence's; shorter is better, beyond 100 % is worse than no model."""
    names = [name for name in rmse if name != "persistence"] or list(rmse)
    colours = model_colours(names)
    figure, panel = sheet(1.3 + 0.26 * len(names) * 3)
    thickness = 0.8 / len(names)
    longest = 1.0
    small: dict[str, Any] = {"fontsize": 8.5, "bbox": {"facecolor": "white", "lw": 0, "pad": 0.8}}
    for k, name in enumerate(names):
        share, spread = (
            np.divide(values[name], persistence, out=np.full(3, np.nan), where=persistence > 0)
            for values in (rmse, std)
        )
        drawn = np.minimum(np.nan_to_num(share, nan=0.0, posinf=MAX_BAR), MAX_BAR)
        longest = max(longest, float(drawn.max()))
        places = np.arange(3) - 0.4 + thickness * (k + 0.5)
        panel.barh(places, drawn, 0.86 * thickness, color=colours[name], label=name)
        for place, value, end, whisker in zip(places, share, drawn, spread, strict=True):
            written = (percent(value) if np.isfinite(value) else "not finite") + (" (cut)" if value > end else "")
            whole = value == end and whisker > 0
            if whole:
                panel.errorbar(end, place, xerr=whisker, color=MEASURED, lw=1.0, capsize=2.5)
            tip = end + whisker if whole else end
            panel.annotate(written, (tip, place), (4, 0), textcoords="offset points", va="center", **small)
    panel.axvline(1.0, color=MEASURED, lw=1.0, ls="--")
    panel.annotate("persistence", (1.0, -0.55), (4, 0), textcoords="offset points", va="center", **small)
    panel.set_yticks(
        range(3), [f"{SYMBOLS[c]}\n100 % = {v:.3g} {UNITS[c]}" for c, v in zip(STATE_SIGNALS, persistence, strict=True)]
    )
    panel.set(xlim=(0, 1.12 * longest), ylim=(2.5, -0.7), xlabel="one-step RMSE relative to persistence")
    panel.xaxis.set_major_formatter(PercentFormatter(1.0, symbol=" %"))
    panel.grid(axis="y", visible=False)
    return legend_above(figure, panel)


@styled
def rollout_growth(time: Vector, errors: Mapping[str, Vector], std: Mapping[str, Vector]) -> Figure:
    """How the error grows with the ``time`` ahead (s): RMSE of the states, and mean displacement, each ``(n, 4)``."""
    figure, axes = sheet(5.4, 2, 2, sharex=True)
    titles = [*(label(channel, ": RMSE") for channel in STATE_SIGNALS), "Displacement: mean distance (m)"]
    for k, (panel, title) in enumerate(zip(axes.flat, titles, strict=True)):
        for name, values, style in model_lines(errors):
            shown, spread = np.where(np.isfinite(values[:, k]), values[:, k], np.nan), std[name][:, k]
            panel.plot(time, shown, marker="o", ms=3, **style)
            if spread.any():
                panel.fill_between(time, shown - spread, shown + spread, alpha=0.2, lw=0, **style | {"label": ""})
        panel.set_title(title)
        panel.set_xlim(left=0.0)
        panel.set_ylim(0.0, room({name: values[:, k] for name, values in errors.items()}))
    for panel in axes[1]:
        panel.set_xlabel("time ahead (s)")
    return legend_above(figure, axes[0, 0])


@styled
def adapted_parameters(time: Vector, theta: Vector, vehicle: Vehicle) -> Figure:
    """Adapted coefficients ``(N, 17)`` over ``time`` (s), cut where that has holes; what is outside the bounds is shaded."""
    figure, axes = sheet(9.6, 6, 3, sharex=True)
    axes = axes.ravel()
    every = slice(None, None, max(1, len(time) // MAX_POINTS))
    abscissa, values = cut_at_holes(time[every], theta[every])
    for k, name in enumerate(COEFFICIENTS):
        panel: Axes = axes[k]
        lower, upper = vehicle.lower[k], vehicle.upper[k]
        margin = 0.12 * (upper - lower)
        panel.axhspan(lower - margin, lower, color=OUTSIDE, lw=0, label="outside the bounds")
        panel.axhspan(upper, upper + margin, color=OUTSIDE, lw=0)
        panel.axhline(vehicle.nominal[k], color=MEASURED, lw=0.8, ls="--", label="nominal value")
        panel.set_ylim(lower - margin, upper + margin)
        panel.plot(abscissa, values[:, k], color=PALETTE[0], lw=1.0, label="adapted")
        panel.set_title(coefficient_label(name, _symbol(name)))
        panel.locator_params(axis="y", nbins=4)
    for spare in axes[len(COEFFICIENTS) :]:
        spare.set_axis_off()
    for lowest in axes[-3:]:
        lowest.set_xlabel("time (s)")
    axes[-1].legend(*axes[0].get_legend_handles_labels(), loc="upper left")
    return figure


@styled
def parameter_usage(theta: Vector, vehicle: Vehicle) -> Figure:
    """How much of its range each of adapted coefficients ``(N, 17)`` uses, and whether it rests on a bound."""
    low, q1, median, q3, high = np.percentile(range_used(theta, vehicle), [1, 25, 50, 75, 99], axis=0)
    at_bound = resting(theta, vehicle).mean(axis=0)
    places = np.arange(len(COEFFICIENTS))
    figure, panel = sheet(5.2)
    panel.barh(places, high - low, 0.3, left=low, color=PALETTE[0], alpha=0.35, label="1 % to 99 % of the time")
    panel.barh(places, q3 - q1, 0.6, left=q1, color=PALETTE[0], label="middle half of the time")
    panel.plot(median, places, "|", color="white", ms=8, mew=1.5)
    panel.plot(range_used(vehicle.nominal, vehicle), places, "D", color=MEASURED, ms=4.5, mfc="white", label="nominal")
    for place, share in zip(places, at_bound, strict=True):
        if share > 0.01:
            panel.annotate(f"{percent(share)} of the time on a bound", (1.03, place), va="center", fontsize=8.5)
    panel.axvspan(-0.02, 0.0, color=OUTSIDE, lw=0)
    panel.axvspan(1.0, 1.02, color=OUTSIDE, lw=0)
    panel.set_yticks(places, [_symbol(name) for name in COEFFICIENTS])
    panel.set(xlim=(-0.02, 1.02 if at_bound.max() <= 0.01 else 1.3), ylim=(len(COEFFICIENTS) - 0.4, -0.6))
    panel.set_xticks(np.linspace(0, 1, 6))
    panel.xaxis.set_major_formatter(PercentFormatter(1.0, symbol=" %"))
    panel.set_xlabel("position inside the admissible range")
    panel.grid(axis="y", visible=False)
    return legend_above(figure, panel, ncols=3)


@styled
def latency_histogram(samples: Mapping[str, Vector], unit: str = "µs", what: str = "time per prediction") -> Figure:
    """Distribution of latencies on a logarithmic axis, with median and 99th percentile in the legend.

    ``samples`` are by model (or stage) name, each of any length, positive, of a ``unit``; ``what`` was measured.
    """
    colours = model_colours(list(samples))
    everything = np.concatenate(list(samples.values()))
    edges = np.geomspace(everything.min() * 0.95, everything.max() * 1.05, 70)
    figure, panel = sheet(3.2)
    for name, values in samples.items():
        p50, p99 = np.percentile(values, [50, 99])
        words = f"{name}: p50 {text(float(p50))} {unit}, p99 {text(float(p99))} {unit}"
        panel.hist(values, edges.tolist(), color=colours[name], alpha=0.75, label=words)
        panel.axvline(p50, color=colours[name], lw=1.0)
        panel.axvline(p99, color=colours[name], lw=1.0, ls=":")
    panel.set_xscale("log")
    panel.xaxis.set_major_formatter(ScalarFormatter())
    panel.set(xlabel=f"{what} ({unit})", ylabel="calls")
    return legend_above(figure, panel, ncols=2)


@styled
def regime_errors(labels: Sequence[str], what: str, rmse: Mapping[str, Vector], std: Mapping[str, Vector]) -> Figure:
    """One-step RMSE ``(R, 3)`` in each of ``R`` driving regimes, a panel per channel; ``what`` tells the regimes apart."""
    figure, axes = sheet(2.9, 1, 3)
    places = np.arange(len(labels))
    bars: dict[str, Any] = {"marker": "o", "ms": 3.5, "lw": 0.8, "elinewidth": 1.2, "capsize": 2.5}
    for k, (panel, channel) in enumerate(zip(axes, STATE_SIGNALS, strict=True)):
        for depth, (name, values, style) in enumerate(model_lines(rmse)):
            shown = np.where(np.isfinite(values[:, k]), values[:, k], np.nan)
            whiskers = np.where(std[name][:, k] > 0, std[name][:, k], np.nan)
            panel.errorbar(places + 0.06 * (depth - (len(rmse) - 1) / 2), shown, whiskers, **bars, **style)
        panel.set_title(label(channel, ": RMSE"))
        panel.set_xticks(places, labels)
        if sum(map(len, labels)) > _ROOM_FOR_TICKS:
            panel.tick_params(axis="x", rotation=50)
        panel.set_xlabel(what)
        panel.set_xlim(-0.5, len(labels) - 0.5)
        panel.set_ylim(0.0, room({name: values[:, k] for name, values in rmse.items()}))
        panel.grid(axis="x", visible=False)
    return legend_above(figure, axes[0])


def cut_at_holes(x: Vector, values: Vector) -> tuple[Vector, Vector]:
    """Inserts a NaN row wherever ``x`` jumps, so that a line is not drawn across."""
    steps = np.diff(x)
    typical = float(np.median(steps)) if len(steps) else 1.0
    holes = np.flatnonzero((steps > 2.5 * typical) | (steps < 0)) + 1
    return np.insert(x, holes, np.nan), np.insert(values, holes, np.nan, axis=0)


def room(models: Mapping[str, Vector]) -> float:
    """Upper end of an axis for magnitudes of models: persistence is seen, and all models but those far worse than most."""
    finite = {name: values[np.isfinite(values)] for name, values in models.items()}
    largest = {name: float(values.max()) for name, values in finite.items() if len(values)}
    usual = OUTLYING * np.median(list(largest.values())) if largest else 0.0
    kept = [value for name, value in largest.items() if value <= usual or name == "persistence"]
    return max(1.08 * max(kept, default=0.0), 1e-12)


def _symbol(name: str) -> str:
    stem, _, index = name.partition("_")
    return f"${stem}_{{{index}}}$"


@styled
def loss_components(history: Mapping[str, Sequence[float]], best_epoch: int) -> Figure:
    """The terms of the training objective over the epochs, the paper's loss figure.

    ``history`` is the mean loss per epoch by ``train/TERM`` and ``validation/TERM``; terms never used are left out.
    """
    terms = [key.removeprefix("train/") for key, values in history.items() if key.startswith("train/") and any(values)]
    figure, axes = sheet(2.0 * len(terms) + 0.6, len(terms), sharex=True, squeeze=False)
    axes = axes[:, 0]
    for axis, term in zip(axes, terms, strict=True):
        for part, colour in (("train", PALETTE[0]), ("validation", PALETTE[1])):
            values = history[f"{part}/{term}"]
            axis.semilogy(range(1, len(values) + 1), values, color=colour, label=part)
        axis.axvline(best_epoch, color=NO_MODEL, linewidth=1.0, linestyle=":")
        axis.set_ylabel(f"{term} loss")
    axes[0].legend(loc="upper right")
    axes[0].set_title(f"Loss components; the weights of epoch {best_epoch} (dotted) were kept")
    axes[-1].set_xlabel("epoch")
    return figure
