"""Driving and diagnosing a case."""

from __future__ import annotations

import json
import time
from dataclasses import asdict, replace
from pathlib import Path

from pydantic import TypeAdapter

from benchmarks.hidden_causes.cases import Case, drive, vehicle_file
from benchmarks.hidden_causes.outcomes import Outcome, judge
from dynssm_ros.files import write_json
from dynssm_ros.identification.result.diagnose import diagnose
from dynssm_ros.signals.recording import Recording
from dynssm_ros.simulation.laps import SimulationError


def run_case(case: Case, folder: Path) -> None:
    """Drives and diagnoses a case; its outcome is ``null`` if the car cannot be driven."""
    laps = folder / "drives" / f"{_name(case)}.parquet"
    try:
        if not laps.exists():
            drive(case).save(laps)
        file, begun = vehicle_file(case), time.process_time()
        found = diagnose(Recording.load(laps), file, line=case.road.centre)
        seconds = time.process_time() - begun
        off = () if found.recalibration is None else tuple(one.name for one in found.recalibration.coefficients)
        outcome = judge(case, found.causes, found.minimum_detectable)
        outcome = replace(outcome, verdict=found.verdict, wrong=case.wrong, off=off, seconds=seconds)
    except SimulationError:
        outcome = None
    write_json(outcome_file(case, folder), {"outcome": None if outcome is None else asdict(outcome)})


def outcome_file(case: Case, folder: Path) -> Path:
    """Where the outcome of a case is written."""
    return folder / "outcomes" / f"{_name(case)}.json"


def read_outcome(case: Case, folder: Path) -> Outcome | None:
    """What became of a case; ``None``: it cannot be driven, or was not."""
    file = outcome_file(case, folder)
    content = json.loads(file.read_text(encoding="utf-8"))["outcome"] if file.exists() else None
    return TypeAdapter(Outcome | None).validate_python(content)


def _name(case: Case) -> str:
    return case.name.replace("/", "_")
