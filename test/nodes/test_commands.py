"""What the controller's commands are published as."""

from __future__ import annotations

import sys
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
from std_msgs.msg import Header

from dynssm_ros.errors import ConfigurationError
from dynssm_ros.nodes.commands import ACKERMANN, JOINT_STATE, commands_as
from dynssm_ros.signals.decoding import decoders
from dynssm_ros.signals.signal_map import load_signal_map
from dynssm_ros.vehicle import Applied, load_vehicle

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
