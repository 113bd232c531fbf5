"""``dynssm paper``: everything that the paper's evaluation has and more, measured anew, as two documents."""

from __future__ import annotations

import os
import platform
from collections.abc import Sequence
from datetime import datetime, timezone
from importlib.metadata import version
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from benchmarks.paper.document import write
from benchmarks.paper.plan import load_plan
from benchmarks.paper.race_document import write_races
from benchmarks.paper.reference import load_reference
from benchmarks.paper.results import Made, read_results
from benchmarks.paper.runner import Outcome, code_digest, run
from benchmarks.paper.schedule import steps_of
from benchmarks.paper.steps import Step
from dynssm_ros import __version__
from dynssm_ros.cli.console import console, errors, progress_bar
from dynssm_ros.errors import UserError


def paper(
    out: Annotated[
        Path,
        typer.Option(
            help="Folder of the run: recordings, models, scores; what is done there is kept.", file_okay=False
        ),
    ] = Path("out/paper"),
    results: Annotated[
        Path | None,
        typer.Option(help="Document to write, figures beside it.", show_default="results.md in --out", dir_okay=False),
    ] = None,
    data: Annotated[
        Path | None,
        typer.Option(help="Folder with the measured logs and tracks.", envvar="DYNSSM_DATA", file_okay=False),
    ] = None,
    test: Annotated[
        list[str] | None,
        typer.Option(
            help="A recording of the car to predict after training on the whole log.", metavar="NAME=R.parquet"
        ),
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="A few epochs, one seed: tries everything out.")] = False,
    plan: Annotated[
        Path | None, typer.Option(help="Another plan than benchmarks/paper/plan.yaml.", dir_okay=False)
    ] = None,
    jobs: Annotated[int, typer.Option(help="Processes side by side.", min=1)] = 2,
) -> None:
    """Measure all models anew and write the tables with the paper's numbers beside; continues after a kill."""
    given = dict(_named_recording(each) for each in test or [])
    wanted = load_plan(plan).with_tests(given)
    wanted = wanted.shortened() if quick else wanted
    reference = load_reference()
    steps = steps_of(wanted, data, given)
    with progress_bar("paper") as progress:

        def told(step: Step, outcome: Outcome, done: int, total: int) -> None:
            if outcome.fresh or outcome.cause == step.key:
                errors.print(f"{done}/{total} {_words(step, outcome)}", soft_wrap=True)
            progress(done, total, step.title)

        outcomes = run(steps, out, jobs, told)
    document = out / "results.md" if results is None else results
    done = [(step, outcomes[step.key]) for step in steps if outcomes[step.key].state == "done"]
    stale = sum(outcome.code != code_digest(type(step)) for step, outcome in done)
    made = Made({"Made": _origin([outcome for _, outcome in done])}, quick, (stale, len(done)))
    found = read_results(wanted, reference, out, steps, outcomes, made)
    write(found, document)
    written = str(document)
    if wanted.races:
        races = document.with_name(f"{document.stem}_race.md")
        write_races(found, out, races)
        written = f"{document} and {races}"
    console.print(f"{written} written; {_times(steps, outcomes)}", markup=False, soft_wrap=True)
    failed = [step for step in steps if outcomes[step.key].state == "failed" and outcomes[step.key].cause == step.key]
    if failed:
        raise UserError(
            f"{len(failed)} of {len(steps)} steps failed, the first: {failed[0].title}: {outcomes[failed[0].key].reason}"
        )


def _named_recording(text: str) -> tuple[str, Path]:
    name, _, path = text.partition("=")
    if not (name and path) or "/" in name:
        raise UserError(f"--test {text}: expected NAME=R.parquet")
    return name, Path(path)


def _words(step: Step, outcome: Outcome) -> str:
    if outcome.state == "done":
        return f"{escape(step.title)}: {outcome.seconds:.1f} s"
    return f"[red]{escape(step.title)}: {escape(outcome.reason)}[/red]"


def _origin(done: Sequence[Outcome]) -> str:
    """When, on what and by which versions."""
    libraries = ", ".join(f"{name} {version(name)}" for name in ("torch", "onnxruntime", "numpy"))
    code = f"dynssm_ros {__version__}, Python {platform.python_version()}, {libraries}"
    machine = f"{os.cpu_count()} cores ({_processor()})"
    hours = sum(outcome.seconds for outcome in done) / 3600
    return f"{datetime.now(timezone.utc):%Y-%m-%d} by {code}, on {machine}; {hours:.2g} hours of one core"


def _processor() -> str:
    """The name of the processor, as far as the system tells it."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text(encoding="utf-8").splitlines() if cpuinfo.is_file() else []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.machine())


def _times(steps: Sequence[Step], outcomes: dict[str, Outcome]) -> str:
    """Where the time went."""
    kinds: dict[str, float] = {}
    for step in steps:
        kind = type(step).__name__.lower()
        kinds[kind] = kinds.get(kind, 0.0) + outcomes[step.key].seconds
    return ", ".join(f"{kind} {seconds:.0f} s" for kind, seconds in kinds.items())
