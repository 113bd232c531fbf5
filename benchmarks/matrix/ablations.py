"""What each part of the default model earns: errors without it over errors with it, on the cells of the matrix."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from benchmarks.matrix.scored_cells import Cell
from benchmarks.matrix.scores_page import EXACT, errors
from benchmarks.page import render
from dynssm_ros.learning.models.base import OnlineConfig

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


def ablations_page(known: Known, arguments: Sequence[str]) -> str:
    """The page as Markdown; ``arguments``: of doit's command that differ from the usual."""
    sides = [{cell: v for cell, v in known.items() if cell.is_test == test} for test in (False, True)]
    rows = []
    for part in PARTS:
        found = [earned(side, part) for side in sides]
        numbers = [["–", "–"] if f is None else [f"{f.one_step:.3f}", f"{f.ade:.3f}"] for f in found]
        verdict = "–" if found[1] is None else "yes" if found[1].earns else "no"
        rows.append([part.name, *numbers[0], *numbers[1], verdict])
    return render("ablations", arguments=arguments, cells=[len(side) for side in sides], earns=_EARNS, rows=rows)
