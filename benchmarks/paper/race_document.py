"""The document of the races: tables with the paper's numbers beside, and the figures that were drawn of them."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from benchmarks.page import render, save_figure
from benchmarks.paper.document import write_signed
from benchmarks.paper.figures import lap_over_speed_scale
from benchmarks.paper.plan import MID_RANGE, Race
from benchmarks.paper.results import Entry, Results
from benchmarks.paper.schedule import race_key
from dynssm_ros.control.race_models import TRUE
from dynssm_ros.files import replacing
from dynssm_ros.reporting.tables import Column, Table, Value
from dynssm_ros.runtime.baselines import Persistence, SingleTrack, SingleTrackEwma

_NAMES = {
    TRUE: "the plant's own model",
    MID_RANGE: "fixed: the middle of the bounds",
    SingleTrack.name: "fixed: calibrated on the training laps",
    SingleTrackEwma.name: "calibrated, less its recent errors",
    Persistence.name: "no model: what is stays",
}
_CAPTIONS = {
    "trajectories": "Paths, with marks at equal times",
    "profiles": "State and commands over the lap",
    "forces": "Forces over the lap",
    "coefficients": "What each model told the controller over the lap",
    "speed_scale": "Lap time over the factor on the line's speed; hollow at the top: not completed",
}
_SWEEP = 3  # races that differ in nothing but their speed_scale and make a figure together
_MEANS = ("mean_v_x", "mean_abs_v_y", "mean_abs_omega", "steering_total_variation")


def write_races(results: Results, root: Path, path: Path) -> None:
    """Writes the document to ``path``, and copies the figures of the run in ``root`` beside it."""
    pictures: dict[str, dict[str, str]] = {}
    for name, race in results.plan.races.items():
        pictures[name] = {}
        for figure in race.figures if name in results.races else ():
            pictures[name][figure] = f"{path.stem}_{name}_{figure}.png"
            with replacing(path.with_name(pictures[name][figure])) as aside:
                shutil.copyfile(root / race_key(name) / f"{figure}.png", aside)
    for names in _sweeps(results):
        pictures[names[-1]]["speed_scale"] = f"{path.stem}_{names[0]}_pace.png"
        save_figure(_over_pace(results, names), path.with_name(pictures[names[-1]]["speed_scale"]), tight=True)
    races = [_race(results, name, pictures.get(name, {})) for name in results.plan.races]
    write_signed(render("results_race", captions=_CAPTIONS, results=results, races=races), results.plan, path)


def _sweeps(results: Results) -> list[list[str]]:
    """Names of measured races that differ in nothing but their speed_scale, in the plan's order."""
    alike: dict[str, list[str]] = {}
    for name in results.races:
        told_apart = {"title", "text", "paper", "speed_scale", "figures"}
        alike.setdefault(results.plan.races[name].model_dump_json(exclude=told_apart), []).append(name)
    return [names for names in alike.values() if len(names) >= _SWEEP]


def _over_pace(results: Results, names: list[str]) -> Figure:
    """Their lap times, what the line allows, and the paper's."""
    races = [results.plan.races[name] for name in names]
    driven = {race.speed_scale: results.races[name] for race, name in zip(races, names, strict=True)}
    laps = {
        _NAMES.get(model, model): {scale: entry["models"][model]["lap_time_s"] for scale, entry in driven.items()}
        for model in races[0].models
        if model in results.races[names[0]]["models"]
    }
    bounds = {
        words: {scale: entry[key] for scale, entry in driven.items()}
        for words, key in (
            ("the line at its own speed", "line_lap_time_s"),
            ("the same with no more than full throttle", "line_full_throttle_s"),
        )
    }
    published = {name: row["lap_time"] for race in races for name, row in _published(results, race).items()}
    return lap_over_speed_scale(laps, bounds, published)


def _race(results: Results, name: str, pictures: Mapping[str, str]) -> dict[str, Any]:
    race, driven = results.plan.races[name], results.races.get(name)
    about: dict[str, Any] = {"plan": race, "driven": driven, "pictures": pictures}
    if driven is None:
        return about | {"why": results.reasons.get(race_key(name), "not run")}
    return about | {
        "table": race_table(race, driven, _published(results, race)).markdown(),
        "remarks": " ".join(filter(None, [_said(driven["models"]), claimed(results, race, driven["models"])])),
    }


def race_table(race: Race, driven: Entry, published: Mapping[str, Entry]) -> Table:
    """The models of a race as it came out, below ``published``, the paper's rows by the names to show."""
    columns = (
        Column("model"),
        Column("lap", "s"),
        Column("violation"),
        Column("v_x", "m/s", "mean"),
        Column("|v_y|", "m/s", "mean"),
        Column("|ω|", "rad/s", "mean"),
        Column("steering variation", "rad"),
        Column("p50", "ms", "control step"),
        Column("p99", "ms", "control step"),
        Column("missing plans"),
    )

    def row(name: str, lap: float | None, entry: Entry, *steps: Value) -> list[Value]:
        shown = "–" if lap is None else f"{lap:.3f}"  # to the millisecond: models differ by little
        return [name, shown, "yes" if entry["violation"] else "no", *map(entry.get, _MEANS), *steps]

    rows = [
        row(name, None if entry["violation"] else entry["lap_time"], entry, None, None, None)
        for name, entry in published.items()
    ]
    for model in race.models:
        if entry := driven["models"].get(model):
            steps = (*entry["solve_ms"].values(), entry["infeasible"] + entry["late"])
            rows.append(row(_NAMES.get(model, f"`{model}`"), entry["lap_time_s"], entry, *steps))
    return Table(columns, rows)


def _published(results: Results, race: Race) -> dict[str, Entry]:
    rows = dict(results.reference["closed_loop"][race.paper]) if race.paper else {}
    if race.ablation:
        rows |= {f"DynSSM, {name}": row for name, row in results.reference["closed_loop_ablation"].items()}
    return {f"{name}, the paper's": row for name, row in rows.items()}


def _said(models: Mapping[str, Entry]) -> str:
    """What became of each model against the plant's own, and why laps ended."""
    lost = [f"`{model}` {row['failure']}" for model, row in models.items() if row["failure"]]
    said = [f"Not completed: {'; '.join(lost)}."] if lost else []
    mark = models[TRUE]["lap_time_s"] if TRUE in models else None
    others = {m: row["lap_time_s"] for m, row in models.items() if m != TRUE and row["lap_time_s"] is not None}
    if mark is not None and others:
        listed = ", ".join(f"`{model}` {100 * (lap / mark - 1):+.2f} %" for model, lap in others.items())
        said.append(f"Lap time against the plant's own model: {listed}.")
    return " ".join(said)


def claimed(results: Results, race: Race, models: Mapping[str, Entry]) -> str:
    """The paper's claim on lap times beside what its model does here, where its table is set beside."""
    car = results.plan.cars[results.plan.splits[race.split].car]
    laps = {model: row["lap_time_s"] for model, row in models.items() if row["lap_time_s"] is not None}
    if not race.paper or car.paper not in laps:
        return ""
    own, rivals = laps[car.paper], [rival for rival in (car.ddm, car.fthd) if rival in laps]
    gains = [f"{100 * (1 - own / laps[rival]):+.2f} % than `{rival}`" for rival in rivals]
    return (
        f"The paper's claim: up to {100 * results.reference['claims']['lap_time']:.1f} % faster than the published models. "
        f"Here `{car.paper}` is faster by {', '.join(gains) or 'nothing that could be compared'}."
    )
