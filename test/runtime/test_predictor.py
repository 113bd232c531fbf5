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
from dynssm_ros.runtime.contract import WindowPrediction
from dynssm_ros.runtime.onnx_model import OnnxModel
from dynssm_ros.runtime.predictor import Prediction, Predictor, propagate_pose
from dynssm_ros.signals.extraction import extract
from dynssm_ros.signals.history import Refusal
from dynssm_ros.signals.signal_map import load_signal_map

T_S, H = 0.02, 5
PERIOD = 20_000_000  # ns
START = 1_700_000_000_000_000_000
DEFAULT = load_signal_map("default")


class Drive:
    """A steady turn fed to a predictor sample by sample."""

    def __init__(self, model: Path) -> None:
        self.predictor = Predictor(OnnxModel(open_artifact(model)), DEFAULT)
        self.stamp = START

    def actuators(self) -> None:
        for kind in ("feedback", "command"):
            self.predictor.observe(self.stamp, {f"throttle_{kind}": 0.2, f"steering_{kind}": 0.05})

    def odometry(self, **changed: float) -> Prediction | Refusal:
        theta = 0.1 * (self.stamp - START) / 1e9
        pose = {"x": 10.0 * math.sin(theta), "y": 10.0 * (1.0 - math.cos(theta)), "theta": theta}
        values = {"v_x": 1.0, "v_y": 0.0, "omega": 0.1} | pose | changed
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


class Still(OnnxModel):
    """Says that nothing changes, and remembers what it was asked."""

    def __init__(self, model: Path) -> None:
        super().__init__(open_artifact(model))
        self.asked: list[np.ndarray] = []
        self.physics = 0.0

    def predict(self, windows: np.ndarray) -> WindowPrediction:
        self.asked.append(windows.copy())
        now = windows[:, -1, :3].copy()
        return WindowPrediction(now, None, now + self.physics)


@pytest.fixture
def still(small_model: Path) -> Still:
    return Still(small_model)


@pytest.fixture
def drive(small_model: Path) -> Drive:
    return Drive(small_model)


def test_samples_on_the_grid_give_what_the_model_says_of_the_recordings_windows(drive: Drive, laps_bag: Path) -> None:
    recording = extract([laps_bag], DEFAULT, 50.0).select(slice(0, 120))
    model, compared = drive.predictor.model, 0
    for k, (stamp, row) in enumerate(zip(recording.time.tolist(), recording.matrix.tolist(), strict=True)):
        v_x, v_y, omega, r, delta, more_r, more_delta = row
        drive.predictor.observe(stamp, {"throttle_feedback": r, "steering_feedback": delta})
        drive.predictor.observe(stamp, {"throttle_command": r + more_r, "steering_command": delta + more_delta})
        outcome = drive.predictor.predict(stamp, {"v_x": v_x, "v_y": v_y, "omega": omega})
        if k < H - 1:
            assert outcome is Refusal.FILLING
            continue
        expected = model.predict(recording.matrix[k - H + 1 : k + 1][None])
        assert isinstance(outcome, Prediction)
        assert outcome.pose is None
        np.testing.assert_allclose(outcome.state, expected.state[0], rtol=0, atol=1e-9)
        np.testing.assert_allclose(outcome.theta, expected.theta[0], rtol=0, atol=1e-9)
        compared += 1
    assert compared == 120 - H + 1


def test_the_prediction_is_the_models_for_the_window_one_sampling_time_ahead(drive: Drive) -> None:
    outcome = drive.fill()
    window = np.tile(drive.predictor.row, (H, 1))  # of a steady drive
    np.testing.assert_allclose(window[-1, [0, 4]], [1.0, 0.05])
    alone, among_others = (drive.predictor.model.predict(np.stack([window] * count)) for count in (1, 3))
    np.testing.assert_array_equal(outcome.state, alone.state[0])
    np.testing.assert_allclose(alone.state[0], among_others.state[1], rtol=0, atol=1e-6)
    assert outcome.theta is not None
    np.testing.assert_array_equal(outcome.theta, alone.theta[0])
    np.testing.assert_array_equal(outcome.variance, alone.variance[0])
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
    outcome = drive.step(**{name: value})
    assert outcome is (Refusal.NO_ORIENTATION if name == "theta" and math.isnan(value) else Refusal.NOT_FINITE)
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
    predictor.observe(START, {"throttle_feedback": 0.2, "steering_feedback": 0.0, "throttle_command": 0.2})
    assert predictor.predict(START + PERIOD, {"v_x": 1.0, "v_y": 0.0, "omega": 0.0}) is Refusal.MISSING


@pytest.mark.parametrize("spoilt", ["state", "theta", "variance"])
def test_a_model_that_yields_nan_yields_no_prediction_until_it_is_well_again(
    drive: Drive, monkeypatch: pytest.MonkeyPatch, spoilt: str
) -> None:
    expected, model = drive.fill(), drive.predictor.model
    with monkeypatch.context() as ill:
        well = model.predict
        ill.setattr(
            model,
            "predict",
            lambda windows: well(windows)._replace(**{spoilt: np.array([[0.0, np.nan, 0.0]])}),
        )
        assert drive.step() is Refusal.BAD_PREDICTION
    outcome = drive.step()
    assert isinstance(outcome, Prediction)
    np.testing.assert_allclose(outcome.state, expected.state)


@pytest.mark.parametrize(
    ("spoilt", "value", "words"),
    [
        ("state", [1e29, 0.0, 0.0], "predicted v_x = 1e+29; expected -"),
        ("state", [2.5, 0.0, 0.1], "predicted v_x = 2.5 after 1"),
        ("variance", [1e-4, -1e-4, 1e-4], "predicted variance -0.0001; expected more than zero"),
        ("theta", [1e3] * 17, "= 1000; expected"),
    ],
)
def test_what_the_car_cannot_do_is_no_prediction_and_named(
    drive: Drive, monkeypatch: pytest.MonkeyPatch, spoilt: str, value: list[float], words: str
) -> None:
    drive.fill()
    with monkeypatch.context() as ill:
        well = drive.predictor.model.predict
        ill.setattr(drive.predictor.model, "predict", lambda w: well(w)._replace(**{spoilt: np.array([value])}))
        assert drive.step() is Refusal.IMPLAUSIBLE_PREDICTION
    assert words in drive.predictor.figures()["implausible"]
    assert isinstance(drive.step(), Prediction)


def test_the_rows_of_the_last_seconds_are_those_since_the_last_gap_a_sampling_time_apart(drive: Drive) -> None:
    assert drive.predictor.recent().shape == (0, 7)
    drive.fill()
    drive.stamp += 10 * 10**9
    for k in range(40):  # odometry at 100 Hz, speeding up
        drive.actuators()
        drive.odometry(v_x=1.0 + 0.01 * k)
        drive.stamp += PERIOD // 2
    recent = drive.predictor.recent()
    np.testing.assert_allclose(np.diff(recent[:, 0]), 0.02, atol=1e-12)
    assert recent[-1, 0] == pytest.approx(1.39)
    assert len(recent) == (40 - 2 * (H - 1) + 1) // 2


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


def test_a_longer_window_fills_on_from_what_is_there(drive: Drive, still: Still) -> None:
    drive.fill()
    still.H = H + 2
    drive.predictor.swap(still)
    assert drive.step() is Refusal.FILLING
    assert isinstance(drive.step(), Prediction)


def test_a_model_for_other_commands_is_not_swapped_in(drive: Drive, small_model: Path) -> None:
    drive.fill()
    other, before = OnnxModel(open_artifact(small_model)), drive.predictor.model
    other.commands = "none"
    with pytest.raises(ArtifactError, match=r"small: trained with commands 'none', but the node runs with 'topics'"):
        drive.predictor.swap(other)
    assert drive.predictor.model is before
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


def test_at_constant_velocity_the_horizon_is_the_line_or_the_circle_that_is_driven(drive: Drive, still: Still) -> None:
    drive.predictor.swap(still)
    for omega in (0.0, 0.8):
        drive.stamp += 10 * 10**9  # a gap, after which the car is elsewhere
        for _ in range(H - 1):
            drive.actuators()
            drive.predictor.predict(drive.stamp, {"v_x": 2.0, "v_y": 0.0, "omega": omega})
            drive.stamp += PERIOD
        outcome = drive.step(v_x=2.0, v_y=0.0, omega=omega, x=1.0, y=-1.0, theta=0.3)
        assert isinstance(outcome, Prediction)
        poses = np.array(drive.predictor.horizon(outcome, 25))
        t = T_S * np.arange(1, 26)
        np.testing.assert_allclose(poses[:, 2], 0.3 + omega * t, atol=1e-12)
        along = t if omega == 0 else 2 * np.sin(omega * t / 2) / omega  # chord and its direction
        heading = 0.3 + omega * t / 2
        expected = np.stack([1 + 2 * along * np.cos(heading), -1 + 2 * along * np.sin(heading)], axis=1)
        np.testing.assert_allclose(poses[:, :2], expected, atol=1e-12 if omega == 0 else 1e-4)


def test_over_the_horizon_the_actuators_stay_at_the_last_command(drive: Drive, still: Still) -> None:
    drive.predictor.swap(still)
    drive.fill()
    drive.predictor.observe(drive.stamp, {"throttle_feedback": 0.2, "steering_feedback": 0.05})
    drive.predictor.observe(drive.stamp, {"throttle_command": 0.5, "steering_command": -0.1})
    outcome = drive.odometry(v_x=1.0)
    assert isinstance(outcome, Prediction)
    still.asked.clear()
    assert len(drive.predictor.horizon(outcome, 4)) == 4
    assert len(still.asked) == 3
    for k, asked in enumerate(still.asked):
        expected = np.tile([1.0, 0.0, 0.1, 0.5, -0.1, 0.0, 0.0], (k + 1, 1))
        np.testing.assert_allclose(asked[0, H - 1 - k :], expected, atol=1e-12)
        np.testing.assert_allclose(asked[0, H - 2 - k], [1.0, 0.0, 0.1, 0.2, 0.05, 0.3, -0.15], atol=1e-12)
    np.testing.assert_allclose(drive.predictor.row[5:], [0.3, -0.15])  # not changed by the rollout


def test_a_rollout_of_the_held_command_is_the_prediction_and_its_horizon(drive: Drive) -> None:
    assert drive.predictor.rollout(np.zeros((1, 2))) is None, "nothing was predicted"
    outcome = drive.fill()
    row = drive.predictor.row
    held = np.tile(row[3:5] + row[5:7], (10, 1))
    found = drive.predictor.rollout(held)
    assert found is not None
    assert found.stamp == outcome.stamp - PERIOD
    np.testing.assert_allclose(found.states[0], outcome.state, atol=1e-12)
    np.testing.assert_allclose(found.poses, drive.predictor.horizon(outcome, 10), atol=1e-9)
    assert len(found.states) == 10
    assert drive.predictor.rollout(held, deadline=-1.0).states == [], "its time is up"
    right, left = (drive.predictor.rollout(held + np.array([0.0, side])) for side in (-9.0, 9.0))
    assert left.poses[-1].theta > found.poses[-1].theta > right.poses[-1].theta
    _, high = drive.predictor.vehicle.inputs.steering
    np.testing.assert_array_equal(left.states, drive.predictor.rollout(np.c_[held[:, 0], np.full(10, high)]).states)
    drive.stamp += 10 * 10**9
    drive.odometry(v_x=1.0)
    assert drive.predictor.rollout(held) is None, "the newest odometry has no prediction"


def test_in_a_rollout_each_input_acts_for_its_step(drive: Drive, still: Still) -> None:
    drive.predictor.swap(still)
    drive.fill()
    inputs = np.array([[0.1, 0.01], [0.2, -0.02], [0.4, 0.04]])
    still.asked.clear()
    assert drive.predictor.rollout(inputs) is not None
    for asked, applied in zip(still.asked, inputs, strict=True):
        np.testing.assert_allclose(asked[0, -1, 3:5] + asked[0, -1, 5:7], applied, atol=1e-12)
    np.testing.assert_allclose(still.asked[2][0, -1, 3:5], inputs[1], atol=1e-12)


def test_without_a_pose_there_is_no_horizon(drive: Drive) -> None:
    drive.fill()
    drive.actuators()
    outcome = drive.predictor.predict(drive.stamp, {"v_x": 1.0, "v_y": 0.0, "omega": 0.0})
    assert isinstance(outcome, Prediction)
    assert outcome.pose is None
    assert drive.predictor.horizon(outcome, 10) == []


def test_a_model_that_states_no_variances_still_predicts(drive: Drive, still: Still) -> None:
    drive.predictor.swap(still)
    assert drive.fill().variance is None


@pytest.mark.parametrize(("physics", "share"), [(0.0, 0.0), (1e-3, 0.5)])
def test_the_share_of_the_residual_is_its_part_of_what_changes(
    drive: Drive, still: Still, physics: float, share: float
) -> None:
    drive.predictor.swap(still)
    drive.fill()
    still.physics = physics  # the residual takes back what the physics adds
    outcome = drive.step()
    assert isinstance(outcome, Prediction)
    assert outcome.residual_share == pytest.approx(share)


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


@pytest.mark.parametrize("wrong", [{"v_x": 1e4}, {"omega": 500.0}])
def test_implausible_samples_yield_no_prediction_and_cost_no_window(drive: Drive, wrong) -> None:
    for _ in range(H + 1):
        drive.step()
    for name, value in wrong.items():
        stamp = drive.stamp + 1
        state = {"v_x": 2.0, "v_y": 0.0, "omega": 0.0, "x": 0.0, "y": 0.0, "theta": 0.0} | {name: value}
        assert drive.predictor.predict(stamp, state) is Refusal.IMPLAUSIBLE
        assert name in drive.predictor.figures()["implausible"]
    assert isinstance(drive.step(), Prediction)


def test_a_model_whose_predictions_are_not_finite_is_not_swapped_in(
    drive: Drive, small_model: Path, monkeypatch
) -> None:
    for _ in range(H + 1):
        drive.step()
    candidate = OnnxModel(open_artifact(small_model))
    good = candidate.predict
    monkeypatch.setattr(candidate, "predict", lambda windows: good(windows)._replace(state=np.full((1, 3), np.nan)))
    with pytest.raises(ArtifactError, match="is not finite"):
        drive.predictor.swap(candidate)
    assert isinstance(drive.step(), Prediction)
