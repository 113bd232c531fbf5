"""Raw actuator signals to the model's inputs: signed throttle or speed, and commands as increments on the feedback.

Only here do absolute commands become increments and brakes negative throttle, for extractor and live window alike.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from dynssm_ros.arrays import Vector
from dynssm_ros.vehicle.single_track import Applied

WINDOW_COLUMNS = ("v_x", "v_y", "omega", "r_fb", "delta_fb", "r_cmd", "delta_cmd")
"""One row of the model's input: ``x_t = [v_x, v_y, omega, r_fb, delta_fb]`` and ``u_t = [r_cmd, delta_cmd]``."""


class ModelInputs(NamedTuple):
    """Feedback and command increments, each of shape ``(N,)``: fraction, or m/s of a speed set-point, and rad."""

    r_fb: Vector
    delta_fb: Vector
    r_cmd: Vector
    delta_cmd: Vector


def model_inputs(signals: Mapping[str, Any]) -> ModelInputs:
    """From sampled signals by name, each ``(N,)``; without commands the increments are zero."""
    first = "speed" if "speed_feedback" in signals else "throttle"
    r_fb = signed_throttle(signals[f"{first}_feedback"], signals.get("brake_feedback"))
    delta_fb = signals["steering_feedback"]
    if f"{first}_command" not in signals:
        return ModelInputs(r_fb, delta_fb, np.zeros_like(r_fb), np.zeros_like(delta_fb))
    r = signed_throttle(signals[f"{first}_command"], signals.get("brake_command"))
    return ModelInputs(r_fb, delta_fb, r - r_fb, signals["steering_command"] - delta_fb)


def signed_throttle(throttle: Vector, brake: Vector | None) -> Vector:
    """One signed throttle: minus the brake where it is pressed, else the throttle; a speed set-point as it is."""
    return throttle if brake is None else np.where(brake > 0.0, -brake, throttle)


def lookahead_commands(feedback: Vector, segment: npt.NDArray[np.int32]) -> Vector:
    """The increment to the next feedback sample, ``u_t = fb_{t+1} - fb_t``; zero in the last row of a segment.

    It looks ahead in time: the protocol of the published data sets, never used live.
    """
    command = np.zeros_like(feedback)
    inside = segment[1:] == segment[:-1]
    command[:-1][inside] = np.diff(feedback)[inside]
    return command


def applied_inputs(rows: Any) -> Applied:
    """Throttle and steering, applied = feedback + command, Eq. (15), of rows with the columns ``WINDOW_COLUMNS`` first,
    ``(7, ...)``.
    """
    return Applied(rows[3] + rows[5], rows[4] + rows[6])
