"""The generalisation matrix as numbers, a heat map and a page."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from benchmarks.matrix.scored_cells import Cell
from benchmarks.matrix.scores import BASELINES
from benchmarks.page import render
from dynssm_ros.learning.earned_layer import GAIN_WANTED

QUANTITIES = ("v_x", "v_y", "omega", "ADE", "FDE")
EXACT = 1e-5
"""Where the best baseline errs less than this, the car is known exactly and ratios mean nothing (m/s, rad/s, m)."""

Known = Mapping[Cell, Mapping[str, Any]]


def errors(content: Mapping[str, Any], model: str) -> np.ndarray:
    """One-step RMSE of each channel, ADE and FDE of a model in a cell."""
    score = content["scores"][model]
    return np.array([*score["rmse"], score["ade"], score["fde"]])


def ratios(content: Mapping[str, Any], model: str, without: tuple[str, ...] = ()) -> np.ndarray:
    """Errors of a model over those of the best baseline but some for each quantity; NaN where that is exact."""
    best = np.min([errors(content, name) for name in BASELINES if name not in without], axis=0)
    return np.where(best < EXACT, np.nan, errors(content, model) / np.maximum(best, 1e-300))


def summary(known: Known) -> dict[str, Any]:
    """For development and test cells: each model's geometric means and worst cells, coverage, exact cells."""
    return {part: _summary({c: v for c, v in known.items() if c.is_test == test}) for part, test in _PARTS.items()}


_PARTS = {"development": False, "test": True}


def _summary(known: Known) -> dict[str, Any]:
    if not known:
        return {"cells": 0}
    models = list(next(iter(known.values()))["scores"])
    noisy = {cell: cell.noise for cell in known if cell.noise is not None and min(cell.noise) > 0}
    out: dict[str, Any] = {"cells": len(known), "models": {}}
    for model in models:
        entry: dict[str, Any] = {}
        for label, without in (("over_best", ()), ("over_best_but_rls", ("rls",))):
            each = np.array([ratios(content, model, without) for content in known.values()])
            means = np.exp(np.nanmean(np.log(np.maximum(each, 1e-12)), axis=0))
            worst = np.nanmax(each, axis=0)
            entry[label] = {
                "one_step": float(np.exp(np.mean(np.log(means[:3])))),
                "by_quantity": dict(zip(QUANTITIES, means.tolist(), strict=True)),
                "worst": dict(zip(QUANTITIES, worst.tolist(), strict=True)),
                "worst_cell": [list(known)[int(np.nanargmax(each[:, k]))].name for k in range(len(QUANTITIES))],
            }
        exact = [
            float(errors(content, model)[:4].max())
            for content in known.values()
            if errors(content, "single_track")[:4].max() < EXACT
        ]
        entry["exact_cells"], entry["worst_exact"] = len(exact), max(exact, default=None)
        covered = [content["scores"][model]["coverage"] for content in known.values()]
        if all(each is not None for each in covered):
            entry["coverage"] = [float(np.min(covered)), float(np.mean(covered)), float(np.max(covered))]
        if over_noise := [errors(known[cell], model)[:3] / np.array(noise) for cell, noise in noisy.items()]:
            entry["over_noise"] = np.exp(np.mean(np.log(np.maximum(over_noise, 1e-12)), axis=0)).tolist()
        out["models"][model] = entry
    gains = [content["network_gain"].get("dynssm") for content in known.values()]
    known_gains = [gain for gain in gains if gain is not None]
    out["network_used"] = [sum(gain >= GAIN_WANTED for gain in known_gains), len(known_gains)]
    return out


def heat_map(known: Known, model: str = "dynssm") -> Figure:
    """Ratio of a model's errors to the best baseline's, a row for each cell: to those without ``rls``, and to all."""
    cells = sorted(known, key=lambda cell: (cell.training.simulated is not None, cell.name))
    figure = Figure(figsize=(9.6, 1.4 + 0.17 * len(cells)), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    for panel, without, title in zip(panels, (("rls",), ()), ("without rls", "rls among them"), strict=True):
        values = np.array([ratios(known[cell], model, without) for cell in cells])
        shown = panel.imshow(np.log2(values), cmap="RdBu_r", vmin=-1.5, vmax=1.5, aspect="auto")
        for i, j in np.ndindex(values.shape):
            value = values[i, j]
            ink = "white" if np.isfinite(value) and abs(np.log2(value)) > 0.9 else "black"
            words = f"{value:.2f}" if np.isfinite(value) else "exact"
            panel.text(j, i, words, ha="center", va="center", fontsize=6, color=ink)
        panel.set_xticks(range(len(QUANTITIES)), QUANTITIES, fontsize=7)
        panel.xaxis.tick_top()
        panel.grid(visible=False)
        panel.set_title(f"{model} over the best baseline, {title}", fontsize=8)
    names = [f"{cell.name}{' *' if cell.is_test else ''}" for cell in cells]
    panels[0].set_yticks(range(len(cells)), names, fontsize=6)
    bar = figure.colorbar(shown, ax=panels, shrink=0.3, ticks=(-1, 0, 1))
    bar.ax.set_yticklabels(["1/2", "1", "2"])
    bar.set_label("ratio of errors; below 1 is better (* test cell)", fontsize=7)
    return figure


def generalisation_page(known: Known, arguments: Sequence[str], figure: str, missing: int) -> str:
    """The results as Markdown; ``missing``: how many cells were not scored."""
    return render(
        "generalisation", arguments=arguments, baselines=BASELINES, figure=figure, gain_wanted=GAIN_WANTED,
        missing=missing, over_noise=_over_noise, parts=summary(known), quantities=list(QUANTITIES), rows=_rows,
    )  # fmt: skip


def _rows(content: Mapping[str, Any]) -> Iterator[list[str]]:
    """A row for each model of the cells of one part."""
    for model, entry in content["models"].items():
        over, other, covered = entry["over_best"], entry["over_best_but_rls"], entry.get("coverage")
        worst = max(over["worst"][name] for name in QUANTITIES[:3])
        means = [over["one_step"], *over["by_quantity"].values(), worst, over["worst"]["ADE"]]
        yield [
            f"`{model}`",
            *map(_ratio, means),
            f"{_ratio(other['one_step'])}, {_ratio(other['by_quantity']['ADE'])}",
            "–" if covered is None else f"{100 * covered[0]:.0f} to {100 * covered[2]:.0f} %",
        ]


def _over_noise(content: Mapping[str, Any]) -> str:
    """What of the errors is the sensors' noise, by model."""
    shown = ("dynssm", "rls", "single_track_ewma", "ridge")
    return "; ".join(
        f"{', '.join(f'{ratio:.2f}' for ratio in entry['over_noise'])} (`{name}`)"
        for name, entry in content["models"].items()
        if name in shown and "over_noise" in entry
    )


def _ratio(value: float) -> str:
    return f"{value:.3f}" if value < 100 else "diverges"
