"""Figures over the track: errors on the map and along the lap, and paths that models predict.

As those of :mod:`~dynssm_ros.reporting.evaluation_figures`, which gives the style.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from dynssm_ros.arrays import Vector
from dynssm_ros.reporting.evaluation_figures import (
    MEASURED,
    WIDTH,
    label,
    legend_above,
    model_lines,
    room,
    sheet,
    styled,
)
from dynssm_ros.signals.signal_map import STATE_SIGNALS
from dynssm_ros.track.lap_position import rms_along

_ENLARGED = 1000.0  # at most; what is smaller then is no difference


@styled
def error_map(x: Vector, y: Vector, errors: Vector, smooth: int = 1) -> Figure:
    """Errors ``(N, 3)`` at positions (m), one map per channel; the largest are drawn last.

    Shown is the root mean square over ``smooth`` rows; 1 shows each row's absolute error.
    """
    width, height = float(np.ptp(x)), float(np.ptp(y))
    shape = np.clip(height / max(width, 1e-9), 0.25, 2.0)
    figure, axes = sheet(1.3 + 0.29 * WIDTH * shape, 1, 3, sharex=True, sharey=True)
    smooth = min(smooth, len(x))
    known = np.nan_to_num(errors, nan=0.0, posinf=0.0, neginf=0.0)
    for k, (panel, channel) in enumerate(zip(axes, STATE_SIGNALS, strict=True)):
        size = np.sqrt(np.convolve(known[:, k] ** 2, np.full(smooth, 1 / smooth), mode="same"))
        order = np.argsort(size)
        top = max(float(np.percentile(size, 99)), 1e-12)
        dots = panel.scatter(
            x[order], y[order], c=size[order], s=7, cmap="viridis_r", vmin=0.0, vmax=top, lw=0, rasterized=True
        )
        bar = figure.colorbar(dots, ax=panel, location="top", extend="max", shrink=0.9, aspect=28)
        bar.set_label(label(channel, " error"))
        bar.locator = MaxNLocator(4)
        bar.update_ticks()
        panel.set_aspect("equal")
        panel.set_xlabel("x (m)")
        panel.locator_params(nbins=5)
    axes[0].set_ylabel("y (m)")
    return figure


@styled
def trajectories(time: Vector, measured: Vector, predicted: Mapping[str, Vector]) -> Figure:
    """Predicted paths that leave the measured one, end to end: the plan at the left, how far they stray at the right.

    Args:
        time: of the measured positions (s), shape ``(P * n + 1,)``.
        measured: positions (m), shape ``(P * n + 1, 2)``.
        predicted: by model name ``(P, n + 1, 2)``; path ``k`` of ``n`` steps leaves from position ``k * n``.
    """
    pieces, points, _ = next(iter(predicted.values())).shape
    rows = np.arange(pieces)[:, None] * (points - 1) + np.arange(points)
    tangent = np.gradient(measured, axis=0)
    tangent /= np.maximum(np.hypot(*tangent.T), 1e-12)[:, None]
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    strays = {name: paths - measured[rows] for name, paths in predicted.items()}
    extent = max(float(np.hypot(*np.ptp(measured, axis=0))), 1e-9)
    across = {name: (stray * normal[rows]).sum(axis=2) for name, stray in strays.items()}
    ahead = {name: (stray * tangent[rows]).sum(axis=2) for name, stray in strays.items()}
    farthest = room({name: np.hypot(*stray.T) for name, stray in strays.items()})
    factor = _round_number(min(0.3 * extent / farthest, _ENLARGED))

    figure = Figure(figsize=(WIDTH, 4.6), layout="constrained")
    axes = figure.subplot_mosaic([["plan", "sideways"], ["plan", "along"]])
    plan, sideways, along = axes["plan"], axes["sideways"], axes["along"]
    along.sharex(sideways)
    sideways.tick_params(labelbottom=False)
    plan.plot(*measured.T, color=MEASURED, lw=2.2, alpha=0.75, label="measured")
    plan.plot(*measured[rows[:, 0]].T, ".", color=MEASURED, ms=4)
    at = _joined(time[rows][..., None])[:, 0]
    for name, stray, style in model_lines(strays):
        plan.plot(*_joined(measured[rows] + factor * stray).T, lw=1.1, **style)
        sideways.plot(at, _joined(across[name][..., None]), lw=1.1, **style)
        along.plot(at, _joined(ahead[name][..., None]), lw=1.1, **style)
    for panel, values in ((sideways, across), (along, ahead)):
        limit = room({name: np.abs(each) for name, each in values.items()})
        panel.set_ylim(-limit, limit)
    low, high = measured.min(axis=0) - 0.15 * extent, measured.max(axis=0) + 0.15 * extent
    plan.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    plan.set_title("Plan" if factor == 1 else f"Plan, differences drawn {factor:g} times as large")
    plan.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
    plan.set_anchor("N")
    sideways.set_title("Predicted path to the left of the measured one (m)")
    along.set_title("Predicted path ahead of the measured one (m)")
    along.set_xlabel("time (s)")
    return legend_above(figure, plan)


@styled
def errors_along_lap(
    position: Vector, speed: Vector, errors: Mapping[str, Vector], length: float, bins: int = 80
) -> Figure:
    """One-step errors ``(N, 3)`` over the position on a lap of ``length`` (m), below the speed driven there (m/s).

    A point is the root mean square over one of ``bins`` stretches of equal length.
    """
    centres = (np.arange(bins) + 0.5) * length / bins
    figure, (top, *panels) = sheet(6.6, 4, sharex=True, height_ratios=[0.7, 1, 1, 1])
    top.plot(centres, rms_along(position, speed[:, None], length, bins), color=MEASURED, lw=1.3)
    top.set_ylabel("speed (m/s)")
    along = {
        name: rms_along(position, np.where(np.isfinite(values), values, np.nan), length, bins)
        for name, values in errors.items()
    }
    for k, (panel, channel) in enumerate(zip(panels, STATE_SIGNALS, strict=True)):
        for _, values, style in model_lines(along):
            panel.plot(centres, values[:, k], lw=1.2, **style)
        panel.set_ylabel(label(channel, " error"))
        panel.set_ylim(0.0, room({name: values[:, k] for name, values in along.items()}))
    panels[-1].set_xlabel("position on the lap (m)")
    panels[-1].set_xlim(0.0, length)
    figure.align_ylabels()
    return legend_above(figure, panels[0])


def _joined(paths: Vector) -> Vector:
    """Paths ``(P, n, C)`` as one line ``(P * (n + 1), C)`` that is cut between them."""
    return np.pad(paths, ((0, 0), (0, 1), (0, 0)), constant_values=np.nan).reshape(-1, paths.shape[2])


def _round_number(value: float) -> float:
    """The largest of 1, 2, 5, 10, 20, 50 ... that does not exceed ``value``; at least 1."""
    power = 10.0 ** np.floor(np.log10(max(value, 1.0)))
    return float(power * max(step for step in (1, 2, 5) if step * power <= max(value, 1.0)))
