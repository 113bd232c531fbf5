"""A predictor that cannot start says why in one line."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from benchmarks.endurance.live_run import isolated_environment
from dynssm_ros.runtime.artifact import ONNX

pytestmark = [pytest.mark.live, pytest.mark.timeout(120)]


@pytest.mark.parametrize(
    ("parameters", "expected"),
    [
        ([], "parameter model: not set"),
        (["model:=/nowhere"], "/nowhere: no such model folder"),
        (["model:={model}", "model_root:=/nowhere"], "is not below /nowhere; expected a folder in it"),
        (["model:={model}", "max_age:=abc"], "Trying to set parameter 'max_age' to 'abc' of type 'STRING'"),
        (["model:={model}", "max_age:=100.0"], "Parameter max_age out of range Min: 0.01, Max: 10.0, value: 100.0"),
        (["model:={model}", "tf:=true"], "parameter tf: needs tf2_ros, which comes with a ROS installation"),
        (["model:={model}", "signals:=nothing"], "signals: 'nothing' is neither a file nor a shipped name"),
        (["model:={model}", "signals:=av21"], "signals: missing throttle_command, steering_command"),
    ],
)
def test_a_wrong_start_is_one_clear_line(
    refused_start: Callable[..., str], small_model: Path, parameters: list[str], expected: str
) -> None:
    assert expected in refused_start("predictor", *(text.format(model=small_model) for text in parameters))


def test_a_start_with_a_graph_that_takes_all_memory_is_refused(vast_model: Path) -> None:
    command = [sys.executable, "-m", "dynssm_ros.nodes.predictor", "--ros-args", "-p", f"model:={vast_model}"]
    done = subprocess.run(
        command, env=os.environ | isolated_environment(), capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 1
    assert done.stderr.startswith(f"error: {vast_model / ONNX}: ONNX Runtime refuses it (")
    assert done.stderr.count("\n") == 1
