"""Offline replay: the live predictor fed from a bag."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dynssm_ros.errors import BagError
from dynssm_ros.runtime.artifact import open_artifact
from dynssm_ros.runtime.contract import WindowPrediction
from dynssm_ros.runtime.onnx_model import OnnxModel
from dynssm_ros.runtime.predictor import Prediction, Predictor
from dynssm_ros.runtime.replay import replay, replay_to_bag
from dynssm_ros.signals.bags import open_bag
from dynssm_ros.signals.estimation import estimated
from dynssm_ros.signals.extraction import extract, read_streams
from dynssm_ros.signals.history import Refusal
from dynssm_ros.signals.signal_map import SignalMap, load_signal_map
from dynssm_ros.vehicle import COEFFICIENTS

H = 5
DEFAULT = load_signal_map("default")


@pytest.fixture
def predictor(small_model: Path) -> Predictor:
    return Predictor(OnnxModel(open_artifact(small_model)), DEFAULT)


def test_replay_gives_what_evaluation_computes_from_the_recording(predictor: Predictor, laps_bag: Path) -> None:
    with open_bag(laps_bag) as bag:
        outcomes = [answer.outcome for answer in replay(bag, predictor)]
    assert outcomes[: H - 1] == [Refusal.FILLING] * (H - 1)
    predicted = np.array([outcome.state for outcome in outcomes[H - 1 :] if isinstance(outcome, Prediction)])
    rows = extract([laps_bag], DEFAULT, 50.0).matrix
    windows = np.lib.stride_tricks.sliding_window_view(rows, H, axis=0).transpose(0, 2, 1)
    assert len(predicted) == len(windows) == len(rows) - H + 1
    np.testing.assert_allclose(predicted, predictor.model.predict(windows).state, rtol=1e-6, atol=1e-6)


def test_from_poses_alone_it_predicts_what_it_does_from_velocities(small_model: Path, laps_bag: Path) -> None:
    content = DEFAULT.model_dump()
    signals = {name: source for name, source in content["signals"].items() if name not in ("v_x", "v_y", "omega")}
    poses = SignalMap.model_validate(content | {"signals": signals, "velocities": {"window": 0.08}})
    states = []
    for signal_map in (DEFAULT, poses):
        model = OnnxModel(open_artifact(small_model))
        with open_bag(laps_bag) as bag:
            outcomes = [answer.outcome for answer in replay(bag, Predictor(model, signal_map))]
        states.append([outcome.state if isinstance(outcome, Prediction) else None for outcome in outcomes])
    given, from_poses = states
    later = sum(state is None for state in from_poses) - sum(state is None for state in given)
    assert later == 3  # a motion is fitted to four poses at least
    both = np.array([(a, b) for a, b in zip(given, from_poses, strict=True) if b is not None])
    apart = np.sqrt(((both[:, 0] - both[:, 1]) ** 2).mean(axis=0))
    # these laps move in Euler steps, by the heading at the start of a step, so that v_y is another by half a step
    assert (apart[[0, 2]] < 0.1 * both[:, 0].std(axis=0)[[0, 2]]).all()


def test_where_v_y_is_estimated_it_predicts_from_the_causal_estimate(small_model: Path, laps_bag: Path) -> None:
    content = DEFAULT.with_commands(None).model_dump()
    signals = {name: source for name, source in content["signals"].items() if name not in ("v_y", "x", "y", "theta")}
    estimating = SignalMap.model_validate(content | {"signals": signals, "estimation": {"rear_axle": 0.033}})
    predictor, rows = Predictor(OnnxModel(open_artifact(small_model)), estimating), []
    with open_bag(laps_bag) as bag:
        rows = [predictor.row[:3].copy() for answer in replay(bag, predictor) if isinstance(answer.outcome, Prediction)]
        streams = read_streams(bag, estimating).streams
    assert estimating.estimation is not None
    samples = {name: (one.stamps, one.values) for name, one in streams.items()}
    batch = estimated(samples, estimating.estimation, estimating.max_gap_ns, both_sides=False).states
    assert len(rows) == len(batch) - H + 1
    np.testing.assert_allclose(rows, batch[H - 1 :], rtol=0, atol=1e-9)


def test_the_new_bag_holds_predictions_parameters_and_on_request_the_inputs(
    predictor: Predictor, laps_bag: Path, tmp_path: Path
) -> None:
    count, refusals, notes = replay_to_bag(laps_bag, predictor, tmp_path / "out", with_inputs=True)
    assert (count, refusals, notes) == (997, {Refusal.FILLING: H - 1}, [])
    with open_bag(tmp_path / "out") as bag, open_bag(laps_bag) as source:
        assert bag.counts == {"/dynssm/prediction": count, "/dynssm/parameters": count, **source.counts}
        topic, log_time, raw = next(iter(bag.messages(["/dynssm/prediction"])))
        message = bag.decode(topic, raw)
        parameters = bag.decode("/dynssm/parameters", next(iter(bag.messages(["/dynssm/parameters"]))).raw)
    stamp = message.header.stamp
    assert stamp.sec * 10**9 + stamp.nanosec == pytest.approx(log_time + 20_000_000, abs=10_000)
    assert (message.header.frame_id, message.child_frame_id) == ("map", "base_link")
    variances = message.twist.covariance[[0, 7, 35]]
    np.testing.assert_allclose(variances, predictor.model.artifact.card.covariance)
    assert parameters.name == list(COEFFICIENTS)


def test_the_covariance_in_the_bag_is_the_one_stated_with_each_prediction(
    predictor: Predictor, laps_bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    well = predictor.model.predict

    def of_the_speed(windows: np.ndarray) -> WindowPrediction:
        return well(windows)._replace(variance=np.abs(windows[:, -1, :3]))

    monkeypatch.setattr(predictor.model, "predict", of_the_speed)
    replay_to_bag(laps_bag, predictor, tmp_path / "out", with_inputs=True)
    with open_bag(tmp_path / "out") as bag:
        predicted = {
            log_time: bag.decode(topic, raw).twist.covariance[[0, 7, 35]]
            for topic, log_time, raw in bag.messages(["/dynssm/prediction"])
        }
        measured = {
            log_time: bag.decode(topic, raw).twist.twist for topic, log_time, raw in bag.messages(["/vehicle/odometry"])
        }
    assert len({tuple(variances) for variances in predicted.values()}) > 900
    for log_time, variances in predicted.items():
        twist = measured[log_time]
        now = [twist.linear.x, twist.linear.y, twist.angular.z]
        np.testing.assert_allclose(variances, np.abs(now), rtol=1e-12)


def test_a_bag_without_the_topics_leaves_nothing_behind(predictor: Predictor, orca_bag: Path, tmp_path: Path) -> None:
    other = load_signal_map("default").model_dump()
    for source in other["signals"].values():
        source["topic"] = source["topic"].replace("vehicle", "car")
    renamed = Predictor(predictor.model, type(DEFAULT).model_validate(other))
    with pytest.raises(BagError, match="topic /car/actuator_feedback is missing"):
        replay_to_bag(orca_bag, renamed, tmp_path / "out")
    assert list(tmp_path.iterdir()) == []
