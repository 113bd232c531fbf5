"""The robustness matrix as numbers, a figure and a page."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from benchmarks.matrix.raced_cells import CHANGES, LAPS, OBJECTIVES, PACE, Cell
from benchmarks.matrix.races import AS_IS, CALIBRATED, LEARNING_LAPS, TRUE_PACES
from benchmarks.matrix.scores import RIVALS
from benchmarks.page import render
from dynssm_ros.control.lap_learning import SAFE
from dynssm_ros.control.race_models import TRUE
from dynssm_ros.reporting.evaluation_figures import model_colours

_GOAL = 1.015
_CARS = {"orca": "the 1:43 car", "racer": "the 1:10 car", "av21": "the AV-21"}

Known = Mapping[Cell, Mapping[str, Any]]


def came_round(outcome: Mapping[str, Any]) -> bool:
    """Whether all laps were driven between the borders."""
    return bool(outcome["completed"]) and not outcome["violation"]


def last_lap(outcome: Mapping[str, Any]) -> float:
    """Time of the last lap (s); NaN if the car did not come round."""
    return float(outcome["lap_times_s"][-1]) if came_round(outcome) else float("nan")


def ratios(known: Known, model: str, to: str) -> np.ndarray:
    """Last lap of a model over that of another in each cell; NaN where one of them did not come round."""
    return np.array([last_lap(models[model]) / last_lap(models[to]) for models in known.values()])


def summary(known: Known) -> dict[str, Any]:
    """For development and test cells: how often models came round, and laps over those of ``true`` and ``calibrated``."""
    return {part: _summary(_those(known, "is_test", test)) for part, test in _PARTS.items()}


_PARTS = {"development": False, "test": True}


def _those(known: Known, attribute: str, value: Any) -> Known:
    """The outcomes of the cells that have this value."""
    return {cell: outcome for cell, outcome in known.items() if getattr(cell, attribute) == value}


def _with_evidence(known: Known) -> list[str]:
    """What is compared with the true model: all but those that are planned with as they are."""
    return [model for model in next(iter(known.values())) if model != TRUE and not model.endswith(AS_IS)]


def _summary(known: Known) -> dict[str, Any]:
    if not known:
        return {"cells": 0}
    possible = {cell: models for cell, models in known.items() if came_round(models[TRUE])}
    changed = {cell: models for cell, models in possible.items() if cell.change != "none"}
    out: dict[str, Any] = {"cells": len(known), "possible": len(possible), "models": {}}
    for model in next(iter(known.values())):
        over_true, over_calibrated, of_changed = (
            ratios(part, model, to) for part, to in ((possible, TRUE), (possible, CALIBRATED), (changed, CALIBRATED))
        )
        out["models"][model] = {
            "came_round": sum(came_round(models[model]) for models in possible.values()),
            "lost": [cell.name for cell, models in possible.items() if not came_round(models[model])],
            "over_true": _middle_and_worst(over_true),
            "over_calibrated": _middle_and_worst(over_calibrated),
            "over_calibrated_changed": _middle_and_worst(of_changed),
            "slowest": list(possible)[int(np.nanargmax(over_calibrated))].name
            if np.isfinite(over_calibrated).any()
            else "",
            "p99_ms": max(models[model]["solve_ms"]["p99"] for models in known.values()),
            "missing": sum(models[model]["infeasible"] + models[model]["late"] for models in known.values()),
        }
    return out


def _middle_and_worst(values: np.ndarray) -> list[float] | None:
    return [float(np.nanmedian(values)), float(np.nanmax(values))] if np.isfinite(values).any() else None


def lap_times(known: Known) -> Figure:
    """The last lap of each model over the true model's, a row for each cell."""
    possible = (cell for cell in known if came_round(known[cell][TRUE]))
    cells = sorted(possible, key=lambda cell: (cell.car, cell.change, cell.name))
    names = _with_evidence(known)
    colours = model_colours([TRUE, *names])
    figure = Figure(figsize=(9.6, 1.4 + 0.2 * len(cells)), layout="constrained")
    axes = figure.subplots()
    for name, marker in zip(names, "osD^v<>", strict=False):
        over = [last_lap(known[cell][name]) / last_lap(known[cell][TRUE]) for cell in cells]
        axes.scatter(over, range(len(cells)), s=22, marker=marker, color=colours[name], label=name, alpha=0.8)
    for row, cell in enumerate(cells):
        lost = [name for name in names if not came_round(known[cell][name])]
        if lost:
            axes.text(1.0, row, f"  lost: {', '.join(lost)}", fontsize=6, va="center")
    axes.axvline(1.0, color="black", lw=0.8)
    axes.set_yticks(range(len(cells)), [f"{cell.name}{' *' if cell.is_test else ''}" for cell in cells], fontsize=6)
    axes.set_ylim(len(cells) - 0.5, -0.5)
    axes.set_xlabel("last lap over the true model's (* test cell)")
    axes.legend(loc="upper right", fontsize=7)
    axes.grid(axis="x", alpha=0.3)
    return figure


def closed_loop_page(known: Known, arguments: Sequence[str], figure: str, asked: Sequence[Cell]) -> str:
    """The results as Markdown; ``asked``: the cells that the command with these arguments drives, done or not."""
    compared = _with_evidence(known)
    parts = []
    for label, part, missing in _parts(known, asked):
        content = _summary(part) if part else None
        rows = _rows(content) if content else []
        groups = [
            [name, str(len(group)), *(_both(_middle_and_worst(ratios(group, model, TRUE))) for model in compared)]
            for name, group in (_groups(part) if part else ())
        ]
        head = ["", "cells", *(f"`{model}`" for model in compared)]
        parts.append(
            {"label": label, "content": content, "rows": rows, "head": head, "groups": groups, "missing": missing}
        )
    return render(
        "closed_loop",
        arguments=arguments,
        cars=", ".join(_CARS[name] for name in dict.fromkeys(cell.car for cell in known)),
        figure=figure,
        laps=LAPS,
        paces=[f"{PACE[objective]:g}" for objective in OBJECTIVES],
        parts=parts,
        rivals=[name for name in RIVALS if name in next(iter(known.values()))],
    )


def _parts(known: Known, asked: Sequence[Cell]) -> Iterator[tuple[str, Known, str]]:
    """The parts of which cells are asked for: what is known of each, and in words what was not driven."""
    for label, test in _PARTS.items():
        part = _those(known, "is_test", test)
        missing = Counter(cell.car for cell in asked if cell.is_test == test and cell not in known)
        if part or missing:
            yield label.capitalize(), part, ", ".join(f"{count} of {_CARS[car]}" for car, count in missing.items())


def _rows(content: Mapping[str, Any]) -> list[list[str]]:
    """How each model did in the cells that the true model can drive."""
    over = ("over_true", "over_calibrated", "over_calibrated_changed")
    return [
        [f"`{model}`", f"{entry['came_round']} of {content['possible']}", *(_both(entry[key]) for key in over),
         f"{entry['p99_ms']:.1f}", str(entry["missing"])]
        for model, entry in content["models"].items()
    ]  # fmt: skip


def _both(values: Sequence[float] | None) -> str:
    return "–" if values is None else ", ".join(f"{value:.3f}" for value in values)


def _groups(part: Known) -> Iterator[tuple[str, Known]]:
    """Outcomes by what is hidden, by car if there are several, by objective, and all."""
    names = {"change": {change: change for change in CHANGES}}
    if len({cell.car for cell in part}) > 1:
        names["car"] = _CARS
    names["objective"] = {objective: objective for objective in OBJECTIVES}
    for attribute, values in names.items():
        for value, name in values.items():
            if group := _those(part, attribute, value):
                yield name, group
    yield "all", part


def learned_laps(known: Known) -> Figure:
    """Each lap over the true model's best, a line for each cell and a panel for each car."""
    cars = {car: over for car in _CARS if (over := _over_best(_those(known, "car", car)))}
    figure = Figure(figsize=(9.6, 3.4), layout="constrained")
    panels = figure.subplots(1, max(len(cars), 1), sharey=True, squeeze=False)[0]
    for axes, (car, over) in zip(panels, cars.items(), strict=False):
        for laps in over.values():
            axes.plot(range(1, len(laps) + 1), laps, color="C0", lw=0.7, alpha=0.5)
        median = np.median(list(over.values()), axis=0)
        axes.plot(range(1, len(median) + 1), median, color="black", lw=1.6, label="median")
        axes.axhspan(0.0, _GOAL, color="C2", alpha=0.12, lw=0, label="within 1.5 %")
        axes.set(
            title=f"{_CARS[car]}, {len(over)} cells", xlabel="lap", xticks=range(1, len(median) + 1), ylim=(0.95, 1.3)
        )
        axes.grid(alpha=0.3)
    panels[0].set_ylabel("lap over the true model's best")
    panels[-1].legend(loc="upper right", fontsize=8)
    return figure


def learning_page(known: Known, arguments: Sequence[str], figure: str, asked: Sequence[Cell]) -> str:
    """What learned lap by lap, as Markdown; see :func:`closed_loop_page`."""
    parts = []
    for label, part, missing in _parts(known, asked):
        behind = [f"{cell.name} ({laps[-1]:.3f})" for cell, laps in _over_best(part).items() if laps[-1] > _GOAL]
        rows = [_learning_row(name, group) for name, group in _groups(part)] if part else []
        parts.append({"label": label, "rows": rows, "behind": ", ".join(behind), "missing": missing})
    paces = ", ".join(f"{pace:g}" for pace in TRUE_PACES)
    return render(
        "lap_learning",
        arguments=arguments,
        figure=figure,
        laps=LEARNING_LAPS,
        paces=paces,
        parts=parts,
        safe=f"{SAFE:g}",
    )


def _over_best(part: Known) -> dict[Cell, np.ndarray]:
    """Laps over the true model's best, where the car came round and so did that."""
    return {
        cell: np.array(outcome["learned"]["lap_times_s"]) / outcome["true_best_s"]
        for cell, outcome in part.items()
        if came_round(outcome["learned"]) and outcome["true_best_s"] is not None
    }


def _learning_row(name: str, part: Known) -> list[str]:
    safe = sum(came_round(outcome["learned"]) for outcome in part.values())
    over = _over_best(part).values()
    first, last = (np.array([laps[k] for laps in over]) for k in (0, -1))
    laps = [f"{np.median(first):.3f}", f"{np.median(last):.3f}, {np.max(last):.3f}"] if over else ["–", "–"]
    return [name, str(len(part)), str(safe), *laps, f"{np.sum(last <= _GOAL)} of {len(over)}"]
