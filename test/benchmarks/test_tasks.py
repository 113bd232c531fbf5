"""Benchmarks as doit's tasks: made once, made again when what they are made of changes, kept through a kill."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from benchmarks.tasks import days

REPOSITORY = Path(__file__).resolve().parents[2]
DODO = """
import json, os, signal, time
from dataclasses import dataclass
from pathlib import Path
from benchmarks.tasks import doit_config, split_available, tasks
from dynssm_ros.errors import UserError

ROOT = Path({root!r})
DOIT_CONFIG = doit_config(ROOT / "doit.json")


@dataclass
class Toy:
    key: str
    needs: tuple = ()
    uses: tuple = ()
    marker: str = ""
    title: str = "toy"

    def recipe(self):
        if self.key == "absent":
            raise UserError("nothing was given")
        return json.loads((ROOT / "recipes.json").read_text()).get(self.key, {{}})

    def make(self, root, there):
        with open(ROOT / "log", "a") as log:
            log.write(self.key + "\\n")
        what = self.recipe().get("do")
        if what == "fail":
            raise UserError("a comet")
        if what == "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        (root / self.key).write_text(f"{{sorted(there)}} {{self.recipe()}}")


STEPS = [Toy("a"), Toy("b", needs=("a",)), Toy("c", needs=("b",)), Toy("other")]
STEPS += [Toy("absent"), Toy("lost", needs=("absent",))]


def task_step():
    yield from tasks(split_available(STEPS)[0], ROOT)
"""


@pytest.fixture
def doit(tmp_path):
    """Runs the toy tasks with recipes; returns the exit status, what was made, and what was printed."""
    (tmp_path / "dodo.py").write_text(DODO.format(root=str(tmp_path)))

    def run(jobs: int = 0, **recipes):
        (tmp_path / "recipes.json").write_text(json.dumps(recipes))
        (tmp_path / "log").write_text("")
        command = [sys.executable, "-m", "doit", "run", "-f", str(tmp_path / "dodo.py"), "-n", str(jobs)]
        done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=REPOSITORY)
        return done.returncode, (tmp_path / "log").read_text().split(), done.stdout + done.stderr

    return run


@pytest.mark.parametrize("jobs", [0, 2])
def test_everything_is_made_once_in_the_order_of_its_needs(doit, jobs, tmp_path):
    status, made, _ = doit(jobs)
    assert status == 0
    assert sorted(made) == ["a", "b", "c", "other"]
    assert made.index("a") < made.index("b") < made.index("c")
    assert (tmp_path / "b").read_text() == "['a'] {}"
    assert doit(jobs) == (0, [], doit(jobs)[2])


def test_a_change_is_followed_by_what_builds_on_it(doit):
    doit()
    assert doit(b={"x": 1})[1] == ["b", "c"]
    assert doit(b={"x": 1})[1] == []


def test_an_output_that_was_removed_is_made_again(doit, tmp_path):
    doit()
    (tmp_path / "c").unlink()
    assert doit()[1] == ["c"]


def test_a_failure_loses_only_what_needs_it_and_is_named(doit):
    status, made, words = doit(b={"do": "fail"})
    assert status != 0
    assert sorted(made) == ["a", "b", "other"]
    assert "toy: a comet" in words
    assert doit()[1] == ["b", "c"]


def test_a_kill_costs_the_task_under_way(doit):
    status, made, _ = doit(b={"do": "kill"})
    assert status == -signal.SIGKILL
    assert made == ["a", "b"]
    assert doit()[1] == ["b", "c", "other"]
    assert os.getpid() > 0


def test_the_days_on_which_steps_were_made_are_told(tmp_path):
    steps = [
        SimpleNamespace(key=key, marker=marker) for key, marker in (("a", ""), ("b", "model.yaml"), ("absent", ""))
    ]
    assert days(steps, tmp_path) == ""
    (tmp_path / "a").touch()
    os.utime(tmp_path / "a", (1_764_547_200, 1_764_547_200))
    assert days(steps, tmp_path) == "2025-12-01"
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "model.yaml").touch()
    os.utime(tmp_path / "b" / "model.yaml", (1_764_460_800, 1_764_460_800))
    assert days(steps, tmp_path) == "2025-11-30 to 2025-12-01"
