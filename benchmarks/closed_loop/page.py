"""The robustness matrix as numbers, a figure and a page."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from benchmarks.closed_loop.cells import CHANGES, LAPS, OBJECTIVES, PACE, Cell
from benchmarks.closed_loop.run import AS_IS, CALIBRATED, LEARNING_LAPS, TRUE_PACES
from benchmarks.generalisation.run import RIVALS
from dynssm_ros.control.lap_learning import SAFE
from dynssm_ros.control.race_models import TRUE
from dynssm_ros.reporting.evaluation_figures import model_colours

LEARNING_PAGE = "lap_learning.md"
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


def page(known: Known, arguments: Sequence[str], figure: str, asked: Sequence[Cell]) -> str:
    """The results as Markdown.

    Args:
        known: outcomes.
        arguments: of doit's command that differ from the default.
        figure: name of the figure's file.
        asked: the cells that the command drives, whether or not it has come to them.
    """
    return "\n".join(_lines(known, arguments, figure, asked)) + "\n"


def _lines(known: Known, arguments: Sequence[str], figure: str, asked: Sequence[Cell]) -> Iterator[str]:
    rivals = [name for name in RIVALS if name in next(iter(known.values()))]
    cars = ", ".join(_CARS[name] for name in dict.fromkeys(cell.car for cell in known))
    yield f"# Closed loop with rivals: {cars}" if rivals else "# Closed loop"
    yield ""
    tracking, progress = (f"{PACE[objective]:g}" for objective in OBJECTIVES)
    yield (
        f"Made by `{_command(arguments)}`. Each cell is {LAPS} laps of one car on a track that nothing was tuned on: a "
        "variation of a built-in one by a seed. One change of the car is hidden from the models. It is 20 % less grip on a "
        "third of the lap, 15 % less front grip, a steering offset of 0.02 rad, 10 % more mass, or half as much drag again. "
        "A hash of the cell's name draws the rest. The plant has steps of 1 ms or four wheels, noise is none, usual or three "
        f"times that, and delay none or a step. The car tracks at {tracking} of the limits or progresses at {progress}. "
        "Models were trained on another track, of the car without the change."
    )
    yield ""
    yield (
        "`true` knows the plant and the change. `calibrated` is the single-track car that the training calibrated. Models "
        "are planned with as far as they have earned it, and once more as they are. Decisions were taken on development "
        "cells; a hash of the name says which these are. Where the network earned nothing, `dynssm` is `rls`."
    )
    if rivals:
        yield ""
        yield (
            f"Rivals are {', '.join(f'`{name}`' for name in rivals)} ([what they are](rivals.md)), trained with what their "
            "authors chose for a car of about that size. Nothing of theirs was decided on these cells. "
            + ("`gp` corrects the calibrated car. " if "gp" in rivals else "")
            + "DDM and FTHD calibrate nothing. With evidence the calibrated car is stepped, and what they say beyond it is "
            "added as far as they have earned it. As they are, their own physics is stepped, with the vehicle file's nominal "
            "values, in Euler steps and without load transfer."
        )
    for label, part, missing in _parts(known, asked):
        yield ""
        if part:
            content = _summary(part)
            yield f"## {label.capitalize()} cells ({content['possible']} of {content['cells']})"
            yield from _results(content)
            yield from _grouped(part)
        else:
            yield f"## {label.capitalize()} cells"
        yield from missing
    yield ""
    yield f"![Last laps over the true model's]({figure})"


def _command(arguments: Sequence[str]) -> str:
    """By which a page is made."""
    return " ".join(["python -m doit -n 2 -f benchmarks/closed_loop/dodo.py", *arguments])


def _parts(known: Known, asked: Sequence[Cell]) -> Iterator[tuple[str, Known, list[str]]]:
    """The parts of which cells are asked for: what is known of each, and the lines that say what was not driven."""
    for label, test in _PARTS.items():
        part = _those(known, "is_test", test)
        missing = Counter(cell.car for cell in asked if cell.is_test == test and cell not in known)
        words = ", ".join(f"{count} of {_CARS[car]}" for car, count in missing.items())
        if part or missing:
            yield label, part, ["", f"Not driven: {words}."] if missing else []


def _results(content: Mapping[str, Any]) -> Iterator[str]:
    """How each model did in the cells that the true model can drive."""
    yield ""
    yield "Those in which the true model comes round between the borders."
    yield ""
    yield (
        "| model | comes round | last lap over `true`: median, worst | over `calibrated`: median, worst | "
        "changed cars, over `calibrated`: median, worst | worst p99 (ms) | plans missing |"
    )
    yield "| --- | --- | --- | --- | --- | --- | --- |"
    for model, entry in content["models"].items():
        over = " | ".join(_both(entry[key]) for key in ("over_true", "over_calibrated", "over_calibrated_changed"))
        yield (
            f"| `{model}` | {entry['came_round']} of {content['possible']} | {over} | {entry['p99_ms']:.1f} | "
            f"{entry['missing']} |"
        )
    if lost := {model: entry["lost"] for model, entry in content["models"].items() if entry["lost"]}:
        yield ""
        yield from (f"- `{model}` is lost in {', '.join(where)}." for model, where in lost.items())


def _grouped(part: Known) -> Iterator[str]:
    """Last laps over the true model's by what is hidden, by car and by objective."""
    models = _with_evidence(part)
    yield ""
    yield "Last lap over `true`, median and worst, of those that come round:"
    yield ""
    yield f"| | cells | {' | '.join(f'`{model}`' for model in models)} |"
    yield f"| --- | --- | {' | '.join('---' for _ in models)} |"
    for name, group in _groups(part):
        over = (_both(_middle_and_worst(ratios(group, model, TRUE))) for model in models)
        yield f"| {name} | {len(group)} | {' | '.join(over)} |"


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
    """What learned lap by lap, as Markdown; see :func:`page`."""
    return "\n".join(_learning_lines(known, arguments, figure, asked)) + "\n"


def _learning_lines(known: Known, arguments: Sequence[str], figure: str, asked: Sequence[Cell]) -> Iterator[str]:
    yield "# Faster every lap"
    yield ""
    yield (
        f"Made by `{_command([*arguments, 'learning_page'])}`. Each cell is driven for {LEARNING_LAPS} laps with "
        f"`dynssm`, beginning with {SAFE:g} of the car's limits ([how](../../docs/use/race.md#faster-every-lap)). The cells "
        "are those of the [matrix](closed_loop.md). The last lap is compared with the best of the true model, which knows "
        f"the plant and the change, at {', '.join(f'{pace:g}' for pace in TRUE_PACES)} of the limits."
    )
    for label, part, missing in _parts(known, asked):
        yield ""
        yield f"## {label.capitalize()} cells"
        if part:
            yield ""
            yield "| | cells | between the borders | first lap | last lap: median, worst | within 1.5 % |"
            yield "| --- | --- | --- | --- | --- | --- |"
            yield from (_learning_row(name, row) for name, row in _groups(part))
            if behind := [
                f"{cell.name} ({laps[-1]:.3f})" for cell, laps in _over_best(part).items() if laps[-1] > _GOAL
            ]:
                yield ""
                yield f"More than 1.5 % behind: {', '.join(behind)}."
        yield from missing
    yield ""
    yield f"![Laps over the true model's best]({figure})"


def _over_best(part: Known) -> dict[Cell, np.ndarray]:
    """Laps over the true model's best, where the car came round and so did that."""
    return {
        cell: np.array(outcome["learned"]["lap_times_s"]) / outcome["true_best_s"]
        for cell, outcome in part.items()
        if came_round(outcome["learned"]) and outcome["true_best_s"] is not None
    }


def _learning_row(name: str, part: Known) -> str:
    safe = sum(came_round(outcome["learned"]) for outcome in part.values())
    over = _over_best(part).values()
    first, last = (np.array([laps[k] for laps in over]) for k in (0, -1))
    middle = f"{np.median(first):.3f} | {np.median(last):.3f}, {np.max(last):.3f}" if over else "– | –"
    return f"| {name} | {len(part)} | {safe} | {middle} | {np.sum(last <= _GOAL)} of {len(over)} |"
