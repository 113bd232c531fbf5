"""The vehicle file that a diagnosis writes drives in the simulator, trains a model, predicts live and races."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dynssm_ros.control.race import Course, race
from dynssm_ros.control.race_models import load_prediction_model
from dynssm_ros.control.reference import load_reference
from dynssm_ros.control.settings import Settings
from dynssm_ros.identification.problem.car import CarEstimate
from dynssm_ros.identification.problem.windows import SimulationWindows, recorded_rows
from dynssm_ros.learning.export import save_artifact
from dynssm_ros.learning.models.registry import parse_model_config
from dynssm_ros.learning.stages import train
from dynssm_ros.runtime.artifact import open_artifact
from dynssm_ros.runtime.onnx_model import OnnxModel
from dynssm_ros.runtime.predictor import Prediction, Predictor
from dynssm_ros.runtime.replay import replay
from dynssm_ros.signals.bags import open_bag
from dynssm_ros.signals.extraction import extract
from dynssm_ros.signals.recording import Recording
from dynssm_ros.signals.signal_map import load_signal_map
from dynssm_ros.simulation.laps import simulate, write_run
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import COEFFICIENTS, Vehicle, load_vehicle, save_vehicle

CAUSES = {"steering_lag": {"time_constant": 0.05}, "odometry_lever_arm": {"x": 0.01, "y": 0.0}}


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file as a diagnosis writes it: refitted values and two causes, one in the actuators, one in the measurement."""
    moved = np.zeros(len(COEFFICIENTS) + 1)
    moved[COEFFICIENTS.index("D_f")] = 0.5
    path = tmp_path_factory.mktemp("extended") / "vehicle.yaml"
    save_vehicle(CarEstimate(load_vehicle("orca"), moved, CAUSES).extended(1e-4 * np.eye(18)), path, "extended")
    return path


@pytest.fixture(scope="module")
def extended(path: Path) -> Vehicle:
    return load_vehicle(path)


@pytest.fixture(scope="module")
def bag(extended: Vehicle, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bag") / "laps"
    write_run(simulate(extended, load_track("club"), duration=20.0, plant="euler"), folder)
    return folder


@pytest.fixture(scope="module")
def recording(bag: Path) -> Recording:
    return extract([bag], load_signal_map("default"), 50.0)


def test_it_drives_in_the_simulator_as_the_diagnosis_simulates_it(extended: Vehicle, recording: Recording) -> None:
    track = recorded_rows(recording, {})
    some = SimulationWindows(track, np.arange(50, len(recording) - 20, 10), 10, 40, "euler")
    errors = np.abs(some.errors(CarEstimate.of(extended))).max(axis=(0, 1))
    # the state of the lag is led along the rows before the start, and forgets where that began
    assert (errors < 1e-3 * np.abs(some.errors(CarEstimate.of(load_vehicle("orca")))).max(axis=(0, 1))).all()


@pytest.mark.slow
def test_it_trains_a_model_and_the_node_predicts_with_it(
    extended: Vehicle, bag: Path, recording: Recording, small_model: Path, tmp_path: Path
) -> None:
    config = parse_model_config(open_artifact(small_model).card.architecture, "card")
    saved = save_artifact(train(recording, config, extended, tmp_path / "checkpoint.pt"), tmp_path / "model")
    artifact = open_artifact(saved.path)
    assert artifact.card.vehicle == extended
    predictor = Predictor(OnnxModel(artifact), load_signal_map("default"))
    with open_bag(bag) as opened:
        outcomes = [one.outcome for one in replay(opened, predictor)]
    predictions = [one for one in outcomes if isinstance(one, Prediction)]
    assert len(predictions) > 900
    assert all(np.isfinite(one.state).all() for one in predictions)


def test_it_races(extended: Vehicle, path: Path) -> None:
    club = load_track("club")
    line = load_reference("centre", extended, club, speed_scale=0.6)
    course = Course(extended, club, "euler", line, Settings.of(extended))
    lap = race(course, load_prediction_model(str(path), load_vehicle("orca"), extended, "euler"))
    assert lap.completed
    assert lap.outside == 0.0
