"""A real race log through DDS: extracted, learned, and played to the node by another process."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from benchmarks.endurance.live_run import run_live
from dynssm_ros.learning.export import save_artifact
from dynssm_ros.learning.models.registry import load_model_config
from dynssm_ros.learning.stages import train
from dynssm_ros.runtime.artifact import open_artifact
from dynssm_ros.signals.extraction import extract
from dynssm_ros.signals.recording import Recording
from dynssm_ros.signals.signal_map import load_signal_map
from dynssm_ros.signals.standard import recording_to_bag
from dynssm_ros.vehicle import load_vehicle

pytestmark = [pytest.mark.live, pytest.mark.timeout(180)]
IN_REAL_TIME = [pytest.mark.slow, pytest.mark.alone]


@pytest.fixture(scope="module")
def model(putnam: Path, kept: Callable[[str, Callable[[Path], None]], Path]) -> Path:
    """DynSSM after two epochs on the log, without commands as the car did not record them."""

    def make(folder: Path) -> None:
        config = load_model_config("dynssm").with_training(epochs=2)
        recording = extract([putnam], load_signal_map("av21"), 25.0).select(slice(0, 2500))
        save_artifact(train(recording, config, load_vehicle("av21"), folder / "c.pt"), folder / "model")

    return kept("putnam", make) / "model"


@pytest.mark.parametrize(
    ("rate", "speed", "seconds", "in_step"),
    [
        pytest.param(25.0, 4.0, 32.0, True, marks=pytest.mark.slow),
        pytest.param(25.0, 1.0, 8.0, False, marks=IN_REAL_TIME),
        pytest.param(100.0, 1.0, 8.0, False, marks=IN_REAL_TIME),
        pytest.param(100.0, 4.0, 24.0, False, marks=IN_REAL_TIME),  # 400 messages a second take a core of their own
    ],
)
def test_every_odometry_message_after_the_first_window_gets_a_prediction(
    putnam: Path, model: Path, tmp_path: Path, rate: float, speed: float, seconds: float, in_step: bool
) -> None:
    driving = _after(extract([putnam], load_signal_map("av21"), rate), 60.0)
    recording_to_bag(driving, tmp_path / "bag")
    run = run_live(model, tmp_path / "bag", 0.04, rate=speed, duration=seconds, in_step=in_step)
    assert len(run.sent) >= seconds * rate
    assert run.lost == 0
    assert run.passed_over <= (0 if in_step else 0.3) * len(run.sent), "a machine that is busy"
    before_the_first = round((open_artifact(model).card.window - 1) * 0.04 * rate)
    # the first window begins with the first odometry that its actuators have not been overtaken by
    late = min(run.predicted) - run.T_s - sorted(run.sent)[before_the_first]
    assert 0 <= late <= 0.2e9
    # and they are predictions of this car: two epochs do not beat persistence everywhere, but they are as close
    rows = {int(t): k for k, t in enumerate(driving.time)}
    stamps = [s for s in run.predicted if s in rows and s - run.T_s in rows]
    states = driving.states(slice(None))
    predicted = np.array([run.predicted[s] for s in stamps])
    measured = states[[rows[s] for s in stamps]]
    before = states[[rows[s - run.T_s] for s in stamps]]
    assert len(stamps) > 0.9 * len(run.predicted) - rate
    assert np.sqrt(np.mean((predicted - measured)[:, 0] ** 2)) < 2 * np.sqrt(np.mean((before - measured)[:, 0] ** 2))


def _after(recording: Recording, seconds: float) -> Recording:
    return recording.select(slice(round(seconds / recording.T_s), None))
