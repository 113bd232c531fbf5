"""The document of the races: tables with the paper's numbers beside, and the figures that were drawn of them."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from benchmarks.page import render, save_figure
from benchmarks.paper.document import MADE_BY
from benchmarks.paper.plan import MID_RANGE, Race
from benchmarks.paper.race_figures import lap_over_speed_scale
from benchmarks.paper.reference import ClosedLoop
from benchmarks.paper.results import Entry, Results
from benchmarks.paper.schedule import race_key
from benchmarks.paper.stale import signed
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
    with replacing(path) as aside:
        aside.write_text(signed(races_markdown(results, pictures), results.plan), encoding="utf-8")


def _sweeps(results: Results) -> list[list[str]]:
    """Names of measured races that differ in nothing but their speed_scale, in the plan's order."""
    alike: dict[str, list[str]] = {}
    for name in results.races:
        told_apart = {"title", "text", "paper", "speed_scale", "figures"}
        alike.setdefault(results.plan.races[name].model_dump_json(exclude=told_apart), []).append(name)
    return [names for names in alike.values() if len(names) >= _SWEEP]


def _over_pace(results: Results, names: list[str]) -> Figure:
    """Their lap times, what the line allows, and the paper's."""
    races, driven = [results.plan.races[name] for name in names], [results.races[name] for name in names]
    models = [model for model in races[0].models if model in driven[0]["models"]]
    over = list(zip((race.speed_scale for race in races), driven, strict=True))
    laps = {
        _NAMES.get(model, model): {speed_scale: entry["models"][model]["lap_time_s"] for speed_scale, entry in over}
        for model in models
    }
    bounds = {
        "the line at its own speed": {speed_scale: entry["line_lap_time_s"] for speed_scale, entry in over},
        "the same with no more than full throttle": {
            speed_scale: entry["line_full_throttle_s"] for speed_scale, entry in over
        },
    }
    published = {
        f"{name}, the paper's": row.lap_time for race in races for name, row in _published(results, race).items()
    }
    return lap_over_speed_scale(laps, bounds, {name: lap for name, lap in published.items() if lap is not None})


def races_markdown(results: Results, pictures: Mapping[str, Mapping[str, str]]) -> str:
    """The document.

    Args:
        results: of a run.
        pictures: addresses of the figures by race and kind.
    """
    return render(
        "results_race",
        captions=_CAPTIONS,
        made_by=MADE_BY,
        protocol=results.made.protocol,
        quick=results.made.quick,
        races=[_race(results, name, pictures.get(name, {})) for name in results.plan.races],
    )


def _race(results: Results, name: str, pictures: Mapping[str, str]) -> dict[str, Any]:
    """What the page says of a race."""
    race, driven = results.plan.races[name], results.races.get(name)
    about: dict[str, Any] = {"title": race.title, "text": race.text, "speed_scale": race.speed_scale, "driven": driven}
    if driven is None:
        return about | {"why": results.reasons.get(race_key(name), "not run")}
    return about | {
        "effects": _effects(race),
        "table": race_table(race, driven, _published(results, race)).markdown(),
        "remarks": " ".join(filter(None, [_said(driven["models"]), claimed(results, race, driven["models"])])),
        "pictures": pictures,
    }


def _effects(race: Race) -> str:
    return ", ".join(
        f"{each.name} ({', '.join(f'{key} {value:g}' for key, value in each.parameters.items())})"
        for each in race.effects
    )


def race_table(race: Race, driven: Entry, published: Mapping[str, ClosedLoop]) -> Table:
    """The models of a race, the paper's rows first.

    Args:
        race: as planned.
        driven: as it came out.
        published: the paper's rows by the names to show.
    """
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
    rows: list[list[Value]] = [
        [f"{name}, the paper's", _lap(None if row.violation else row.lap_time), "yes" if row.violation else "no",
         row.mean_v_x, row.mean_abs_v_y, row.mean_abs_omega, row.steering_total_variation, None, None, None]
        for name, row in published.items()
    ]  # fmt: skip
    for model in race.models:
        if model not in driven["models"]:
            continue
        row = driven["models"][model]
        rows.append(
            [_NAMES.get(model, f"`{model}`"), _lap(row["lap_time_s"]), "yes" if row["violation"] else "no", row["mean_v_x"],
             row["mean_abs_v_y"], row["mean_abs_omega"], row["steering_total_variation"], row["solve_ms"]["p50"],
             row["solve_ms"]["p99"], row["infeasible"] + row["late"]]
        )  # fmt: skip
    return Table(columns, rows)


def _published(results: Results, race: Race) -> dict[str, ClosedLoop]:
    """The paper's rows for a race."""
    rows = dict(results.reference.closed_loop[race.paper]) if race.paper else {}
    if race.ablation:
        rows |= {f"DynSSM, {name}": row for name, row in results.reference.closed_loop_ablation.items()}
    return rows


def _said(models: Mapping[str, Entry]) -> str:
    """What became of each model against the plant's own, and why laps ended."""
    lost = [f"{_name(model)} {row['failure']}" for model, row in models.items() if row["failure"]]
    said = [f"Not completed: {'; '.join(lost)}."] if lost else []
    mark = models[TRUE]["lap_time_s"] if TRUE in models else None
    others = {m: row["lap_time_s"] for m, row in models.items() if m != TRUE and row["lap_time_s"] is not None}
    if mark is not None and others:
        listed = ", ".join(f"{_name(model)} {100 * (lap / mark - 1):+.2f} %" for model, lap in others.items())
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
        f"The paper's claim: up to {100 * results.reference.claims.lap_time:.1f} % faster than the published models. Here "
        f"`{car.paper}` is faster by {', '.join(gains) or 'nothing that could be compared'}."
    )


def _lap(seconds: float | None) -> str:
    """A lap time to the millisecond: models differ by little."""
    return "–" if seconds is None else f"{seconds:.3f}"


def _name(model: str) -> str:
    return f"`{model}`"
