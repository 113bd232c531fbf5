"""Benchmarks as tasks of doit, the workflow tool: what is done is kept, and made again when what it is made of changes.

Why doit: CONTRIBUTING.md. It notes its state only at its end, so that a kill would lose hours; :class:`NotingDB` notes it
task by task.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator, Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING, Any

from doit import get_initial_workdir
from doit.dependency import JsonDB
from doit.exceptions import TaskFailed
from doit.tools import config_changed

from dynssm_ros.errors import UserError
from dynssm_ros.files import replacing

if TYPE_CHECKING:
    from benchmarks.paper.steps import Step

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # several processes share the cores


class NotingDB(JsonDB):  # type: ignore[misc]
    """doit's JSON state, written after every task; a kill costs the task under way."""

    def set(self, task_id: str, dependency: str, value: Any) -> None:
        super().set(task_id, dependency, value)
        self.dump()

    def dump(self) -> None:
        with replacing(self.name) as aside:
            aside.write_text(self.codec.encode(self._db), encoding="utf-8")


def output(step: Step, root: Path) -> Path:
    """The file by which a step is known to be done."""
    return root / step.key / step.marker


def days(steps: Iterable[Step], root: Path) -> str:
    """The day on which what is there was made (UTC), or the first and the last one; empty where nothing is."""
    there = (path for path in (output(step, root) for step in steps) if path.exists())
    made = sorted({datetime.fromtimestamp(path.stat().st_mtime, timezone.utc).date().isoformat() for path in there})
    return " to ".join(dict.fromkeys([made[0], made[-1]])) if made else ""


def split_available(steps: Sequence[Step]) -> tuple[list[Step], dict[str, str], dict[str, str]]:
    """Steps that can be made with what the user provides.

    Returns:
        Those steps; why others cannot be made, by their keys; and the keys of the steps that are the cause.
    """
    reasons: dict[str, str] = {}
    causes: dict[str, str] = {}
    for step in steps:
        lost = [key for key in step.needs if key in reasons]
        if lost:
            reasons[step.key], causes[step.key] = reasons[lost[0]], causes[lost[0]]
            continue
        try:
            step.recipe()
        except UserError as error:
            reasons[step.key], causes[step.key] = str(error), step.key
    return [step for step in steps if step.key not in reasons], reasons, causes


def tasks(steps: Sequence[Step], root: Path) -> Iterator[dict[str, Any]]:
    """Tasks of ``steps`` for doit, all of which are available."""
    by_key = {step.key: step for step in steps}
    for step in steps:
        before = [by_key[key] for key in (*step.needs, *step.uses) if key in by_key]
        action = (perform, [step, root, [other.key for other in before]])
        needs = [output(other, root) for other in before]
        recipe = json.dumps(step.recipe(), sort_keys=True)
        yield task(step.key, action, output(step, root), recipe, needs) | {"doc": step.title}


def task(name: str, action: tuple[Any, ...], target: Path, recipe: str, needs: Iterable[Path] = ()) -> dict[str, Any]:
    """A task of doit that makes the file ``target``, anew when ``recipe`` or the files that it ``needs`` have changed."""
    return {
        "name": name,
        "actions": [action],
        "targets": [str(target)],
        "file_dep": [str(each) for each in needs],
        "uptodate": [config_changed(recipe)],
    }


def perform(step: Step, root: Path, before: Iterable[str]) -> TaskFailed | None:
    """Makes a step; what is wrong with the user's input is one line."""
    try:
        step.make(root, frozenset(before))
    except UserError as error:
        return TaskFailed(f"{step.title}: {error}")
    return None


def doit_config(state: Path) -> dict[str, Any]:
    """Settings of doit: where its state is, and to go on with what does not need a task that failed.

    Also returns to the folder that doit was called in, which paths are relative to; doit goes to that of the tasks' file.
    """
    if (called_in := get_initial_workdir()) is not None:
        os.chdir(called_in)
    state.parent.mkdir(parents=True, exist_ok=True)
    return {"dep_file": str(state), "backend": "noting", "continue": True, "verbosity": 1}
