"""The standard messages that the package writes."""

from __future__ import annotations

import numpy as np
import pytest

from dynssm_ros.signals.decoding import header_stamp_ns
from dynssm_ros.signals.messages import UNKNOWN, joint_state, odometry, planar_covariance
from dynssm_ros.signals.signal_map import compile_field

STAMP = 1_700_000_000_999_999_999


def test_odometry_carries_pose_state_frames_and_stamp() -> None:
    covariance = np.arange(36.0)
    message = odometry(
        STAMP, (1.0, 2.0, -3.0), (4.0, 5.0, 6.0), twist_covariance=covariance, frame_id="track", child_frame_id="car"
    )
    position, twist = message.pose.pose.position, message.twist.twist
    assert (position.x, position.y, position.z) == (1.0, 2.0, 0.0)
    assert compile_field("yaw(pose.pose.orientation)")(message) == pytest.approx(-3.0, abs=1e-15)
    assert (twist.linear.x, twist.linear.y, twist.angular.z) == (4.0, 5.0, 6.0)
    assert (message.header.frame_id, message.child_frame_id) == ("track", "car")
    assert header_stamp_ns(message) == STAMP
    np.testing.assert_array_equal(message.twist.covariance, covariance)


def test_the_orientation_is_a_unit_quaternion_about_z() -> None:
    q = odometry(0, (0.0, 0.0, 2.0), (0.0, 0.0, 0.0)).pose.pose.orientation
    assert (q.x, q.y) == (0.0, 0.0)
    assert q.z**2 + q.w**2 == pytest.approx(1.0, abs=1e-15)


def test_covariances_are_unknown_unless_given() -> None:
    message = odometry(0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    np.testing.assert_array_equal(message.pose.covariance.reshape(6, 6), UNKNOWN * np.eye(6))
    np.testing.assert_array_equal(message.twist.covariance.reshape(6, 6), UNKNOWN * np.eye(6))


def test_variances_of_the_state_lie_on_the_diagonal_of_the_twist() -> None:
    covariance = planar_covariance(np.array([1.0, 2.0, 3.0])).reshape(6, 6)
    np.testing.assert_array_equal(covariance, np.diag([1.0, 2.0, UNKNOWN, UNKNOWN, UNKNOWN, 3.0]))


def test_a_joint_state_names_its_positions() -> None:
    message = joint_state(STAMP, {"throttle": 0.5, "steering": -0.1})
    assert message.name == ["throttle", "steering"]
    assert message.position.tolist() == [0.5, -0.1]
    assert header_stamp_ns(message) == STAMP
