"""The paper's evaluation as doit's tasks: ``make paper``, or ``python -m doit -f benchmarks/paper/dodo.py out=DIR``.

Variables: ``out`` (folder of the run), ``data`` (measured logs and tracks), ``results`` (document to write), ``test``
(``NAME=R.parquet``, several apart by commas: recordings to predict after training on the whole log), ``quick=1`` (a few
epochs, one seed: tries everything out), ``plan`` (another plan than ``plan.yaml``).
"""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
from collections.abc import Iterator
from datetime import datetime, timezone
from importlib.metadata import version
from pathlib import Path
from typing import Any

from doit import get_var

from benchmarks.paper.document import write
from benchmarks.paper.plan import Plan, load_plan
from benchmarks.paper.race_document import write_races
from benchmarks.paper.reference import load_reference
from benchmarks.paper.results import Made, read_results
from benchmarks.paper.schedule import steps_of
from benchmarks.tasks import doit_config, split_available, tasks
from dynssm_ros import __version__
from dynssm_ros.errors import UserError

OUT = Path(get_var("out", "out/paper"))
DATA = get_var("data", os.environ.get("DYNSSM_DATA", ""))
RESULTS = Path(get_var("results", str(OUT / "results.md")))
QUICK = bool(get_var("quick", ""))
DOIT_CONFIG = doit_config(OUT / "doit.json")


def given_recordings(text: str) -> dict[str, Path]:
    """``NAME=R.parquet`` pairs apart by commas.

    Raises:
        UserError: not of that form.
    """
    given = {}
    for pair in filter(None, text.split(",")):
        name, _, path = pair.partition("=")
        if not (name and path) or "/" in name:
            raise UserError(f"test={pair}: expected NAME=R.parquet")
        given[name] = Path(path)
    return given


GIVEN = given_recordings(get_var("test", ""))


def wanted_plan() -> Plan:
    """The plan as it is asked for."""
    path = get_var("plan", "")
    plan = load_plan(Path(path) if path else None).with_tests(GIVEN)
    return plan.shortened() if QUICK else plan


PLAN = wanted_plan()
STEPS = steps_of(PLAN, Path(DATA) if DATA else None, GIVEN)


def task_step() -> Iterator[dict[str, Any]]:
    """Recordings, calibrations, trainings, scores, races, times."""
    available, reasons, causes = split_available(STEPS)
    for key in (key for key, cause in causes.items() if cause == key):
        print(f"left out: {key}: {reasons[key]}")
    yield from tasks(available, OUT)


def task_document() -> dict[str, Any]:
    """Writes the documents of what is there."""
    return {"actions": [write_documents], "uptodate": [False], "verbosity": 2}


def write_documents() -> None:
    """The tables of the models, and those of the races."""
    results = read_results(PLAN, load_reference(), OUT, STEPS, Made({"Page written": origin()}, QUICK))
    write(results, RESULTS)
    if PLAN.races:
        write_races(results, OUT, RESULTS.with_name(f"{RESULTS.stem}_race.md"))
    print(f"{RESULTS} written")


def origin() -> str:
    """When, on what and by which versions the page was written; a step is measured anew only if its settings change."""
    libraries = ", ".join(f"{name} {version(name)}" for name in ("torch", "onnxruntime", "numpy"))
    code = f"dynssm_ros {__version__}{commit()}, Python {platform.python_version()}, {libraries}"
    return f"{datetime.now(timezone.utc):%Y-%m-%d} by {code}, on {os.cpu_count()} cores ({processor()})"


def commit() -> str:
    """Of which commit the code is, or that it differs from it; nothing where there is no checkout."""
    git, code = shutil.which("git"), Path(__file__).parents[2]
    if git is None or not (code / ".git").exists():
        return ""
    told = ["rev-parse", "--short", "HEAD"], ["status", "--porcelain", "--", "dynssm_ros", "benchmarks", "config"]
    name, changed = (subprocess.check_output([git, *words], cwd=code, text=True).strip() for words in told)  # noqa: S603 - fixed words
    return f" at commit {name}{' with changes' if changed else ''}"


def processor() -> str:
    """The name of the processor, as far as the system knows it."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text(encoding="utf-8").splitlines() if cpuinfo.is_file() else []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.machine())
