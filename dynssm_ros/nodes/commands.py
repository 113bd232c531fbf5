"""What a controller's command is published as: the shipped message, or the one that a car's own stack takes.

And how a planner asks for the rollout of commands: ``trajectory_msgs/JointTrajectory`` both ways, which has names, times and
numbers of any kind. A path has no speeds and no inputs, a service would need a package of messages of its own.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from dynssm_ros.arrays import Vector
from dynssm_ros.errors import ConfigurationError, UserError
from dynssm_ros.nodes.support import actuators, message_class, set_stamp
from dynssm_ros.runtime.predictor import CandidateRollout
from dynssm_ros.signals.signal_map import POSE_SIGNALS, STATE_SIGNALS
from dynssm_ros.vehicle import Applied, Vehicle
from dynssm_ros.vehicle.single_track import SetPoint

Write = Callable[[int, Applied], Any]
"""A message for a command that acts from a stamp on (ns)."""

JOINT_STATE = "sensor_msgs/msg/JointState"
ACKERMANN = "ackermann_msgs/msg/AckermannDriveStamped"
COMMAND_TYPES = (JOINT_STATE, ACKERMANN)
LONGEST_S = 10.0  # that a planner may ask about


def commands_as(msgtype: str, vehicle: Vehicle) -> tuple[Any, Write]:
    """The class of the messages that command a vehicle, and what makes one of them.

    An ``AckermannDriveStamped`` carries a speed (m/s) and the steering angle (rad); its acceleration, jerk and steering speed
    stay 0, which there means as fast as the car can.

    Raises:
        ConfigurationError: the message package is not installed, or the vehicle has no speed to ask for.
    """
    set_point = vehicle.inputs.set_point
    if msgtype == JOINT_STATE:
        return message_class(msgtype), lambda stamp, applied: actuators(stamp, applied, set_point)
    if set_point != "speed":
        raise ConfigurationError(
            f"parameter command_type: {msgtype} carries a speed, but vehicle {vehicle.name} has inputs.set_point: "
            f"{set_point}; expected {JOINT_STATE}, or a vehicle with set_point: speed"
        )
    kind = message_class(msgtype)

    def ackermann(stamp: int, applied: Applied) -> Any:
        message = kind()
        set_stamp(message.header, stamp)
        message.drive.speed, message.drive.steering_angle = float(applied.r), float(applied.delta)
        return message

    return kind, ackermann


def candidate(message: JointTrajectory, set_point: SetPoint, T_s: float) -> Vector:
    """The inputs that a planner asks about, for steps of ``T_s`` (s) each, ``(K, 2)``.

    Each point is held from its ``time_from_start`` on, the last one for a step.

    Raises:
        UserError: other names than the set-point and ``steering``, no point, times that do not rise, more than 10 s.
    """
    names = [set_point, "steering"]
    if sorted(message.joint_names) != sorted(names):
        raise UserError(f"candidate: joint_names {list(message.joint_names)}; expected {', '.join(names)}")
    times = [point.time_from_start.sec + point.time_from_start.nanosec / 1e9 for point in message.points]
    if not times or not 0 <= times[0] <= times[-1] <= LONGEST_S or not (np.diff(times) > 0).all():
        raise UserError(
            f"candidate: times {times[:3]} of {len(times)} points; expected ones that rise, from 0 to {LONGEST_S:g} s"
        )
    wrong = [len(point.positions) for point in message.points if len(point.positions) != len(names)]
    if wrong:
        raise UserError(f"candidate: a point with {wrong[0]} positions; expected {len(names)}")
    columns = [list(message.joint_names).index(name) for name in names]
    values = np.array([point.positions for point in message.points])[:, columns]
    if not np.isfinite(values).all():
        raise UserError("candidate: a position that is not finite; expected numbers")
    steps = T_s * np.arange(int(times[-1] / T_s + 1e-9) + 1)
    held: Vector = values[np.maximum(np.searchsorted(times, steps + 1e-9 * T_s, side="right") - 1, 0)]
    return held


def rollout_as(rollout: CandidateRollout | None, T_s: float, frame: str) -> JointTrajectory:
    """The answer: states after each step, and poses if there are any; without points where nothing can be predicted."""
    if rollout is None:
        return JointTrajectory()
    poses = bool(rollout.poses)
    answer = JointTrajectory(joint_names=[*(POSE_SIGNALS if poses else ()), *STATE_SIGNALS])
    answer.header.frame_id = frame
    set_stamp(answer.header, rollout.stamp)
    for k, state in enumerate(rollout.states):
        point = JointTrajectoryPoint(positions=[*(rollout.poses[k] if poses else ()), *state])
        nanoseconds = round((k + 1) * T_s * 1e9)
        point.time_from_start.sec, point.time_from_start.nanosec = divmod(nanoseconds, 1_000_000_000)
        answer.points.append(point)
    return answer
