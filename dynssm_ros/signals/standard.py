"""Bags with the package's standard topics, from arrays: what a simulator or a resampled recording plays to a node."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from dynssm_ros.arrays import Vector
from dynssm_ros.signals.bags import write_bag
from dynssm_ros.signals.messages import (
    COMMAND_TOPIC,
    FEEDBACK_TOPIC,
    JOINT_STATE,
    ODOMETRY,
    ODOMETRY_TOPIC,
    joint_state,
    odometry,
)
from dynssm_ros.signals.recording import Recording
from dynssm_ros.signals.signal_map import POSE_SIGNALS
from dynssm_ros.vehicle.single_track import SetPoint

_ORDER = 1000  # ns between the log times of the messages of one instant: actuators first, odometry last


def write_standard_bag(
    path: str | Path,
    time: npt.NDArray[np.int64],
    state: Vector,
    pose: Vector,
    *,
    feedback: Vector,
    command: Vector | None,
    set_point: SetPoint = "throttle",
) -> None:
    """Writes a rosbag2 with odometry, actuator feedback and, if given, absolute commands; all stamped ``time``.

    Args:
        path: folder to write.
        time: stamps (ns), ``(N,)``.
        state: ``v_x, v_y, omega`` (m/s, m/s, rad/s), ``(N, 3)``.
        pose: ``x, y, theta`` (m, m, rad), ``(N, 3)``.
        feedback: throttle (fraction) or speed set-point (m/s), and steering (rad), ``(N, 2)``.
        command: the same as absolute commands, ``(N, 2)``.
        set_point: which of the two; it names the joint.
    """

    def actuators(stamp: int, values: Vector) -> object:
        return joint_state(stamp, {set_point: float(values[0]), "steering": float(values[1])})

    with write_bag(path) as bag:
        bag.add_topic(FEEDBACK_TOPIC, JOINT_STATE)
        if command is not None:
            bag.add_topic(COMMAND_TOPIC, JOINT_STATE)
        bag.add_topic(ODOMETRY_TOPIC, ODOMETRY)
        for k, stamp in enumerate(time.tolist()):
            bag.write(FEEDBACK_TOPIC, stamp, actuators(stamp, feedback[k]))
            if command is not None:
                bag.write(COMMAND_TOPIC, stamp + _ORDER, actuators(stamp, command[k]))
            bag.write(ODOMETRY_TOPIC, stamp + 2 * _ORDER, odometry(stamp, tuple(pose[k]), tuple(state[k])))


def recording_to_bag(recording: Recording, path: str | Path) -> None:
    """Writes a recording as a bag with the standard topics, so that it can be played where its own types are unknown.

    Increments become absolute commands again; ``lookahead`` commands, which nobody sent, are left out. Without a
    recorded pose the car stays at the origin.
    """
    feedback = np.stack([recording["r_fb"], recording["delta_fb"]], axis=1)
    command = feedback + np.stack([recording["r_cmd"], recording["delta_cmd"]], axis=1)
    pose = (
        np.stack([recording[name] for name in POSE_SIGNALS], axis=1)
        if recording.has_pose
        else np.zeros((len(recording), 3))
    )
    has_commands = recording.info.commands == "topics"
    state = recording.states(slice(None))
    write_standard_bag(
        path, recording.time, state, pose, feedback=feedback, command=command if has_commands else None,
        set_point=recording.info.set_point,
    )  # fmt: skip
