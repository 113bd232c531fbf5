"""The page of a sweep: all trials in a table, and what goes with a small error."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from dynssm_ros.evaluation.sweep import Sweep, Trial
from dynssm_ros.reporting.evaluation_figures import WIDTH, styled
from dynssm_ros.reporting.page import Report, Section
from dynssm_ros.reporting.tables import Column, Table, Value

_CAUTION = (
    "The best was chosen by these laps, so its error on them flatters it: compare it with the file as it was on other laps, "
    "and with other seeds."
)


def sweep_report(sweep: Sweep, protocol: Mapping[str, str]) -> Report:
    """The report of a sweep."""
    sections = [
        Section(
            "What goes with a small error",
            "A line is a trial, through its settings to its error; pale ones are worse. "
            "The thick one is the best, the dashed one the model file as it was.",
            parallel_coordinates(sweep),
        )
    ]
    failed = [trial for trial in sweep.trials if trial.errors is None]
    if failed:
        told = " ".join(f"Trial {trial.number}: {trial.failure.rstrip('.')}." for trial in failed)
        sections.append(Section("Failed trials", told))
    return Report("Sweep", f"{verdict(sweep)} {_CAUTION}", sections, protocol, trial_table(sweep))


def verdict(sweep: Sweep) -> str:
    """The best trial beside the first, in a sentence."""
    best, first = sweep.best, sweep.trials[0]
    assert best.errors is not None
    if first.errors is None or best.number == first.number:
        return f"Trial {best.number} of {len(sweep.trials)} is best: ADE {best.errors.ade:.4g} m."
    share = 100 * (best.errors.ade / first.errors.ade - 1)
    return (
        f"Trial {best.number} of {len(sweep.trials)} is best: ADE {best.errors.ade:.4g} m, {share:+.1f} % against "
        f"{first.errors.ade:.4g} m of the model file as it was."
    )


def trial_table(sweep: Sweep) -> Table:
    """All trials, the best first."""
    columns = (
        Column("trial", brief=True),
        *(Column(name.rpartition(".")[2], "", name.rpartition(".")[0]) for name in sweep.distributions),
        Column("ADE", "m", best="min", brief=True),
        Column("v_x", "m/s", "one-step RMSE", "min", brief=True),
        Column("v_y", "m/s", "one-step RMSE", "min", brief=True),
        Column("ω", "rad/s", "one-step RMSE", "min", brief=True),
    )
    trials = sorted(sweep.trials, key=lambda trial: trial.errors.ade if trial.errors else np.inf)
    return Table(
        columns, [_row(trial, list(sweep.distributions)) for trial in trials], "Trial 0 is the model file as it was."
    )


def _row(trial: Trial, names: list[str]) -> list[Value]:
    errors: list[Value] = [trial.errors.ade, *trial.errors.rmse] if trial.errors else [None] * 4
    settings = [trial.settings[name] for name in names]
    return [trial.number, *(str(each) if isinstance(each, bool) else each for each in settings), *errors]


@styled
def parallel_coordinates(sweep: Sweep) -> Figure:
    """Settings and error of all trials on parallel axes."""
    trials = [trial for trial in sweep.trials if trial.errors is not None]
    errors = np.array([trial.errors.ade for trial in trials if trial.errors])
    order = np.argsort(-errors)  # the best is drawn last
    axes_of = {
        name: _Axis([trial.settings[name] for trial in trials], _log(sweep, name)) for name in sweep.distributions
    }
    axes_of["ADE (m)"] = _Axis(list(errors), True)
    heights = np.array([axis.heights for axis in axes_of.values()])
    norm = LogNorm(errors.min(), max(errors.max(), errors.min() * 1.001))
    figure = Figure(figsize=(WIDTH, 4.0), layout="constrained")
    axes = figure.subplots()
    for k in order:
        best, first = k == order[-1], trials[k].number == 0
        colour = (0.15, 0.3, 0.55, 1.0 - 0.85 * float(norm(errors[k])))
        axes.plot(
            heights[:, k], color=colour, lw=2.5 if best else 1.0, ls="--" if first else "-", zorder=3 if best else 2
        )
    for place, axis in enumerate(axes_of.values()):
        axes.axvline(place, color="0.6", lw=0.8, zorder=1)
        for height, words in axis.ticks:
            box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 0.6}
            axes.annotate(
                words, (place, height), (4, 0), textcoords="offset points", va="center", fontsize=7, bbox=box, zorder=4
            )
    axes.set_xticks(range(len(axes_of)), [name.replace(".", ".\n") for name in axes_of])
    axes.set_xlim(-0.15, len(axes_of) - 0.6)
    axes.set_yticks([])
    for side in ("left", "right", "top", "bottom"):
        axes.spines[side].set_visible(False)
    axes.tick_params(length=0)
    return figure


def _log(sweep: Sweep, name: str) -> bool:
    return bool(getattr(sweep.distributions[name], "log", False))


class _Axis:
    """Values of a setting as heights from 0 to 1, with ticks."""

    def __init__(self, values: list[Any], log: bool) -> None:
        numbers = all(isinstance(value, (int, float)) and not isinstance(value, bool) for value in values)
        known = sorted(set(values), key=lambda value: (value,) if numbers else (str(value),))
        if numbers and len(known) > 6:
            low, high = float(known[0]), float(known[-1])
            scale = np.log if log else np.asarray
            span = float(scale(high) - scale(low))
            self.heights = [float(scale(value) - scale(low)) / span for value in values]
            between = np.geomspace(low, high, 5) if log else np.linspace(low, high, 5)
            self.ticks = [(k / 4, f"{value:.3g}") for k, value in enumerate(between)]
        else:
            steps = max(len(known) - 1, 1)
            self.heights = [known.index(value) / steps for value in values]
            self.ticks = [(k / steps, f"{value:g}" if numbers else str(value)) for k, value in enumerate(known)]
