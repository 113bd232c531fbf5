"""Doing what is not done yet: steps in the order of their needs, several at a time, each only if something changed."""

from __future__ import annotations

import hashlib
import json
import time
import traceback
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from graphlib import TopologicalSorter
from pathlib import Path
from typing import Literal, Protocol

from benchmarks.paper.steps import Step, UnavailableError
from benchmarks.provenance import code_digest as digest_of
from dynssm_ros import __version__
from dynssm_ros.errors import UserError
from dynssm_ros.files import replacing, write_json

COMPUTING = ("vehicle", "signals", "learning", "runtime", "simulation", "control")
"""Rooms on which results depend."""


@dataclass(frozen=True)
class Outcome:
    """What became of a step.

    Attributes:
        state: ``unavailable`` if the user did not provide what is needed, for this step or one before it.
        identity: of code, recipe and all that the step builds on; empty if it is not done.
        seconds: that it took, now or when it was done.
        fresh: whether it was done now.
        code: :func:`code_digest` of the code that did it.
        reason: why it is not done.
        cause: key of the step that is the reason.
    """

    state: Literal["done", "failed", "unavailable"]
    identity: str = ""
    seconds: float = 0.0
    fresh: bool = False
    code: str = ""
    reason: str = ""
    cause: str = ""


class Told(Protocol):
    """Is told of each step as it ends."""

    def __call__(self, step: Step, outcome: Outcome, done: int, total: int) -> None:
        """``done`` of ``total`` steps have ended."""


def code_digest(kind: type[Step]) -> str:
    """Names the code that the outputs of a kind of step depend on.

    Outputs are not remade because of it, or a corrected line would cost an hour; but what is shown of them can say that
    they are of other code than the present.
    """
    return digest_of(kind.__module__, COMPUTING)


def run(steps: Sequence[Step], root: Path, jobs: int, told: Told) -> dict[str, Outcome]:
    """Runs the steps that are not up to date; one that fails takes with it only those that need it.

    What is done is noted in ``root/records``, so that the same call continues after a kill. Steps that fail for another
    reason than the user's input leave their traceback in ``root/errors``.

    Args:
        steps: with all that they need.
        root: folder of the outputs.
        jobs: processes side by side; 1 stays in this one.
        told: told of each step.

    Returns:
        The outcomes by key.
    """
    by_key = {step.key: step for step in steps}
    order = TopologicalSorter({step.key: (*step.needs, *step.uses) for step in steps})
    order.prepare()
    outcomes: dict[str, Outcome] = {}
    while order.is_active():
        wave = sorted(order.get_ready(), key=list(by_key).index)
        for key, outcome in _wave([by_key[key] for key in wave], root, jobs, outcomes):
            outcomes[key] = outcome
            told(by_key[key], outcome, len(outcomes), len(steps))
        order.done(*wave)
    return outcomes


def identity(step: Step, outcomes: Mapping[str, Outcome]) -> str:
    """Names what the output of ``step`` is made of.

    Raises:
        UserError: its recipe cannot be known.
    """
    inputs = {key: outcomes[key].identity for key in (*step.needs, *step.uses)}
    content = [__version__, type(step).__name__, step.recipe(), inputs]
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _wave(steps: Sequence[Step], root: Path, jobs: int, before: Mapping[str, Outcome]) -> Iterator[tuple[str, Outcome]]:
    """Steps that do not need each other."""
    identities: dict[str, str] = {}
    to_do = []
    for step in steps:
        lost = [before[key] for key in step.needs if before[key].state != "done"]
        if lost:
            yield step.key, Outcome(lost[0].state, reason=lost[0].reason, cause=lost[0].cause)
            continue
        try:
            identities[step.key] = identity(step, before)
        except UserError as error:
            yield step.key, _refused(step, error)
            continue
        known = _recorded(root, step.key, identities[step.key])
        if known:
            yield step.key, known
        else:
            to_do.append(step)
    there = frozenset(key for key, outcome in before.items() if outcome.state == "done")
    for key, outcome in _side_by_side(to_do, root, jobs, there, identities):
        if outcome.state == "done":
            noted = {"identity": outcome.identity, "seconds": outcome.seconds, "code": outcome.code}
            write_json(_record(root, key), noted)
        yield key, outcome


def _side_by_side(
    steps: Sequence[Step], root: Path, jobs: int, there: frozenset[str], identities: Mapping[str, str]
) -> Iterator[tuple[str, Outcome]]:
    from joblib import Parallel, delayed, parallel_config

    if not steps:
        return
    with parallel_config("loky", inner_max_num_threads=1):
        yield from Parallel(n_jobs=min(jobs, len(steps)), return_as="generator_unordered")(
            delayed(_make)(step, root, there, identities[step.key]) for step in steps
        )


def _make(step: Step, root: Path, there: frozenset[str], name: str) -> tuple[str, Outcome]:
    begin, code = time.monotonic(), code_digest(type(step))
    try:
        step.make(root, there)
    except UserError as error:
        return step.key, _refused(step, error)
    except Exception as error:  # whatever it is, the other steps go on
        with replacing(root / "errors" / f"{step.key}.txt") as aside:
            aside.write_text(traceback.format_exc(), encoding="utf-8")
        reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
        return step.key, Outcome("failed", reason=reason, cause=step.key)
    return step.key, Outcome("done", name, time.monotonic() - begin, fresh=True, code=code)


def _refused(step: Step, error: UserError) -> Outcome:
    state: Literal["unavailable", "failed"] = "unavailable" if isinstance(error, UnavailableError) else "failed"
    return Outcome(state, reason=str(error), cause=step.key)


def _recorded(root: Path, key: str, name: str) -> Outcome | None:
    """The outcome of an earlier run, if it was of this very step and its output is there."""
    record = _record(root, key)
    if not record.is_file() or not (root / key).exists():
        return None
    content = json.loads(record.read_text(encoding="utf-8"))
    if content["identity"] != name:
        return None
    return Outcome("done", name, content["seconds"], code=content["code"])


def _record(root: Path, key: str) -> Path:
    return root / "records" / f"{key}.json"
