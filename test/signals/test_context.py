"""What effects may read of a recording."""

from __future__ import annotations

import numpy as np

from dynssm_ros.signals.context import recording_context
from dynssm_ros.signals.inputs import WINDOW_COLUMNS
from dynssm_ros.signals.recording import Recording, RecordingInfo

N = 5


def recording(*names: str) -> Recording:
    columns = {name: np.arange(N) + 10.0 * k for k, name in enumerate((*WINDOW_COLUMNS, *names))}
    time = np.array([7, 8, 9, 30, 31], dtype=np.int64) * 40_000_000
    info = RecordingInfo(sampling_time=0.04, commands="none")
    return Recording(info, time, np.array([0, 0, 0, 1, 1], dtype=np.int32), columns)


def test_time_counts_from_the_first_row_across_gaps() -> None:
    assert set(recording_context(recording())) == {"t"}
    np.testing.assert_allclose(recording_context(recording())["t"], np.array([0, 1, 2, 23, 24]) * 0.04)


def test_what_else_was_recorded_is_there_and_the_model_inputs_are_not() -> None:
    found = recording_context(recording("x", "y", "theta", "s"))
    assert set(found) == {"t", "x", "y", "theta", "s"}
    np.testing.assert_array_equal(found["theta"], np.arange(N) + 90.0)
