"""What a controller's command is published as: the shipped message, or the one that a car's own stack takes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from dynssm_ros.errors import ConfigurationError
from dynssm_ros.nodes.support import actuators, message_class, set_stamp
from dynssm_ros.vehicle import Applied, Vehicle

Write = Callable[[int, Applied], Any]
"""A message for a command that acts from a stamp on (ns)."""

JOINT_STATE = "sensor_msgs/msg/JointState"
ACKERMANN = "ackermann_msgs/msg/AckermannDriveStamped"
COMMAND_TYPES = (JOINT_STATE, ACKERMANN)


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
