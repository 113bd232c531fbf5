"""Another node that publishes the same is named; one that is merely there is not."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import JointState

from dynssm_ros.nodes.rivals import WatchedOutput
from dynssm_ros.nodes.support import output, set_stamp

pytestmark = [pytest.mark.live, pytest.mark.timeout(60)]


def stamped(stamp: int) -> JointState:
    message = JointState()
    set_stamp(message.header, stamp)
    return message


def test_another_publisher_is_named_while_it_is_heard(ros: None) -> None:
    nodes = own, other = rclpy.create_node("controller"), rclpy.create_node("joystick")
    executor = SingleThreadedExecutor()
    for node in nodes:
        executor.add_node(node)
    commands, joystick = WatchedOutput(own, JointState, "command"), output(other, JointState, "command")
    count = 0

    def publishes_until(done: Callable[[], bool], *, both: bool) -> bool:
        nonlocal count
        for _ in range(500):
            count += 1
            commands.publish(stamped(count))
            if both:
                joystick.publish(stamped(count))  # answers the same odometry
            executor.spin_once(0.02)
            if done():
                return True
        return False

    assert publishes_until(lambda: own.count_publishers("/command") == 2, both=False)
    assert commands.rival() == "", "it is there, as a stand-by is"
    assert publishes_until(lambda: own.count_subscribers("/command") == 1, both=False)
    assert not publishes_until(lambda: commands.rival() != "", both=False)
    assert publishes_until(lambda: commands.rival() == "another node publishes on /command: /joystick", both=True)
    other.destroy_node()
    assert publishes_until(lambda: own.count_publishers("/command") == 1, both=False)
    assert publishes_until(lambda: commands.rival() == "", both=False)
    assert own.count_subscribers("/command") == 0
    own.destroy_node()
