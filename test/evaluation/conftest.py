"""Recordings of planted rows."""

from __future__ import annotations

import numpy as np
import pytest

from dynssm_ros.signals.inputs import WINDOW_COLUMNS
from dynssm_ros.signals.recording import Recording, RecordingInfo

T_s = 0.04


@pytest.fixture(scope="session")
def recorded():
    """Makes a recording of model inputs ``(N, 7)``, or of states ``(N, 3)`` with inputs of zero."""

    def make(rows, segment=None):
        N = len(rows)
        matrix = np.zeros((N, len(WINDOW_COLUMNS)))
        matrix[:, : rows.shape[1]] = rows
        columns = {name: matrix[:, k] for k, name in enumerate(WINDOW_COLUMNS)}
        time = (np.arange(N) * T_s * 1e9).astype(np.int64)
        info = RecordingInfo(sampling_time=T_s, commands="none", source=("planted",))
        return Recording(info, time, np.zeros(N, np.int32) if segment is None else segment, columns)

    return make
