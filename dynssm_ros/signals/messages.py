"""The standard messages that bags written by this package hold (see the topics of the README)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np

from dynssm_ros.arrays import Vector

ODOMETRY = "nav_msgs/msg/Odometry"
JOINT_STATE = "sensor_msgs/msg/JointState"
ODOMETRY_TOPIC = "/vehicle/odometry"
FEEDBACK_TOPIC = "/vehicle/actuator_feedback"
COMMAND_TOPIC = "/vehicle/actuator_command"
PREDICTION_TOPIC = "/dynssm/prediction"
PARAMETERS_TOPIC = "/dynssm/parameters"
HORIZON_TOPIC = "/dynssm/horizon"
CANDIDATE_TOPIC = "/dynssm/candidate"
ROLLOUT_TOPIC = "/dynssm/rollout"
MARKERS_TOPIC = "/dynssm/markers"

UNKNOWN = 1e6
"""Variance of what nobody states: so large that who weighs by it gives it no weight (zero would mean certain)."""
_UNSTATED = np.diag(np.full(6, UNKNOWN)).ravel()


@cache
def _types() -> Mapping[str, Any]:
    from rosbags.typesys import Stores, get_typestore  # 0.2 s at the start of each node, which needs the names alone

    return get_typestore(Stores.ROS2_JAZZY).types


def odometry(
    stamp: int,
    pose: tuple[float, float, float],
    state: tuple[float, float, float],
    *,
    twist_covariance: Vector | None = None,
    frame_id: str = "map",
    child_frame_id: str = "base_link",
) -> Any:
    """An Odometry message with header stamp ``stamp`` (ns).

    Args:
        stamp: see above.
        pose: ``x, y`` (m) and heading ``theta`` (rad) in ``frame_id``.
        state: ``v_x, v_y`` (m/s) and ``omega`` (rad/s) in ``child_frame_id``.
        twist_covariance: row-major 6 x 6, ``(36,)``; nothing is known of it if it is not given.
        frame_id: frame of the pose.
        child_frame_id: frame of the twist.
    """
    x, y, theta = pose
    v_x, v_y, omega = state
    types = _types()
    vector, point = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Point"]
    quaternion = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, math.sin(theta / 2), math.cos(theta / 2))
    body = types["geometry_msgs/msg/Pose"](point(float(x), float(y), 0.0), quaternion)
    twist = types["geometry_msgs/msg/Twist"](vector(float(v_x), float(v_y), 0.0), vector(0.0, 0.0, float(omega)))
    covariance = planar_covariance(None) if twist_covariance is None else twist_covariance
    return types[ODOMETRY](
        _header(stamp, frame_id),
        child_frame_id,
        types["geometry_msgs/msg/PoseWithCovariance"](body, planar_covariance(None)),
        types["geometry_msgs/msg/TwistWithCovariance"](twist, covariance),
    )


def joint_state(stamp: int, values: Mapping[str, float], effort: Vector | None = None) -> Any:
    """A JointState message with a position for each name, and an effort if given; ``stamp`` in ns."""
    position = np.array(list(values.values()), dtype=np.float64)
    return _types()[JOINT_STATE](
        _header(stamp, ""), list(values), position, np.zeros(0), np.zeros(0) if effort is None else effort
    )


def _header(stamp: int, frame_id: str) -> Any:
    seconds, nanoseconds = divmod(int(stamp), 1_000_000_000)
    types = _types()
    return types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](seconds, nanoseconds), frame_id)


def planar_covariance(variances: Vector | None) -> Vector:
    """Row-major 6 x 6 covariance ``(36,)`` from the variances ``(3,)`` of x, y and yaw, or of ``v_x, v_y, omega``; no
    two are correlated.

    What is not stated, as the vertical or all of it without variances, is :data:`UNKNOWN`.
    """
    covariance = _UNSTATED.copy()
    if variances is not None:
        covariance[[0, 7, 35]] = variances
    return covariance
