"""Driving and diagnosing cases; what is done is kept."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from benchmarks.hidden_causes.cases import Case, cars, record
from benchmarks.hidden_causes.outcomes import Outcome, judge
from benchmarks.provenance import code_digest
from dynssm_ros.files import write_json
from dynssm_ros.identification.diagnose import diagnose
from dynssm_ros.signals.recording import Recording
from dynssm_ros.simulation.laps import SimulationError

_DRIVING = ("vehicle", "simulation")  # rooms
_JUDGING = (*_DRIVING, "diagnosis", "evaluation", "signals")


def run_case(case: Case, folder: Path) -> Outcome | None:
    """Drives and diagnoses a case, as far as ``folder`` has not its drive or its outcome; ``None``: cannot be driven."""
    done = kept(case, folder)
    if done.exists():
        content = json.loads(done.read_text(encoding="utf-8"))["outcome"]
        return None if content is None else _outcome(content)
    drive = folder / f"drives-{code_digest(record.__module__, _DRIVING)[:10]}" / f"{_name(case)}.parquet"
    try:
        if not drive.exists():
            record(case)[0].save(drive)
        outcome = judge(case, diagnose(Recording.load(drive), cars(case)[1], line=case.road.centre).causes)
    except SimulationError:
        outcome = None
    write_json(done, {"outcome": None if outcome is None else asdict(outcome)})
    return outcome


def kept(case: Case, folder: Path) -> Path:
    """Where the outcome of a case is, made by the present code."""
    return folder / f"outcomes-{code_digest(__name__, _JUDGING)[:10]}" / f"{_name(case)}.json"


def _name(case: Case) -> str:
    return case.name.replace("/", "_")


def _outcome(content: dict[str, Any]) -> Outcome:
    lists = {key: tuple(content[key]) for key in ("hidden", "named")}
    alternatives = {name: tuple(others) for name, others in content["alternatives"].items()}
    return Outcome(**content | lists | {"alternatives": alternatives})
