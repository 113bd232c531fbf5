"""The Python API: its examples run as written, and importing it costs nothing."""

from __future__ import annotations

import doctest
import os
import subprocess
import sys
from pathlib import Path

import pytest

import dynssm_ros
from dynssm_ros import api

NAMES = [name for name in api.__dict__ if not name.startswith("_") and callable(getattr(api, name))]
FINDER = doctest.DocTestFinder(exclude_empty=True)
EXAMPLES = {
    test.name.removeprefix("dynssm_ros.api."): test
    for test in FINDER.find(api, "dynssm_ros.api", globs=dict(vars(api)))
    if test.examples
}


@pytest.mark.parametrize("name", sorted(EXAMPLES))
def test_the_example_of_a_function_runs(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    failures = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(EXAMPLES[name], clear_globs=False)
    assert failures.failed == 0


def test_every_public_function_has_an_example() -> None:
    functions = {name for name in dynssm_ros.__all__ if getattr(dynssm_ros, name).__module__ == "dynssm_ros.api"}
    assert functions == set(EXAMPLES)


def test_the_names_are_there_and_importing_the_package_loads_nothing_heavy() -> None:
    assert {
        "Recording",
        "load_vehicle",
        "load_model",
        "extract",
        "calibrate",
        "train",
        "evaluate",
        "diagnose",
        "race",
    } <= {*dynssm_ros.__all__}
    script = "import sys, dynssm_ros; print(sorted({'numpy', 'torch', 'scipy', 'casadi', 'rclpy'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, env=os.environ)
    assert done.stdout.strip() == "[]"
    with pytest.raises(AttributeError, match="no attribute 'magic'"):
        _ = dynssm_ros.magic
