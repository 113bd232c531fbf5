"""What the controller's commands are published as, and how a planner asks for the rollout of commands."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Duration
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from dynssm_ros.errors import ConfigurationError, UserError
from dynssm_ros.nodes.commands import ACKERMANN, JOINT_STATE, candidate, commands_as, rollout_as
from dynssm_ros.runtime.predictor import CandidateRollout
from dynssm_ros.signals.decoding import decoders
from dynssm_ros.signals.signal_map import load_signal_map
from dynssm_ros.vehicle import Applied, State, load_vehicle
from dynssm_ros.vehicle.kinematics import Pose

STAMP = 7_250_000_001
COMMAND = Applied(3.25, -0.125)
SPEED, THROTTLE = load_vehicle("f1tenth"), load_vehicle("orca")


@pytest.fixture
def ackermann_msgs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stands for the message package, which is not among the wheels."""

    class AckermannDriveStamped:
        def __init__(self) -> None:
            self.header = Header()
            self.drive = SimpleNamespace(
                steering_angle=0.0, steering_angle_velocity=0.0, speed=0.0, acceleration=0.0, jerk=0.0
            )

    package, messages = ModuleType("ackermann_msgs"), ModuleType("ackermann_msgs.msg")
    messages.AckermannDriveStamped = AckermannDriveStamped  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "ackermann_msgs", package)
    monkeypatch.setitem(sys.modules, "ackermann_msgs.msg", messages)


def test_an_ackermann_command_says_what_the_signal_map_reads_from_it(ackermann_msgs: None) -> None:
    _, write = commands_as(ACKERMANN, SPEED)
    message = write(STAMP, COMMAND)
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == divmod(STAMP, 10**9)
    decoder = decoders(load_signal_map("f1tenth"))["/drive"]
    assert decoder.msgtype == ACKERMANN
    assert decoder.decode(message) == {"speed_feedback": COMMAND.r, "steering_feedback": COMMAND.delta}
    assert message.drive.steering_angle_velocity == message.drive.acceleration == message.drive.jerk == 0.0


@pytest.mark.parametrize(("vehicle", "first"), [(SPEED, "speed"), (THROTTLE, "throttle")])
def test_a_joint_state_names_the_first_input(vehicle: Any, first: str) -> None:
    message = commands_as(JOINT_STATE, vehicle)[1](STAMP, COMMAND)
    assert dict(zip(message.name, message.position, strict=True)) == {first: COMMAND.r, "steering": COMMAND.delta}


def test_a_throttle_is_no_speed(ackermann_msgs: None) -> None:
    with pytest.raises(ConfigurationError, match=r"command_type: .* carries a speed, but vehicle orca has .*throttle"):
        commands_as(ACKERMANN, THROTTLE)


def test_a_package_that_is_not_installed_is_named() -> None:
    if "ackermann_msgs" in sys.modules:
        pytest.skip("ackermann_msgs is installed here")
    with pytest.raises(ConfigurationError, match="source the workspace that builds ackermann_msgs"):
        commands_as(ACKERMANN, SPEED)


def asked(names: Sequence[str], *points: tuple[float, ...]) -> JointTrajectory:
    """A planner's message: times (s), then positions."""
    message = JointTrajectory(joint_names=list(names))
    for time, *positions in points:
        duration = Duration(sec=int(time), nanosec=round(1e9 * (time % 1.0)))
        message.points.append(JointTrajectoryPoint(positions=positions, time_from_start=duration))
    return message


def test_points_are_held_until_the_next_one() -> None:
    message = asked(["steering", "throttle"], (0.0, 0.1, 0.5), (0.06, -0.1, 0.2))
    held = candidate(message, "throttle", 0.02)
    np.testing.assert_allclose(held, [[0.5, 0.1]] * 3 + [[0.2, -0.1]])
    np.testing.assert_allclose(
        candidate(asked(["speed", "steering"], (0.03, 2.0, 0.0)), "speed", 0.02), [[2.0, 0.0]] * 2
    )


@pytest.mark.parametrize(
    ("message", "words"),
    [
        (asked(["throttle"], (0.0, 0.1)), r"joint_names \['throttle'\]; expected throttle, steering"),
        (asked(["throttle", "steering"]), "0 points; expected ones that rise"),
        (asked(["throttle", "steering"], (0.1, 0.0, 0.0), (0.1, 0.0, 0.0)), "expected ones that rise"),
        (asked(["throttle", "steering"], (11.0, 0.0, 0.0)), "from 0 to 10 s"),
        (asked(["throttle", "steering"], (0.0, 0.1)), "a point with 1 positions; expected 2"),
        (asked(["throttle", "steering"], (0.0, math.nan, 0.0)), "not finite"),
    ],
)
def test_a_candidate_that_cannot_be_read_is_told(message: JointTrajectory, words: str) -> None:
    with pytest.raises(UserError, match=words):
        candidate(message, "throttle", 0.02)


def test_the_answer_has_states_and_times() -> None:
    states = [State(1.0, 0.1, 0.2), State(1.1, 0.2, 0.3)]
    answer = rollout_as(CandidateRollout(5 * 10**9, states, [Pose(0.0, 1.0, 2.0)] * 2), 0.6, "map")
    assert list(answer.joint_names) == ["x", "y", "theta", "v_x", "v_y", "omega"]
    assert list(answer.points[1].positions) == [0.0, 1.0, 2.0, 1.1, 0.2, 0.3]
    assert (answer.points[1].time_from_start.sec, answer.points[1].time_from_start.nanosec) == (1, 200_000_000)
    assert (answer.header.stamp.sec, answer.header.frame_id) == (5, "map")
    assert list(rollout_as(CandidateRollout(0, states, []), 0.6, "").joint_names) == ["v_x", "v_y", "omega"]
    assert not rollout_as(None, 0.6, "").points
