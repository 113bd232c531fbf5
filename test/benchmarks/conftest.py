"""What the benchmarks compare with is registered, as a plugin does it; folds of small drives."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import benchmarks.rivals  # noqa: F401 - registers them
from benchmarks.network import Fold, Study
from dynssm_ros.signals.recording import Recording
from dynssm_ros.vehicle import Vehicle, save_vehicle


@pytest.fixture
def study_of(orca: Vehicle, tmp_path: Path) -> Callable[[Recording, Recording], Study]:
    """The study of a fold of the 1:43 car, as its file has it: ``study_of(training, left_out)``."""

    def make(training: Recording, left_out: Recording) -> Study:
        save_vehicle(orca, tmp_path / "f.yaml")
        return Study.of(Fold("f", "orca", training, left_out), tmp_path)

    return make


@pytest.fixture
def pushed() -> Callable[[Recording, np.ndarray], Recording]:
    """A drive whose ``v_x`` is pushed by so much (m/s) at each row."""
    return lambda laps, pushes: replace(laps, columns=laps.columns | {"v_x": laps["v_x"] + np.cumsum(pushes)})
