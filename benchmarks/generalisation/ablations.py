"""What each part of the default model earns: errors without it over errors with it, on the cells of the matrix."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from benchmarks.generalisation.cells import Cell
from benchmarks.generalisation.page import EXACT, errors
from dynssm_ros.learning.models.base import OnlineConfig

PAGE = "ablations.md"
Known = Mapping[Cell, Mapping[str, Any]]
_EARNS = 0.01  # less does not stay in the default


class Part(NamedTuple):
    """A part, and the two models that differ by it alone."""

    name: str
    with_it: str
    without: str


_MEMORY = OnlineConfig().memory

PARTS = (
    Part("online layer, on network and physics", "dynssm", "dynssm (offline)"),
    Part("online layer, on physics", "rls", "rls (offline)"),
    Part("network, beside the online layer", "dynssm", "rls"),
    Part("network, without an online layer", "dynssm (offline)", "rls (offline)"),
    Part("innovation filter, beside the online layer", "dynssm", "no_innovation"),
    Part("innovation filter, without an online layer", "dynssm (offline)", "no_innovation (offline)"),
    Part("not in the default: rollout loss", "rollout_loss", "dynssm"),
    Part("not in the default: rollout loss, without an online layer", "rollout_loss (offline)", "dynssm (offline)"),
    Part("not in the default: SSM and parameter head", "ssm_and_head", "dynssm"),
    Part("not in the default: SSM and parameter head, without an online layer", "ssm_and_head (offline)", "dynssm (offline)"),
    Part("lags of the online layer, beyond one", "rls", "rls_one_lag"),
    Part("not in the default: 15 lags of everything", "rls_long_lags", "rls"),
    Part(f"memory of {_MEMORY:g} s instead of 100 s", "rls", "rls_memory_100_s"),
    Part(f"memory of {_MEMORY:g} s instead of 1 s", "rls", "rls_hardly_learning"),
)  # fmt: skip


class Earned(NamedTuple):
    """Errors without a part over those with it: geometric means over cells."""

    one_step: float
    ade: float
    cells: int

    @property
    def earns(self) -> bool:
        """Whether it is worth keeping."""
        return max(self.one_step, self.ade) > 1.0 + _EARNS


def earned(known: Known, part: Part) -> Earned | None:
    """What a part earns on some cells; ``None`` where its models were not scored."""
    logs = []
    for content in known.values():
        if not {part.with_it, part.without} <= set(content["scores"]):
            continue
        with_it, without = (np.maximum(errors(content, name), EXACT) for name in (part.with_it, part.without))
        logs.append(np.log(without / with_it))
    if not logs:
        return None
    one_step, ade = np.mean([log[:3] for log in logs]), np.mean([log[3] for log in logs])
    return Earned(float(np.exp(one_step)), float(np.exp(ade)), len(logs))


def page(known: Known, arguments: str) -> str:
    """The page as Markdown; ``arguments``: of doit's command."""
    return "\n".join(_lines(known, arguments)) + "\n"


def _lines(known: Known, arguments: str) -> Iterator[str]:
    command = " ".join(["python -m doit -n 2 -f benchmarks/generalisation/dodo.py", *arguments.split()])
    yield "# What each part earns"
    yield ""
    yield (
        f"Made by `{command}`. Models that differ by one part are trained and scored on the same cells of the "
        "[matrix](generalisation.md). Shown are errors without the part over errors with it, as geometric means over the "
        "cells: above 1 it earns its place. Errors below 1e-5 count as 1e-5. A part that earns less than "
        f"{100 * _EARNS:.0f} % on test cells leaves the default."
    )
    yield ""
    yield (
        "A network acts beside the online layer only where it has earned 3 % on laps that were left out. Where none has, "
        "models that differ in the network alone are the same there; what their networks are worth is in the rows without an "
        "online layer."
    )
    yield ""
    yield "| part | development: one step | ADE | test: one step | ADE | earns its place |"
    yield "| --- | --- | --- | --- | --- | --- |"
    sides = [{cell: v for cell, v in known.items() if cell.is_test == test} for test in (False, True)]
    for part in PARTS:
        found = [earned(side, part) for side in sides]
        numbers = " | ".join("– | –" if f is None else f"{f.one_step:.3f} | {f.ade:.3f}" for f in found)
        verdict = "–" if found[1] is None else "yes" if found[1].earns else "no"
        yield f"| {part.name} | {numbers} | {verdict} |"
    yield ""
    yield f"Development cells: {len(sides[0])}; test cells: {len(sides[1])}."
