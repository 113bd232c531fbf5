"""Where on the lap a recording is: the track position that effects on stretches of the lap read."""

from __future__ import annotations

import numpy as np

from dynssm_ros.evaluation.lap import first_lap, track_position
from dynssm_ros.signals.context import recording_context
from dynssm_ros.signals.recording import Recording
from dynssm_ros.simulation.lines import ClosedLine, Vector


def lap_context(recording: Recording, line: ClosedLine | None) -> dict[str, Vector]:
    """The signals of the recording, and ``s`` (m, in ``[0, lap_length)``) and ``lap_length`` (m) along ``line``."""
    context = recording_context(recording)
    if line is None or "s" in context:
        return context
    return context | {"s": track_position(line, recording), "lap_length": np.full(len(recording), line.length)}


def lap_number(recording: Recording, line: ClosedLine | None) -> Vector | None:
    """How many times each row's drive has passed the start of ``line``; ``None`` without one."""
    if line is None:
        return None
    s = track_position(line, recording)
    passed = np.concatenate([[0], np.cumsum(np.diff(s) < -0.5 * line.length)])
    back = np.concatenate([[0], np.cumsum(np.diff(s) > 0.5 * line.length)])
    return np.asarray(passed - back, dtype=np.float64)


def driven_line(recording: Recording) -> ClosedLine | None:
    """The path of the first full lap; ``None`` if there is none."""
    return first_lap(recording)
