"""How nodes end. That a busy one can be stopped at any moment is tested with what it keeps, in ``test_online.py``."""

from __future__ import annotations

import dataclasses
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.endurance.live_run import isolated_environment, node_process
from dynssm_ros.errors import UserError
from dynssm_ros.signals.extraction import extract
from dynssm_ros.signals.signal_map import load_signal_map
from dynssm_ros.signals.standard import recording_to_bag

pytestmark = [pytest.mark.live, pytest.mark.timeout(240)]


@pytest.mark.slow
def test_a_player_that_waits_for_a_message_far_away_ends_at_once(laps_bag: Path, tmp_path: Path) -> None:
    laps = extract([laps_bag], load_signal_map("default"), 50.0)
    seconds = np.where(np.arange(len(laps.time)) > 0, 10**4, 0)  # after the first row comes a long pause
    bag = tmp_path / "paused"
    recording_to_bag(dataclasses.replace(laps, time=laps.time + seconds * 10**9), bag)
    command = [sys.executable, "-m", "dynssm_ros.nodes.player", "--ros-args", "-p", f"bag:={bag}"]
    player = subprocess.Popen(command, env=isolated_environment(), stderr=subprocess.PIPE, text=True)
    assert player.stderr is not None
    assert "nobody listens" in player.stderr.readline()  # and now it plays
    player.send_signal(signal.SIGINT)
    assert player.wait(5.0) == 0


IDLE = """
import threading
from rclpy.node import Node
from dynssm_ros.nodes.support import run

class Idle(Node):
    def __init__(self):
        super().__init__("idle")
        threading.Timer(0.5, self.context.handle.shutdown).start()  # and nothing wakes the executor

run(Idle)
"""


def test_an_idle_node_notices_that_its_context_was_shut_down() -> None:
    """As on SIGTERM, when rclpy wakes the executor a moment before it shuts the context down."""
    ended = subprocess.run([sys.executable, "-c", IDLE], env=isolated_environment(), timeout=30, check=False)
    assert ended.returncode == 0


def test_a_node_that_crashed_is_named() -> None:
    def crash() -> None:
        with node_process("simulator") as process:
            process.send_signal(signal.SIGSEGV)
            process.wait()

    with pytest.raises(UserError, match="the simulator crashed with SIGSEGV"):
        crash()


@pytest.mark.parametrize("node", ["predictor", "controller", "simulator", "player"])
def test_help_says_what_a_node_is_and_explains_its_parameters(node: str) -> None:
    command = [sys.executable, "-m", f"dynssm_ros.nodes.{node}", "--help"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    assert f"ros2 run dynssm_ros {node}" in ended.stdout
    assert "  rate: 1.0" in ended.stdout or "max_age: 0.2" in ended.stdout
    assert not ended.stderr


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("--log-level", "loud"), "error: ROS arguments: Couldn't parse log level: '--log-level loud'"),
        (("--params-file", "/nowhere"), "error: ROS arguments: Couldn't parse params file: '--params-file /nowhere'"),
        (("-r", "nonsense"), "error: ROS arguments: Couldn't parse remap rule: '-r nonsense'"),
    ],
)
def test_ros_arguments_that_cannot_be_read_are_one_line(arguments: tuple[str, ...], expected: str) -> None:
    command = [sys.executable, "-m", "dynssm_ros.nodes.simulator", "--ros-args", *arguments]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert ended.returncode == 1
    assert ended.stderr.startswith(expected)
    assert len(ended.stderr.splitlines()) == 1
    assert ".c:" not in ended.stderr, "where rcl found it is of no use to who typed it"


def test_a_path_may_begin_at_home(refused_start) -> None:
    line = refused_start("predictor", "model:=~/no_such_model")
    assert line.startswith(f"error: {Path.home() / 'no_such_model'}: no such model folder")
