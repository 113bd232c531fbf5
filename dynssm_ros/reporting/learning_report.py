"""The report of a whole learning: a verdict on data, car, diagnosis and model, then figures of the steps' own reports."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from pydantic import Field

from dynssm_ros.configuration import StrictModel
from dynssm_ros.reporting.page import Report, Section, State, Verdict, figures_of
from dynssm_ros.reporting.tables import Column, Table, text
from dynssm_ros.signals.recording import COLUMN_UNITS, Recording
from dynssm_ros.signals.signal_map import STATE_SIGNALS

_FIGURES = {
    "evaluation": ("Predicted and measured", "Rollouts", "Where"),
    "diagnosis": ("Simulated and measured", "Improvement", "Errors over time"),
}
"""Sections of the steps' reports, by the beginnings of their titles."""
_NOTES = 8  # of the data that are shown


class StepRecord(StrictModel):
    """What became of a step."""

    name: str
    command: str
    key: str = Field(description="of the command and of what it read")
    outputs: tuple[str, ...]
    seconds: float
    notes: tuple[str, ...] = Field(default=(), description="lines of its output that tell what to look at")
    failure: str = Field(default="", description="error line; empty if it did not fail")


def learning_report(out: Path, records: Sequence[StepRecord], holdout: float) -> Report:
    """The page ``OUT/index.html`` of the steps in the folder ``out``."""
    verdicts = [*_verdicts(out, records)]
    worst = next((state for state in ("wrong", "look") if any(each.state == state for each in verdicts)), "ok")
    summary = {
        "ok": "Nothing stands out.",
        "look": "There is something to look at before you rely on it.",
        "wrong": "Something is wrong; what stands below it in the list depends on it.",
    }[worst]
    sections = [*_figures(out), *_steps(records)]
    protocol = {
        "Split": f"the last {100 * holdout:g} % of each recording only test; the vehicle file says so to every step",
        "Again": "the same command continues, and does again what depends on a changed input, as on a corrected signals.yaml",
    }
    return Report("What was learned", summary, sections, protocol, verdicts=verdicts)


def _verdicts(out: Path, records: Sequence[StepRecord]) -> Iterator[Verdict]:
    of = {name: [each for each in records if each.name == name] for name in _JUDGES}
    yield from (judge(out, of) for judge in (_data, _car, _diagnosis, _model))


def _failed(of: dict[str, list[StepRecord]], *names: str) -> str:
    """The error of one of the steps, or that it was not reached; empty if all are done."""
    failures = [each.failure for name in names for each in of[name] if each.failure]
    if failures:
        return failures[0]
    return "" if all(of[name] for name in names) else "not reached"


def _data(out: Path, of: dict[str, list[StepRecord]]) -> Verdict:
    link = next((str(page.relative_to(out)) for page in sorted(out.glob("inspection/*/report.html"))), "")
    if failure := _failed(of, "inspect", "extract"):
        signals = "; if a signal is wrong, correct signals.yaml beside the inspection and run the same command again"
        return Verdict("data", "wrong", failure + (signals if of["extract"] else ""), link)
    lines = [line for name in ("inspect", "extract", "calibrate") for each in of[name] for line in each.notes]
    few = list(dict.fromkeys(line.split(": ", 1)[1] for line in lines))
    told, contradictory = _recorded([each.outputs[0] for each in of["extract"]])
    if not few:
        return Verdict("data", "ok", f"{told}; the checks found nothing", link)
    more = [f"and {len(few) - _NOTES} more"] if len(few) > _NOTES else []
    return Verdict("data", "wrong" if contradictory else "look", f"{told}. " + "; ".join([*few[:_NOTES], *more]), link)


def _recorded(files: Sequence[str]) -> tuple[str, bool]:
    """How much was recorded, in words, and whether signals contradict each other somewhere."""
    recordings = list(map(Recording.load, files))
    seconds = sum(each.duration for each in recordings)
    words = f"{len(recordings)} recording{'s' * (len(recordings) > 1)}, {seconds:.0f} s"
    return words, any(each.info.findings for each in recordings)


def _car(out: Path, of: dict[str, list[StepRecord]]) -> Verdict:
    if failure := _failed(of, "calibrate"):
        return Verdict("car", _failure_state(failure), failure)
    found = _read(out / "calibration.json")
    pairs = [(name, found["rmse_ahead"][name], found["persistence"][name]) for name in STATE_SIGNALS]
    told = ", ".join(
        f"{name} {text(error)} {COLUMN_UNITS[name]} ({text(still)} if nothing changed)" for name, error, still in pairs
    )
    told = f"calibrated; {found['horizon_s']:.2g} s ahead it errs by {told}"
    if any(0 < still <= error for _, error, still in pairs):
        return Verdict("car", "wrong", f"{told}: no better than that nothing changes")
    if found["on_bound"]:
        bounds = f"on a bound: {', '.join(found['on_bound'])}, so the data want more than the vehicle file admits"
        return Verdict("car", "look", f"{told}; {bounds}")
    return Verdict("car", "ok", told)


def _diagnosis(out: Path, of: dict[str, list[StepRecord]]) -> Verdict:
    if failure := _failed(of, "diagnose"):
        return Verdict("diagnosis", _failure_state(failure), failure)
    found, link = _read(out / "diagnosis" / "results.json"), "diagnosis/report.html"
    causes = "; ".join(
        f"{cause['effect']} ({', '.join(_value(name, value) for name, value in cause['parameters'].items())})"
        for cause in found["causes"]
    )
    nearest = " and ".join(effect["effect"] for effect in found["nearest_effects"])
    off = found["moved"] or [effect["effect"] for effect in found["small_effects"]]
    state, words = {
        "cause": ("look", f"the simulation lacks {causes}; the model's car has it"),
        "healthy": ("ok", "the simulation is right within the noise"),
        "recalibrate": (
            "look",
            f"off in the calibrated car: {', '.join(off)}; the model's car is recalibrated",
        ),
        "unexplained": (
            "look",
            "something is systematically wrong that no effect of the library explains"
            + (f"; nearest is {nearest}, which the model's car has" if nearest else ""),
        ),
    }[found["verdict"]]
    return Verdict("diagnosis", state, words, link)  # type: ignore[arg-type]


def _value(name: str, value: dict[str, Any]) -> str:
    unit = "" if value["unit"] == "1" else f" {value['unit']}"
    return f"{name} {text(value['value'])}{unit}" + (f" ± {text(value['std'])}" if value["std"] is not None else "")


def _model(out: Path, of: dict[str, list[StepRecord]]) -> Verdict:
    if failure := _failed(of, "train", "evaluate"):
        return Verdict("model", _failure_state(failure), failure)
    found, link = _read(out / "evaluation" / "results.json"), "evaluation/report.html"
    ade = {name: model["ade"] for name, model in found["models"].items()}
    mine = next(iter(ade))
    told = f"{found['horizon_s']:.2g} s ahead the path errs by " + ", ".join(
        f"{text(error)} m ({name})" for name, error in ade.items() if error is not None
    )
    if found["not_tests"]:
        return Verdict("model", "look", f"{told}. No test: {'; '.join(found['not_tests'])}", link)
    if ade[mine] is None or ade[mine] >= (ade["persistence"] or 0.0):
        return Verdict("model", "wrong", f"{told}: no better than that nothing changes", link)
    if ade[mine] > (ade["single_track"] or float("inf")):
        return Verdict("model", "look", f"{told}: what was learned beside the car does not help on these laps", link)
    return Verdict("model", "ok", f"{told}, on laps that nothing was fitted to", link)


def _failure_state(failure: str) -> State:
    return "look" if failure == "not reached" else "wrong"


_JUDGES = ("inspect", "extract", "calibrate", "diagnose", "train", "evaluate")


def _figures(out: Path) -> Iterator[Section]:
    for step, titles in _FIGURES.items():
        page = out / step / "report.html"
        if os.path.isfile(page):
            yield from (section for section in figures_of(page) if section.title.startswith(titles))


def _steps(records: Sequence[StepRecord]) -> Iterator[Section]:
    table = Table.of(
        records,
        (Column("step"), lambda each: each.name),
        (Column("time", "s"), lambda each: each.seconds),
        (Column("command"), lambda each: each.command),
    )
    yield Section("Steps", "Each can be repeated alone.", table=table)


def _read(path: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return content
