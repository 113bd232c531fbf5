"""Running steps: order, what is kept, what a failure takes with it, and continuing after a kill."""

from __future__ import annotations

import json
from dataclasses import dataclass

import pytest

from benchmarks.paper.plan import Drive
from benchmarks.paper.racing import DriveLaps
from benchmarks.paper.runner import COMPUTING, code_digest, run
from benchmarks.paper.steps import Simulate, Step, UnavailableError
from benchmarks.provenance import reached
from dynssm_ros.errors import UserError
from dynssm_ros.signals.recording import Recording


@dataclass(frozen=True, kw_only=True)
class Write(Step):
    """Writes its text and those of the steps before it; ``trouble`` is raised instead."""

    text: str = ""
    trouble: Exception | None = None

    def recipe(self):
        return {"text": self.text}

    def make(self, root, there):
        if self.trouble is not None:
            raise self.trouble
        parts = [(root / key).read_text() for key in (*self.needs, *self.uses) if key in there]
        (root / self.key).write_text("".join([*parts, self.text]))


def write(key, text="", needs=(), uses=(), trouble=None):
    return Write(key=key, title=f"write {key}", needs=needs, uses=uses, text=text, trouble=trouble)


@pytest.fixture
def made(tmp_path):
    """Runs steps in ``tmp_path``: ``made(*steps) -> (outcomes, keys of the steps that were made now)``."""

    def run_there(*steps):
        told = []
        outcomes = run(steps, tmp_path, 1, lambda *each: told.append(each))
        assert [done for _, _, done, _ in told] == list(range(1, len(steps) + 1))
        assert {total for *_, total in told} == {len(steps)}
        return outcomes, [step.key for step, outcome, *_ in told if outcome.fresh]

    return run_there


def test_steps_are_made_after_those_that_they_build_on(made, tmp_path):
    _, order = made(write("c", "3", needs=("b",), uses=("a",)), write("b", "2", needs=("a",)), write("a", "1"))
    assert order == ["a", "b", "c"]
    assert (tmp_path / "c").read_text() == "1213"


def test_nothing_is_made_twice(made):
    steps = write("a", "1"), write("b", "2", needs=("a",))
    assert made(*steps)[1] == ["a", "b"]
    outcomes, again = made(*steps)
    assert again == []
    assert {outcome.state for outcome in outcomes.values()} == {"done"}


def test_a_change_is_followed_by_all_that_builds_on_it(made, tmp_path):
    made(write("a", "1"), write("b", "2", needs=("a",)), write("c", "3"))
    _, again = made(write("a", "X"), write("b", "2", needs=("a",)), write("c", "3"))
    assert again == ["a", "b"]
    assert (tmp_path / "b").read_text() == "X2"


def test_an_output_that_was_removed_or_never_noted_is_made_again(made, tmp_path):
    steps = write("a", "1"), write("b", "2", needs=("a",)), write("c", "3")
    made(*steps)
    (tmp_path / "a").unlink()
    (tmp_path / "records" / "c.json").unlink()  # as after a kill between the output and its note
    assert made(*steps)[1] == ["a", "c"]


def test_a_failure_loses_only_what_needs_it_and_is_named(made, tmp_path):
    steps = (
        write("a", trouble=UserError("a: too little data")),
        write("b", "2"),
        write("c", "3", needs=("a", "b")),
        write("d", "4", needs=("c",)),
        write("e", "5", uses=("a", "b")),
    )
    outcomes, order = made(*steps)
    assert order == ["b", "e"]
    assert (tmp_path / "e").read_text() == "25"
    for key in "acd":
        assert (outcomes[key].state, outcomes[key].reason, outcomes[key].cause) == ("failed", "a: too little data", "a")


def test_what_was_made_without_a_failed_step_is_made_again_with_it(made, tmp_path):
    steps = write("a", "1", trouble=UserError("no")), write("b", "2", uses=("a",))
    made(*steps)
    assert made(*steps)[1] == []
    assert made(write("a", "1"), steps[1])[1] == ["a", "b"]
    assert (tmp_path / "b").read_text() == "12"


def test_an_unforeseen_failure_leaves_its_traceback(made, tmp_path):
    outcomes, _ = made(write("a/b", trouble=ValueError("odd\nvalue")))
    assert (outcomes["a/b"].state, outcomes["a/b"].reason) == ("failed", "ValueError: odd value")
    assert "raise self.trouble" in (tmp_path / "errors" / "a" / "b.txt").read_text()


def test_what_the_user_did_not_provide_is_told_apart_from_failures(made):
    outcomes, _ = made(write("a", trouble=UnavailableError("no such log")), write("b", needs=("a",)))
    assert outcomes["b"].state == "unavailable"
    assert outcomes["b"].reason == "no such log"


def test_a_recipe_that_cannot_be_known_fails_the_step(made):
    class Unknown(Write):
        def recipe(self):
            raise UserError("model file is gone")

    outcomes, _ = made(Unknown(key="a", title="a"), write("b"))
    assert (outcomes["a"].state, outcomes["a"].reason) == ("failed", "model file is gone")
    assert outcomes["b"].state == "done"


def test_records_tell_time_and_code(made, tmp_path):
    outcomes, _ = made(write("a"))
    record = json.loads((tmp_path / "records" / "a.json").read_text())
    assert record["code"] == outcomes["a"].code == code_digest(type(write("a")))
    assert record["seconds"] == outcomes["a"].seconds >= 0.0
    again, _ = made(write("a"))
    assert (again["a"].code, again["a"].seconds, again["a"].fresh) == (record["code"], record["seconds"], False)


def test_two_processes_make_what_one_makes(tmp_path):
    drives = {
        name: Drive(vehicle="orca", track="club", duration=2.0, plant="euler", seed=seed)
        for seed, name in enumerate(("a.parquet", "b.parquet"))
    }
    steps = [Simulate(key=name, title=name, drive=drive, data=None) for name, drive in drives.items()]
    for jobs, folder in ((1, "one"), (2, "two")):
        outcomes = run(steps, tmp_path / folder, jobs, lambda *_: None)
        assert {outcome.state for outcome in outcomes.values()} == {"done"}
    for name in drives:
        one, two = (Recording.load(tmp_path / folder / name) for folder in ("one", "two"))
        assert (one.matrix == two.matrix).all()
    assert (Recording.load(tmp_path / "one" / "a.parquet").matrix != one.matrix).any()


def test_the_code_of_a_step_is_what_it_imports_from_the_rooms_that_compute():
    modules = set(reached(Simulate.__module__, COMPUTING))
    assert {
        "dynssm_ros.simulation.laps",
        "dynssm_ros.learning.models.dynssm.network",
        "dynssm_ros.vehicle.single_track",
    } <= modules
    assert "dynssm_ros.simulation.external" not in modules  # drives live
    assert not any(".nodes." in name or ".diagnosis." in name for name in modules)
    assert "dynssm_ros.control.nmpc" in reached(DriveLaps.__module__, COMPUTING)
    assert code_digest(Simulate) != code_digest(DriveLaps)
