"""Short laps with hidden causes, and the diagnosis of one of them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from benchmarks.hidden_causes.cases import Case, record, size
from dynssm_ros.identification.diagnose import Diagnosis, diagnose
from dynssm_ros.signals.recording import Recording
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import Vehicle

Laps = tuple[Recording, Vehicle]


@pytest.fixture(scope="session")
def laps() -> Callable[..., Laps]:
    """``laps(effect, ..., seed=1)``: a quick drive with hidden effects of random size, and the nominal vehicle."""

    def drive(*effects: str, seed: int = 1, duration: float = 70.0) -> Laps:
        rng = np.random.default_rng(seed)
        return record(Case({name: size(name, rng) for name in effects}, seed, "euler", duration))

    return drive


@pytest.fixture(scope="session")
def lagging(laps: Callable[..., Laps]) -> tuple[Recording, Vehicle, Diagnosis]:
    """A car whose steering lags, and its diagnosis."""
    recording, vehicle = laps("steering_lag")
    line = load_track("road_course").centre
    return recording, vehicle, diagnose(recording, vehicle, integrator="euler", line=line)
