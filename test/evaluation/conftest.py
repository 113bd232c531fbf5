"""Recordings of planted rows."""

from __future__ import annotations

import numpy as np
import pytest

from dynssm_ros.signals.inputs import WINDOW_COLUMNS
from dynssm_ros.signals.recording import Recording, RecordingInfo

T_s = 0.04


@pytest.fixture(scope="session")
def recorded():
    """Makes a recording of model inputs ``(N, 7)``, without a gap."""

    def make(matrix):
        columns = {name: matrix[:, k] for k, name in enumerate(WINDOW_COLUMNS)}
        time = (np.arange(len(matrix)) * T_s * 1e9).astype(np.int64)
        info = RecordingInfo(sampling_time=T_s, commands="none", source=("planted",))
        return Recording(info, time, np.zeros(len(matrix), np.int32), columns)

    return make
