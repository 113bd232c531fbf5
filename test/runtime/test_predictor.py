"""The predictor between decoded samples and predictions: equality with the model, refusals, recovery, horizon."""

from __future__ import annotations

import math
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml

from dynssm_ros.errors import ArtifactError, ConfigurationError
from dynssm_ros.runtime.artifact import open_artifact
from dynssm_ros.runtime.models import OnnxModel
from dynssm_ros.runtime.predictor import Prediction, Predictor, propagate_pose
from dynssm_ros.signals.history import Refusal
from dynssm_ros.signals.signal_map import load_signal_map

T_S, H = 0.02, 5
PERIOD = 20_000_000  # ns
START = 1_700_000_000_000_000_000
DEFAULT = load_signal_map("default")


class Drive:
    """A straight drive fed to a predictor sample by sample."""

    def __init__(self, model: Path) -> None:
        self.predictor = Predictor(OnnxModel(open_artifact(model)), DEFAULT)
        self.stamp = START

    def actuators(self) -> None:
        for kind in ("feedback", "command"):
            self.predictor.observe(self.stamp, {f"throttle_{kind}": 0.2, f"steering_{kind}": 0.05})

    def odometry(self, **changed: float) -> Prediction | Refusal:
        values = {"v_x": 1.0, "v_y": 0.0, "omega": 0.1, "x": 0.0, "y": 0.0, "theta": 0.0} | changed
        return self.predictor.predict(self.stamp, values)

    def step(self, **changed: float) -> Prediction | Refusal:
        self.actuators()
        outcome = self.odometry(**changed)
        self.stamp += PERIOD
        return outcome

    def fill(self) -> Prediction:
        for _ in range(H - 1):
            assert self.step() is Refusal.FILLING
        outcome = self.step()
        assert isinstance(outcome, Prediction)
        return outcome


@pytest.fixture
def drive(small_model: Path) -> Drive:
    return Drive(small_model)


def test_the_prediction_is_the_models_for_the_window_one_sampling_time_ahead(drive: Drive) -> None:
    outcome = drive.fill()
    window = drive.predictor.history.current
    np.testing.assert_allclose(window[:, 0], 1.0)
    np.testing.assert_allclose(window[:, 4], 0.05)
    alone, among_others = (drive.predictor.model.predict(np.stack([window] * count)) for count in (1, 3))
    np.testing.assert_array_equal(outcome.state, alone.state[0])
    np.testing.assert_allclose(alone.state[0], among_others.state[1], rtol=0, atol=1e-6)
    assert outcome.theta is not None
    np.testing.assert_array_equal(outcome.theta, alone.theta[0])
    assert outcome.stamp == drive.stamp - PERIOD + PERIOD
    assert 0.0 <= outcome.residual_share <= 1.0


def test_earlier_predictions_are_not_overwritten_by_later_ones(drive: Drive) -> None:
    first = drive.fill()
    kept = first.state.copy(), first.theta.copy()
    drive.step(v_x=1.2)
    np.testing.assert_array_equal(first.state, kept[0])
    np.testing.assert_array_equal(first.theta, kept[1])


@pytest.mark.parametrize("name", ["v_x", "omega", "x", "theta"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_sample_that_is_not_finite_yields_nothing_and_the_next_good_one_does(
    drive: Drive, name: str, value: float
) -> None:
    drive.fill()
    assert drive.step(**{name: value}) is Refusal.NOT_FINITE
    assert isinstance(drive.step(), Prediction)


def test_a_repeated_or_late_stamp_yields_nothing(drive: Drive) -> None:
    drive.fill()
    drive.stamp -= PERIOD
    assert drive.odometry() is Refusal.REPEATED
    drive.stamp -= PERIOD
    assert drive.odometry() is Refusal.REPEATED
    drive.stamp += 2 * PERIOD
    assert isinstance(drive.step(), Prediction)


def test_time_that_jumps_back_starts_a_new_window(drive: Drive) -> None:
    drive.fill()
    drive.stamp = START - 100_000_000_000
    drive.actuators()
    assert drive.odometry() is not None
    drive.stamp += PERIOD
    outcomes = [drive.step() for _ in range(H)]
    assert isinstance(outcomes[-1], Prediction)
    assert all(outcome is Refusal.FILLING for outcome in outcomes[: H - 2])


def test_stale_actuators_yield_nothing_until_they_are_back(drive: Drive) -> None:
    drive.fill()
    outcomes = []
    for _ in range(30):
        outcomes.append(drive.odometry())
        drive.stamp += PERIOD
    held = [isinstance(outcome, Prediction) for outcome in outcomes]
    assert held == [True] * 10 + [False] * 20  # up to max_age, 0.2 s, after the last actuator sample
    assert outcomes[-1] is Refusal.STALE
    outcomes = [drive.step() for _ in range(H)]
    assert isinstance(outcomes[-1], Prediction)


def test_a_signal_that_never_came_is_missing(small_model: Path) -> None:
    predictor = Predictor(OnnxModel(open_artifact(small_model)), DEFAULT)
    assert predictor.predict(START, {"v_x": 1.0, "v_y": 0.0, "omega": 0.0}) is Refusal.MISSING


def test_a_gap_in_the_odometry_restarts_the_window(drive: Drive) -> None:
    drive.fill()
    drive.stamp += round(DEFAULT.max_gap * 1e9)
    assert drive.step() is Refusal.FILLING
    assert [isinstance(drive.step(), Prediction) for _ in range(H - 1)] == [False] * (H - 2) + [True]


def test_joint_states_that_name_one_actuator_at_a_time_are_enough(drive: Drive) -> None:
    for k in range(H):
        for kind in ("feedback", "command"):
            for joint in ("throttle", "steering"):
                assert drive.predictor.observe(drive.stamp, {f"{joint}_{kind}": 0.01 * k}) is None
        outcome = drive.odometry()
        drive.stamp += PERIOD
    assert isinstance(outcome, Prediction)


def test_a_model_is_swapped_without_losing_the_window(drive: Drive, small_model: Path) -> None:
    drive.fill()
    drive.predictor.swap(OnnxModel(open_artifact(small_model)))
    assert isinstance(drive.step(), Prediction)


@pytest.mark.parametrize(
    ("commands", "error", "words"),
    [("lookahead", ArtifactError, "look into the future"), ("topics", ConfigurationError, "missing throttle_command")],
)
def test_commands_that_do_not_exist_live_are_refused(
    small_model: Path, tmp_path: Path, commands: str, error: type[Exception], words: str
) -> None:
    folder = shutil.copytree(small_model, tmp_path / "model")
    card = yaml.safe_load((folder / "model.yaml").read_text())
    (folder / "model.yaml").write_text(yaml.safe_dump(card | {"commands": commands}))
    with pytest.raises(error, match=words):
        Predictor(OnnxModel(open_artifact(folder)), load_signal_map("av21"))


def test_the_horizon_begins_with_the_prediction_and_goes_on_with_the_command_held(drive: Drive) -> None:
    outcome = drive.fill()
    poses = drive.predictor.horizon(outcome, 10)
    assert len(poses) == 10
    assert poses[0] == outcome.pose
    travelled = np.diff(np.array(poses)[:, 0])
    assert (travelled > 0).all()
    np.testing.assert_allclose(travelled[0], outcome.state[0] * T_S, rtol=0.05)


def test_a_pose_is_propagated_along_a_circle_to_second_order() -> None:
    def end(steps: int) -> np.ndarray:
        pose: dict[str, float] = {"x": 0.0, "y": 0.0, "theta": 0.0}
        for _ in range(steps):
            moved = propagate_pose(pose, (2.0, 0.0, 0.5), (2.0, 0.0, 0.5), 1.0 / steps)
            assert moved is not None
            pose = dict(zip(("x", "y", "theta"), moved, strict=True))
        return np.array([pose["x"], pose["y"], pose["theta"]])

    truth = np.array([4.0 * math.sin(0.5), 4.0 * (1 - math.cos(0.5)), 0.5])
    errors = [np.abs(end(steps) - truth).max() for steps in (4, 8)]
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.05)
    assert propagate_pose({"x": 0.0}, (1.0, 0.0, 0.0), (1.0, 0.0, 0.0), 0.1) is None
