"""What a recording knows beside the model's inputs, for effects that read it: time, pose, track position."""

from __future__ import annotations

from dynssm_ros.arrays import Vector
from dynssm_ros.signals.recording import Recording
from dynssm_ros.vehicle.effects import CONTEXT_UNITS


def recording_context(recording: Recording) -> dict[str, Vector]:
    """The signals of ``CONTEXT_UNITS`` that ``recording`` has, each of shape ``(N,)``; ``t`` counts from its first row."""
    time = (recording.time - recording.time[0]) / 1e9
    return {"t": time} | {name: recording[name] for name in CONTEXT_UNITS if name in recording.columns}
