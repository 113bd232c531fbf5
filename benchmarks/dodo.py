"""The long benchmarks as doit's tasks: ``python -m doit -n 2 -f benchmarks/dodo.py group=GROUP``.

Groups are ``paper`` (or ``make paper``), ``hidden_causes``, ``generalisation`` and ``closed_loop``. What is done is kept; a
kill costs the task under way. Variables of all groups:

- ``out``: folder of the run; ``out/GROUP`` if not given.
- ``page``: folder of the pages and their figures; that of the run if not given.
- ``data``: folder of measured logs and tracks; ``DYNSSM_DATA`` if not given.

Of ``paper``: ``test`` (``NAME=R.parquet``, several apart by commas: recordings to predict after training on the whole log
of the car that has their sampling time; the settings that were tried of a model are trained by ``step:searches/*``),
``quick=1`` (a few epochs, one seed: tries everything out), ``plan`` (another plan than ``plan.yaml``), ``results`` (file of
the first page). Of ``hidden_causes``: ``seed`` (of the first case), ``count`` (of cases), ``healthy=1`` (nothing is hidden
in any, and every third file of a known car has an axle wrong), ``seconds`` (of a drive), ``cars`` (those of some truths
alone, apart by commas), ``effects`` (those that are hidden, likewise), ``of_a_file`` (drives that share the file of a car
that nobody knows); after a change of the engine ``doit forget`` has cases diagnosed again. Of both matrices: ``only``
(words that names must begin with, apart by commas), ``part`` (``development``, the default, or ``all``: test cells too),
``sets`` (``shipped``, the default, ``ablations``, ``rivals``, apart by commas; rivals take a day). Of ``closed_loop`` also
``trained`` (folder of the generalisation matrix, which has the models, or gets those that it lacks) and ``models`` (those
of the sets that are driven); its tasks ``learn`` and ``learning_page`` run if they are named.
"""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from datetime import datetime, timezone
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

from doit import get_var

from benchmarks.hidden_causes.cases import TRUTHS, cases
from benchmarks.hidden_causes.outcomes import matrix, rates
from benchmarks.hidden_causes.page import confusion, hidden_causes_page
from benchmarks.hidden_causes.run import outcome_file, read_outcome, run_case
from benchmarks.logs import log_folder
from benchmarks.matrix import raced_cells, races, races_page, scored_cells, scores, scores_page
from benchmarks.matrix.ablations import ablations_page
from benchmarks.page import save_figure, save_page
from benchmarks.paper.document import write
from benchmarks.paper.plan import Plan, load_plan
from benchmarks.paper.race_document import write_races
from benchmarks.paper.results import read_results
from benchmarks.paper.schedule import steps_of
from benchmarks.tasks import days, doit_config, split_available, task, tasks
from dynssm_ros import __version__
from dynssm_ros.errors import UserError
from dynssm_ros.files import write_json
from dynssm_ros.runtime.artifact import CARD
from dynssm_ros.signals.recording import Recording
from dynssm_ros.vehicle.effects import EFFECTS

GROUP = get_var("group", "")
OUT = Path(get_var("out", f"out/{GROUP}"))
PAGES = Path(get_var("page", str(OUT)))
DATA = get_var("data", os.environ.get("DYNSSM_DATA", ""))
LOGS = Path(DATA or log_folder())


class Variables:
    """Variables of a group with their usual values."""

    def __init__(self, **usual: str) -> None:
        self._usual = usual
        self._values = {name: get_var(name, value) for name, value in usual.items()}

    def __getitem__(self, name: str) -> str:
        return str(self._values[name])

    def several(self, name: str, known: Iterable[str] = ()) -> tuple[str, ...]:
        """Values apart by commas.

        Raises:
            UserError: one of them is none of ``known``, unless that is empty.
        """
        values, known = tuple(filter(None, self[name].split(","))), tuple(known)
        if known and (unknown := sorted(set(values) - set(known))):
            raise UserError(f"{name}={self[name]}: {', '.join(unknown)} is none of {', '.join(known)}")
        return values

    @property
    def changed(self) -> list[str]:
        """Those that differ from the usual, as they stand on the command line."""
        return [f"{name}={value}" for name, value in self._values.items() if value != self._usual[name]]


def page_task(write_pages: Callable[[], None], after: Sequence[str] = ()) -> dict[str, Any]:
    """A task that writes pages of what is there, each time that it is asked for."""
    return {"actions": [write_pages], "task_dep": list(after), "uptodate": [False], "verbosity": 2}


class Paper:
    """The paper's evaluation."""

    def __init__(self) -> None:
        given = given_recordings(get_var("test", ""))
        path = get_var("plan", "")
        times = {name: Recording.load(recording).T_s for name, recording in given.items()}
        plan = load_plan(Path(path) if path else None).with_tests(times)
        self.quick = bool(get_var("quick", ""))
        self.plan: Plan = plan.shortened() if self.quick else plan
        self.steps = steps_of(self.plan, Path(DATA) if DATA else None, given)

    def task_step(self) -> Iterator[dict[str, Any]]:
        """Recordings, calibrations, trainings, scores, races, times."""
        available, reasons, causes = split_available(self.steps)
        for key in (key for key, cause in causes.items() if cause == key):
            print(f"left out: {key}: {reasons[key]}")
        yield from tasks(available, OUT)

    def task_document(self) -> dict[str, Any]:
        """Writes the pages of what is there."""
        return page_task(self.write)

    def write(self) -> None:
        path = Path(get_var("results", str(PAGES / "results.md")))
        made = f"Page written: {origin()}; trained and scored: {days(self.steps, OUT)}"
        results = read_results(self.plan, OUT, self.steps, made, self.quick)
        write(results, path)
        if self.plan.races:
            write_races(results, OUT, path.with_name(f"{path.stem}_race.md"))
        print(f"{path} written")


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


def origin() -> str:
    """When, on what and by which versions the page was written; a step is measured anew only if its settings change."""
    libraries = ", ".join(f"{name} {version(name)}" for name in ("torch", "onnxruntime", "numpy"))
    code = f"dynssm_ros {__version__}{commit()}, Python {platform.python_version()}, {libraries}"
    return f"{datetime.now(timezone.utc):%Y-%m-%d} by {code}, on {os.cpu_count()} cores ({processor()})"


def commit() -> str:
    """Of which commit the code is, or that it differs from it; nothing where there is no checkout."""
    git, code = shutil.which("git"), Path(__file__).parents[1]
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


class HiddenCauses:
    """Simulated drives in which something is hidden, diagnosed."""

    def __init__(self) -> None:
        usual = {"seed": "0", "count": "130", "healthy": "0", "seconds": "120", "of_a_file": "1", "effects": ""}
        self.variables = Variables(**usual, cars=",".join(TRUTHS))
        seed, count, of_a_file = (int(self.variables[name]) for name in ("seed", "count", "of_a_file"))
        cars = self.variables.several("cars", TRUTHS)
        healthy, seconds = self.variables["healthy"] == "1", float(self.variables["seconds"])
        effects = self.variables.several("effects", EFFECTS) or tuple(EFFECTS)
        every = cases(seed, count, effects, healthy=healthy, seconds=seconds, of_a_file=of_a_file)
        self.cases = [case for case in every if case.plant in cars]

    def task_case(self) -> Iterator[dict[str, Any]]:
        """Drives and diagnoses each case."""
        for case in self.cases:
            yield task(case.name, (run_case, [case, OUT]), outcome_file(case, OUT), repr(case))

    def task_page(self) -> dict[str, Any]:
        """Writes rates, confusion matrix and page of what is there."""
        return page_task(self.write)

    def write(self) -> None:
        of = [(case, read_outcome(case, OUT)) for case in self.cases]
        outcomes = [outcome for _, outcome in of if outcome is not None]
        if not outcomes:
            raise UserError(f"count={self.variables['count']}: no case could be driven")
        seed = int(self.variables["seed"])
        about = {"seed": seed, "undriven": len(of) - len(outcomes), **rates(outcomes)}
        write_json(OUT / "outcomes.json", about | {"outcomes": [asdict(outcome) for outcome in outcomes]})
        figure = save_figure(confusion(*matrix(outcomes)), PAGES / "hidden_causes_confusion.png")
        save_page(hidden_causes_page(of, self.variables.changed, figure), PAGES / "hidden_causes.md")


class Matrix:
    """Trainings, and models that are trained on them in the folder ``trained``."""

    def __init__(self, variables: Variables, trained: Path) -> None:
        self.variables, self.trained = variables, trained
        self.models = tuple(scores.models_of(variables.several("sets", scores.SETS)))
        self.trainings: dict[str, scored_cells.Training] = {}

    def wanted(self, name: str, is_test: bool) -> bool:
        only = self.variables.several("only")
        return (not only or name.startswith(only)) and (self.variables["part"] == "all" or not is_test)

    def task_drive(self) -> Iterator[dict[str, Any]]:
        """Makes the laps of each training."""
        for training in self.trainings.values():
            action = (scores.drive, [training, self.trained, LOGS])
            yield task(training.name, action, scores.drive_file(training, self.trained), repr(training))

    def task_train(self) -> Iterator[dict[str, Any]]:
        """Trains each model on each training."""
        contents = scores.models_of(scores.SETS)
        for training in self.trainings.values():
            drive = scores.drive_file(training, self.trained)
            for name in self.models:
                action = (scores.train_model, [training, name, self.trained])
                recipe = repr((training, contents[name]))
                yield task(f"{training.name}:{name}", action, self.card(training, name), recipe, [drive])

    def card(self, training: scored_cells.Training, model: str) -> Path:
        """The file that a trained model has when it is done."""
        return scores.model_folder(training, model, self.trained) / CARD

    def known(self, outcomes: Mapping[Any, dict[str, Any] | None]) -> dict[Any, dict[str, Any]]:
        """Those of the cells that were done.

        Raises:
            UserError: none was.
        """
        known = {cell: outcome for cell, outcome in outcomes.items() if outcome is not None}
        if not known:
            raise UserError(f"{' '.join(self.variables.changed)}: no cell is done")
        return known


class Generalisation(Matrix):
    """Models scored on drives that differ from their training."""

    def __init__(self) -> None:
        super().__init__(Variables(part="development", sets="shipped", only=""), OUT)
        self.sets = self.variables.several("sets")
        self.cells = [cell for cell in scored_cells.cells(LOGS) if self.wanted(cell.training.name, cell.is_test)]
        self.trainings = {cell.training.name: cell.training for cell in self.cells}

    def task_score(self) -> Iterator[dict[str, Any]]:
        """Scores the models on each cell."""
        for cell in self.cells:
            action = (scores.score_cell, [cell, OUT, LOGS, self.sets])
            needs = [self.card(cell.training, name) for name in self.models]
            yield task(cell.name, action, scores.cell_file(cell, OUT), repr((cell, self.sets)), needs)

    def task_page(self) -> dict[str, Any]:
        """Writes the page and the heat map of what is there."""
        return page_task(self.write, ["score"])

    def write(self) -> None:
        known = self.known({cell: scores.read_cell(cell, OUT) for cell in self.cells})
        write_json(OUT / "summary.json", scores_page.summary(known))
        figure = save_figure(scores_page.heat_map(known), PAGES / "generalisation.png")
        missing = len(self.cells) - len(known)
        save_page(
            scores_page.generalisation_page(known, self.variables.changed, figure, missing), PAGES / "generalisation.md"
        )
        if "ablations" in self.sets:
            save_page(ablations_page(known, self.variables.changed), PAGES / "ablations.md")


class ClosedLoop(Matrix):
    """Laps with each model in the controller."""

    def __init__(self) -> None:
        variables = Variables(only="", part="development", sets="shipped", models="")
        super().__init__(variables, Path(get_var("trained", "out/generalisation")))
        offered = [name for name in self.models if name != "ridge"]  # which has no physics to plan with
        self.driven = variables.several("models", offered) or tuple(offered)
        self.models = tuple(dict.fromkeys((*self.driven, races.CALIBRATES)))
        self.cells = [cell for cell in raced_cells.cells() if self.wanted(cell.name, cell.is_test)]
        self.trainings = {cell.training.name: cell.training for cell in self.cells}
        self.page = "closed_loop"
        if set(scores.RIVALS) & set(self.driven):
            self.page = "_".join(["closed_loop_rivals", *variables.several("only")])

    def task_race(self) -> Iterator[dict[str, Any]]:
        """Drives each cell with each model."""
        for cell in self.cells:
            for name in (*races.BASELINES, *self.driven):
                action, target = (
                    (races.race_model, [cell, name, OUT, self.trained]),
                    races.outcome_file(cell, name, OUT),
                )
                needs = [self.card(cell.training, name if name in self.driven else races.CALIBRATES)]
                yield task(f"{cell.name}:{name}", action, target, repr(cell), needs)

    def task_page(self) -> dict[str, Any]:
        """Writes the page and the figure of what is there."""
        return page_task(self.write, ["race"])

    def task_learn(self) -> Iterator[dict[str, Any]]:
        """Drives each cell faster every lap."""
        for cell in self.cells:
            action = (races.learn_cell, [cell, OUT, self.trained, races.LEARNS])
            needs = [self.card(cell.training, races.LEARNS)]
            yield task(cell.name, action, races.learning_file(cell, OUT), repr(cell), needs)

    def task_learning_page(self) -> dict[str, Any]:
        """Writes the page of what learned."""
        return page_task(self.write_learning, ["learn"])

    def write(self) -> None:
        read = partial(races.read_cell, models=self.driven, out=OUT)
        known = self.known({cell: read(cell) for cell in self.cells})
        write_json(OUT / "summary.json", races_page.summary(known))
        figure = save_figure(races_page.lap_times(known), PAGES / f"{self.page}.png")
        words = races_page.closed_loop_page(known, self.variables.changed, figure, self.cells)
        save_page(words, PAGES / f"{self.page}.md")

    def write_learning(self) -> None:
        known = self.known({cell: races.read_learning(cell, OUT) for cell in self.cells})
        figure = save_figure(races_page.learned_laps(known), PAGES / "lap_learning.png")
        words = races_page.learning_page(known, self.variables.changed, figure, self.cells)
        save_page(words, PAGES / "lap_learning.md")


GROUPS: dict[str, tuple[Callable[[], Any], list[str]]] = {
    "paper": (Paper, ["step", "document"]),
    "hidden_causes": (HiddenCauses, ["case", "page"]),
    "generalisation": (Generalisation, ["drive", "train", "score", "page"]),
    "closed_loop": (ClosedLoop, ["page"]),
}  # by name: what makes the tasks, and those that run if none is named
if GROUP not in GROUPS:
    raise UserError(f"group={GROUP}: expected one of {', '.join(GROUPS)}")
_make, _usual = GROUPS[GROUP]
DOIT_CONFIG = doit_config(OUT / "doit.json") | {"default_tasks": _usual}
_group = _make()
globals().update({name: getattr(_group, name) for name in dir(_group) if name.startswith("task_")})
