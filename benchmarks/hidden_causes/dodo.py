"""The benchmark of hidden causes as doit's tasks: ``python -m doit -n 2 -f benchmarks/hidden_causes/dodo.py seed=1000``.

Variables: ``out`` (folder for drives and outcomes), ``page`` (folder for the page and its figure), ``seed`` (of the first
case), ``count`` (of cases), ``healthy=1`` (nothing is hidden in any), ``cars`` (those of some truths alone, separated by
commas: rk4, double_track, foreign, multi_body). What is done is kept; after a change of
the engine ``doit forget`` has it diagnosed again.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

from doit import get_var
from doit.tools import config_changed

from benchmarks.hidden_causes.cases import TRUTHS, cases
from benchmarks.hidden_causes.outcomes import matrix, rates
from benchmarks.hidden_causes.page import FIGURE, PAGE, page
from benchmarks.hidden_causes.run import outcome_file, read_outcome, run_case
from benchmarks.tasks import doit_config, save_figure
from dynssm_ros.errors import UserError
from dynssm_ros.files import replacing, write_json
from dynssm_ros.reporting.diagnosis_figures import confusion

SEED, COUNT = int(get_var("seed", "0")), int(get_var("count", "130"))
OUT = Path(get_var("out", "out/hidden_causes"))
PAGE_FOLDER = Path(get_var("page", str(OUT)))
HEALTHY = get_var("healthy", "0") == "1"
CARS = get_var("cars", ",".join(TRUTHS)).split(",")
if unknown := set(CARS) - set(TRUTHS):
    raise UserError(f"cars={','.join(CARS)}: {', '.join(sorted(unknown))} is none of {', '.join(TRUTHS)}")
CASES = [case for case in cases(SEED, COUNT, healthy=HEALTHY) if case.plant in CARS]
ASKED = (
    f"seed={SEED} count={COUNT}"
    + " healthy=1" * HEALTHY
    + (f" cars={','.join(CARS)}" if set(CARS) < set(TRUTHS) else "")
)
DOIT_CONFIG = doit_config(OUT / "doit.json")


def task_case() -> Iterator[dict[str, Any]]:
    """Drives and diagnoses each case."""
    for case in CASES:
        yield {
            "name": case.name,
            "actions": [(run_case, [case, OUT])],
            "targets": [str(outcome_file(case, OUT))],
            "uptodate": [config_changed(repr(case))],
        }


def task_page() -> dict[str, Any]:
    """Writes rates, confusion matrix and page of what is there."""
    return {"actions": [write_page], "uptodate": [False], "verbosity": 2}


def write_page() -> None:
    """The rates as JSON, the figure, and the page."""
    of = [(case, read_outcome(case, OUT)) for case in CASES]
    outcomes = [outcome for _, outcome in of if outcome is not None]
    if not outcomes:
        raise UserError(f"count={COUNT}: no case could be driven")
    about = {"seed": SEED, "undriven": len(of) - len(outcomes), **rates(outcomes)}
    write_json(OUT / "outcomes.json", about | {"outcomes": [asdict(outcome) for outcome in outcomes]})
    save_figure(confusion(*matrix(outcomes)), PAGE_FOLDER / FIGURE)
    with replacing(PAGE_FOLDER / PAGE) as aside:
        aside.write_text(page(of, ASKED), encoding="utf-8")
    for name, value in about.items():
        print(f"{name}: {value}")
