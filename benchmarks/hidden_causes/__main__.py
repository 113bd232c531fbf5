"""Runs the battery: ``python -m benchmarks.hidden_causes --out DIR``.

Continues after a kill, and writes the rates, the confusion matrix and a page that shows both.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import joblib

from benchmarks.hidden_causes import cases as drawn
from benchmarks.hidden_causes.cases import Case, cases
from benchmarks.hidden_causes.outcomes import Outcome, matrix, rates
from benchmarks.hidden_causes.page import FIGURE, PAGE, page
from benchmarks.hidden_causes.run import run_case
from dynssm_ros.errors import UserError
from dynssm_ros.files import replacing, write_json
from dynssm_ros.reporting.diagnosis_figures import confusion

_DPI = 130


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the battery; writes the rates, the figure and the page."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.hidden_causes",
        description=drawn.__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--out", type=Path, required=True, help="folder for drives, outcomes and battery.json")
    parser.add_argument("--page", type=Path, help=f"folder for {PAGE} and its figure; --out if not given")
    parser.add_argument("--count", type=int, default=130, help="number of cases")
    parser.add_argument("--seed", type=int, default=0, help="of the first case")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    options = parser.parse_args(arguments)
    listed = list(cases(options.seed, options.count))
    running = joblib.Parallel(n_jobs=options.jobs, return_as="generator")(
        joblib.delayed(run_case)(case, options.out) for case in listed
    )
    of: list[tuple[Case, Outcome | None]] = []
    for k, (case, outcome) in enumerate(zip(listed, running, strict=True), start=1):
        of.append((case, outcome))
        words = "cannot be driven"
        if outcome is not None:
            words = f"{', '.join(outcome.named) or 'none'}: {'right' if outcome.right else 'WRONG'}"
        print(f"[{k}/{len(listed)}] {case.name} -> {words}", flush=True)
    outcomes = [outcome for _, outcome in of if outcome is not None]
    if not outcomes:
        raise UserError(f"--count {options.count}: no case could be driven")
    about = {"seed": options.seed, "undriven": len(of) - len(outcomes), **rates(outcomes)}
    write_json(options.out / "battery.json", about | {"outcomes": [asdict(outcome) for outcome in outcomes]})
    folder = options.page or options.out
    with replacing(folder / FIGURE) as aside:
        confusion(*matrix(outcomes)).savefig(aside, format="png", dpi=_DPI, metadata={"Software": None})
    with replacing(folder / PAGE) as aside:
        aside.write_text(page(of, options.seed), encoding="utf-8")
    for name, value in about.items():
        print(f"{name}: {value}")


if __name__ == "__main__":
    main()
