"""Where the car is: its pose, how velocities move it, and the array namespace of single numbers."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.vehicle.single_track import Array, State

# floats through `math` are ten times faster than through numpy; the names are those of numpy
SCALAR = SimpleNamespace(
    sin=math.sin, cos=math.cos, tan=math.tan, arctan=math.atan, arctan2=math.atan2, tanh=math.tanh, exp=math.exp,
    sqrt=math.sqrt, fabs=math.fabs, hypot=math.hypot, pi=math.pi,
)  # fmt: skip

PATH_HORIZON_S = 0.6
"""How far a controller looks ahead with a model, about: paths are predicted, judged and scored over so long."""


_DAY_NS = 86_400_000_000_000


def time_of_day(stamp: Any) -> Any:
    """Seconds since midnight UTC of stamps (ns since 1970, whole numbers)."""
    return stamp % _DAY_NS / 1e9


class Pose(NamedTuple):
    """Position (m) and heading (rad, counter-clockwise, not wrapped) of the centre of gravity in the odometry frame."""

    x: Array
    y: Array
    theta: Array


def world_velocity(xp: Any, heading: Array, v_x: Array, v_y: Array) -> tuple[Array, Array]:
    """Body-frame velocities (m/s) of a car that heads ``heading`` (rad), in the odometry frame."""
    c, s = xp.cos(heading), xp.sin(heading)
    return v_x * c - v_y * s, v_x * s + v_y * c


def axle_direction(xp: Any, axle: Array, v_x: Array, v_y: Array, omega: Array) -> Array:
    """Where an axle moves to against where the car heads (rad), ``axle`` metres before the centre of gravity."""
    return xp.arctan2(v_y + axle * omega, v_x)


def advance_pose(xp: Any, pose: Pose, before: State, after: State, T_s: float, *, share: float = 0.5) -> Pose:
    """The pose after a step of ``T_s`` (s) in which the velocities change from ``before`` to ``after``.

    Args:
        xp: array namespace.
        pose: at the start of the step.
        before: velocities at its start.
        after: velocities at its end.
        T_s: length of the step (s).
        share: instant of the step whose velocity and heading carry the car: 0.5 its middle, 0 its start (forward Euler).
    """
    left = 1 - share
    v_x, v_y = left * before.v_x + share * after.v_x, left * before.v_y + share * after.v_y
    turn = (left * before.omega + share * after.omega) * T_s
    x, y = world_velocity(xp, pose.theta + share * turn, v_x, v_y)
    return Pose(pose.x + T_s * x, pose.y + T_s * y, pose.theta + turn)


def path(velocities: Vector, T_s: float) -> Vector:
    """Positions driven with the body-frame ``velocities``, from the origin and along the x axis.

    Each step takes the mean of the velocities at its two ends, at the heading in its middle: the live predictor's rule.

    Args:
        velocities: ``v_x, v_y, omega`` at the grid points, shape ``(..., n + 1, 3)``.
        T_s: sampling time (s).

    Returns:
        ``x, y`` after each step, shape ``(..., n, 2)`` (m).
    """
    mean = (velocities[..., 1:, :] + velocities[..., :-1, :]) / 2
    turn = T_s * mean[..., 2]
    heading = np.cumsum(turn, axis=-1) - turn / 2
    velocity = world_velocity(np, heading, mean[..., 0], mean[..., 1])
    positions: Vector = T_s * np.cumsum(np.stack(velocity, axis=-1), axis=-2)
    return positions
