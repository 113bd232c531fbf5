"""The predictor node over real DDS, in a process of its own."""

from __future__ import annotations

import os
import shutil
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nav_msgs.msg import Odometry

from benchmarks.endurance.live_run import run_live
from dynssm_ros.nodes.support import SENSOR_QOS
from dynssm_ros.runtime.artifact import open_artifact
from dynssm_ros.runtime.onnx_model import OnnxModel
from dynssm_ros.runtime.predictor import Prediction, Predictor
from dynssm_ros.runtime.replay import replay
from dynssm_ros.signals.bags import open_bag
from dynssm_ros.signals.extraction import extract
from dynssm_ros.signals.messages import PREDICTION_TOPIC, UNKNOWN
from dynssm_ros.signals.signal_map import load_signal_map
from dynssm_ros.signals.standard import recording_to_bag
from dynssm_ros.vehicle import COEFFICIENTS, load_vehicle

pytestmark = [pytest.mark.live, pytest.mark.timeout(120)]

H = 5
ACTUATORS = ("r_fb", "delta_fb", "r_cmd", "delta_cmd")
TF2_ROS = """
from geometry_msgs.msg import TransformStamped

class TransformBroadcaster:
    def __init__(self, node):
        self.sendTransform = node.create_publisher(TransformStamped, "/stand_in_of_tf", 10).publish
"""

SLOW_TO_DIAGNOSE = """
import time
from dynssm_ros.runtime.wiring import Wiring

Wiring.verdict = lambda self: time.sleep(0.15) or ""
"""


SLOW_TO_PREDICT = """
import time
from dynssm_ros.runtime.onnx_model import OnnxModel

quick = OnnxModel.predict
OnnxModel.predict = lambda self, windows: (time.sleep(0.06), quick(self, windows))[1]
"""


@pytest.fixture
def stand_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str, str], None]:
    """Writes a module that processes find which are started from now on."""

    def write(name: str, text: str) -> None:
        (tmp_path / f"{name}.py").write_text(text)
        monkeypatch.setenv("PYTHONPATH", f"{tmp_path}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")

    return write


def predictions(model: Path, bag: Path) -> dict[int, Prediction]:
    """What replay predicts, by the stamp of the predicted instant."""
    predictor = Predictor(OnnxModel(open_artifact(model)), load_signal_map("default"))
    with open_bag(bag) as opened:
        return {o.outcome.stamp: o.outcome for o in replay(opened, predictor) if isinstance(o.outcome, Prediction)}


def heard(car: Any, msgtype: Any, topic: str, qos: Any, wanted: Callable[[Any], bool] = lambda _: True) -> Any:
    """The newest such message of a topic that the node publishes beside its predictions, after driving until there is one.

    ``wanted``: of a busy machine rollouts are cut off; the whole one may come later.
    """
    messages: list[Any] = []
    car.collector.create_subscription(msgtype, topic, lambda m: messages.append(m) if wanted(m) else None, qos)

    def comes() -> bool:
        car.drive_until_answered()
        return car.collector.wait_for(lambda: bool(messages), 0.1)

    assert any(comes() for _ in range(50))
    return messages[-1]


@pytest.mark.parametrize(
    ("rate", "in_step"),
    [
        pytest.param(50.0, False, marks=[pytest.mark.slow, pytest.mark.alone]),
        pytest.param(100.0, False, marks=[pytest.mark.slow, pytest.mark.alone]),
        (100.0, True),
    ],
)
def test_every_odometry_message_after_the_first_window_gets_a_prediction_as_replay_gives_it(
    small_model: Path, laps_bag: Path, tmp_path: Path, rate: float, in_step: bool
) -> None:
    """In real time a machine that is busy passes some over; in step none is."""
    bag = tmp_path / "resampled"
    recording = extract([laps_bag], load_signal_map("default"), rate)
    recording_to_bag(recording, bag)
    run = run_live(small_model, bag, 0.02, duration=4.0, in_step=in_step)
    assert len(run.sent) >= 4.0 * rate
    assert run.lost == 0
    assert run.passed_over <= (0 if in_step else 0.3) * len(run.sent)
    # the first window begins with the first odometry that its actuators have not been overtaken by
    late = min(run.predicted) - run.T_s - sorted(run.sent)[round((H - 1) * 0.02 * rate)]
    assert 0 <= late <= 0.2e9

    offline = predictions(small_model, bag)
    stamps = sorted(run.predicted)
    live, expected = np.array([run.predicted[s] for s in stamps]), np.array([offline[s].state for s in stamps])
    # DDS keeps the order within a topic but not between topics: where odometry overtakes its actuators, the samples
    # before are held, and the node's prediction is another than that from the bag's order
    same = np.abs(live - expected).max(axis=1) < 1e-9
    assert same.mean() > 0.99
    overtaken = tmp_path / "overtaken"
    held = {name: np.r_[np.repeat(c[:1], 3), c[:-3]] for name, c in recording.columns.items() if name in ACTUATORS}
    recording_to_bag(replace(recording, columns=recording.columns | held), overtaken)
    always = predictions(small_model, overtaken)
    farthest = np.abs(np.array([always[s].state for s in stamps]) - expected).max(axis=0)
    assert (np.abs(live - expected) <= farthest).all()
    some = stamps[int(np.flatnonzero(same)[0])]
    np.testing.assert_allclose(run.parameters[some], offline[some].theta, atol=1e-12)
    assert len(run.parameters[some]) == len(COEFFICIENTS)


def test_bad_samples_yield_no_prediction_and_the_node_recovers_by_itself(car) -> None:
    assert car.drive_until_answered() == H
    nan = car.step(v_x=float("nan"))
    good = car.step()
    assert car.answered(good)
    assert nan not in car.run.predicted
    assert all(np.isfinite(state).all() for state in car.run.predicted.values())


@pytest.mark.parametrize("asked", [pytest.param("reliable", marks=pytest.mark.slow), "best_effort"])
def test_outputs_are_reliable_unless_asked_otherwise(start_car, asked: str) -> None:
    given = {} if asked == "reliable" else {"qos_overrides./dynssm/prediction.publisher.reliability": asked}
    car = start_car(**given)
    heard: list[Odometry] = []
    car.collector.create_subscription(Odometry, PREDICTION_TOPIC, heard.append, SENSOR_QOS)  # either can be heard so
    for _ in range(50):
        car.step()
        if car.collector.wait_for(lambda: bool(heard), 0.3):
            break
    assert heard
    (info,) = car.collector.get_publishers_info_by_topic("/dynssm/prediction")
    assert info.qos_profile.reliability.short_key == asked
    (other,) = car.collector.get_publishers_info_by_topic("/dynssm/parameters")
    assert other.qos_profile.reliability.short_key == "reliable"


@pytest.mark.parametrize("off", [-1.0, 1.0, 10.0])
def test_a_single_stamp_far_off_costs_its_message_alone(car, off: float) -> None:
    car.drive_until_answered()
    right = car.stamp
    car.stamp += round(off * 1e9)
    wrong = car.odometry(1.0)
    car.stamp = right
    assert car.answered(car.step())
    assert wrong not in car.run.predicted


def test_a_speed_that_no_car_has_is_refused_and_named(car) -> None:
    car.drive_until_answered()
    bad = [car.step(v_x=1e4) for _ in range(10)]
    assert car.diagnosed("a sample is beyond what the car can do")
    assert "v_x = 1e+04; expected" in car.run.diagnostics[-1][2]["implausible"]
    car.drive_until_answered()
    assert not any(stamp in car.run.predicted for stamp in bad)


def test_more_than_one_publisher_of_an_input_is_named(car) -> None:
    from nav_msgs.msg import Odometry

    from dynssm_ros.nodes.support import SENSOR_QOS

    second = car.collector.create_publisher(Odometry, "/vehicle/odometry", SENSOR_QOS)

    def is_named() -> bool:
        car.drive_until_answered()
        return car.diagnosed("") and "/vehicle/odometry: 2 publishers" in car.run.diagnostics[-1][1]

    assert any(is_named() for _ in range(30)), car.run.diagnostics[-1]
    car.collector.destroy_publisher(second)


def test_another_predictor_of_the_same_car_is_named(car) -> None:
    second = car.collector.create_publisher(Odometry, PREDICTION_TOPIC, SENSOR_QOS)

    def is_named() -> bool:
        car.drive_until_answered()
        message = Odometry()
        message.header.stamp.sec = 1
        second.publish(message)
        return car.diagnosed("another node publishes on /dynssm/prediction: /", timeout=0.3)

    assert any(is_named() for _ in range(100)), car.run.diagnostics[-1]
    assert car.run.diagnostics[-1][0] == 2
    car.collector.destroy_publisher(second)


def test_a_refused_set_of_parameters_leaves_no_model_behind(start_car, small_model: Path, tmp_path: Path) -> None:
    """The first model is good, but another one in the same atomic set is not; a later set is of something else."""
    car = start_car()
    car.drive_until_answered()
    other = shutil.copytree(small_model, tmp_path / "other")
    assert not car.set_atomically([("model", str(other)), ("model", str(tmp_path / "none"))])[0]
    assert car.set_parameter("horizon", 0.1) == (True, "")
    assert car.diagnosed("")
    assert car.run.diagnostics[-1][2]["model folder"] != str(other)


def test_time_that_jumps_back_restarts_the_window(car) -> None:
    car.drive_until_answered()
    car.stamp -= 10_000_000_000
    first = car.stamp + car.run.T_s
    assert car.drive_until_answered() >= H
    assert first not in car.run.predicted


@pytest.mark.parametrize("how", [{"actuators": False}, pytest.param({"commands": False}, marks=pytest.mark.slow)])
def test_stale_actuators_stop_predictions_and_diagnostics_say_so_until_they_are_back(car, how) -> None:
    car.drive_until_answered()
    stale = [car.step(**how) for _ in range(30)]
    assert car.diagnosed("silent for")
    assert not any(expected in car.run.predicted for expected in stale[15:])
    car.drive_until_answered()
    car.steps_until_diagnosed("predicting")


def test_odometry_that_stops_is_reported_as_silent(car) -> None:
    car.drive_until_answered()
    assert car.diagnosed("/vehicle/odometry: silent for")
    assert car.run.diagnostics[-1][0] == 2, "an error, not a warning"


def test_diagnostics_hold_rates_ages_latencies_and_refusals(car) -> None:
    before = int(car.run.diagnostics[-1][2]["refused: filling"])
    car.drive_until_answered()
    assert car.diagnosed("")
    values = car.run.diagnostics[-1][2]
    for key in ("latency p50 (ms)", "latency p99 (ms)", "share of the residual", "/vehicle/odometry rate (Hz)"):
        assert float(values[key]) >= 0
    assert int(values["refused: filling"]) - before == H - 1


def test_a_model_is_swapped_while_running_and_a_bad_one_is_refused(
    start_car, small_model: Path, tmp_path: Path
) -> None:
    car = start_car()
    car.drive_until_answered()
    successful, reason = car.set_parameter("model", str(tmp_path / "none"))
    assert not successful
    assert "no such model folder" in reason
    assert car.answered(car.step())
    other = shutil.copytree(small_model, tmp_path / "other")
    answers: list[tuple[bool, str]] = []
    asking = threading.Thread(target=lambda: answers.append(car.set_parameter("model", str(other))))
    asking.start()
    meanwhile = 0
    while asking.is_alive():
        assert car.answered(car.step()), "it predicts while the model is tried"
        meanwhile += 1
    assert answers == [(True, "")]
    assert meanwhile > 10
    assert car.answered(car.step()), "the window survives the swap"
    assert car.diagnosed("")
    assert car.run.diagnostics[-1][2]["model folder"] == str(other)


def test_the_horizon_is_published_on_request(start_car) -> None:
    from nav_msgs.msg import Path as PathMessage

    from dynssm_ros.nodes.support import SENSOR_QOS

    car = start_car(horizon=0.2)
    path = heard(car, PathMessage, "/dynssm/horizon", SENSOR_QOS, lambda path: len(path.poses) == 10)
    assert path.poses[0].header.stamp == path.header.stamp


def test_the_predicted_car_and_its_way_are_drawn(start_car) -> None:
    from visualization_msgs.msg import MarkerArray

    car = start_car(horizon=0.2, markers=True)
    body, way = heard(car, MarkerArray, "/dynssm/markers", 10, lambda m: len(m.markers[1].points) == 10).markers
    assert (body.header.frame_id, body.id, way.id) == ("map", 0, 1)
    assert body.pose.position.x == way.points[0].x, "the way begins at the predicted car"
    vehicle = load_vehicle("orca").constants
    assert body.points[0].x - body.points[2].x == pytest.approx(vehicle.l_f + vehicle.l_r), "from axle to axle"


def test_the_predicted_pose_is_sent_to_tf(start_car, stand_in: Callable[[str, str], None]) -> None:
    """With a stand-in of tf2_ros, which is not among the wheels."""
    from geometry_msgs.msg import TransformStamped

    stand_in("tf2_ros", TF2_ROS)
    car = start_car(tf=True)
    sent = heard(car, TransformStamped, "/stand_in_of_tf", 10)
    assert (sent.header.frame_id, sent.child_frame_id) == ("map", "base_link_predicted")
    ahead = sent.transform.translation.x - car.pose.x
    assert ahead == pytest.approx(0.02, abs=0.005), "a step of 20 ms at 1 m/s"
    assert sent.transform.rotation.w == pytest.approx(1.0, abs=1e-3)


@pytest.mark.slow
def test_diagnostics_that_take_longer_than_their_period_leave_time_for_what_waits(
    start_car, stand_in: Callable[[str, str], None]
) -> None:
    stand_in("sitecustomize", SLOW_TO_DIAGNOSE)
    car = start_car()
    car.drive_until_answered()
    stamps = [car.step() for _ in range(100)]
    assert car.answered(stamps[-1], timeout=5.0), "the newest"
    assert car.diagnosed("")
    assert len(car.run.missing()) <= car.run.passed_over


def test_a_node_that_cannot_keep_up_answers_the_newest_and_says_so(
    start_car, stand_in: Callable[[str, str], None]
) -> None:
    """Each message takes three periods."""
    stand_in("sitecustomize", SLOW_TO_PREDICT)
    car = start_car()
    car.drive_until_answered()
    pause, behind = threading.Event(), []
    for _ in range(150):
        expected = car.step()
        pause.wait(0.02)  # nobody sets it: the rate of a car
        behind.append((expected - max(car.run.predicted)) / 1e9)
    assert max(behind[50:]) < 0.3, "it does not fall behind further and further"
    assert car.diagnosed("newer odometry waited") or car.diagnosed("it cannot keep up")
    assert car.run.diagnostics[-1][0] > 0
    assert car.run.passed_over > 30
    assert float(car.run.diagnostics[-1][2]["latency p99 (ms)"]) > 50


def test_a_rollout_that_takes_too_long_is_cut_off(start_car) -> None:
    from nav_msgs.msg import Path as PathMessage

    car = start_car(horizon=10.0)
    path = heard(car, PathMessage, "/dynssm/horizon", SENSOR_QOS)
    assert 1 <= len(path.poses) < 500


@pytest.mark.parametrize(
    ("spoilt", "verdict"),
    [
        (lambda message: setattr(message.pose.pose.orientation, "w", 0.0), "the orientation is no quaternion"),
        (lambda message: setattr(message.pose.pose.position, "x", 1e300), "a sample is beyond what the car can do"),
        (lambda message: setattr(message, "child_frame_id", "map"), "the odometry is in other frames"),
        (lambda message: setattr(message.header, "frame_id", ""), "the odometry is in other frames"),
    ],
    ids=["no orientation", "far away", "other child frame", "empty frame"],
)
def test_from_a_pose_that_cannot_be_nothing_is_predicted_and_it_is_named(car, spoilt, verdict: str) -> None:
    car.drive_until_answered()
    car.spoil = spoilt
    bad = [car.step() for _ in range(10)]
    assert car.diagnosed(verdict)
    car.spoil = None
    car.drive_until_answered()
    assert not any(stamp in car.run.predicted for stamp in bad)


def test_parameters_are_listed_described_and_read(start_car, small_model: Path, call_service) -> None:
    """What `ros2 param list`, `describe` and `get` ask a node for."""
    from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters

    car = start_car(wait=False)
    names = call_service(car.collector, ListParameters, "/dynssm/list_parameters").result.names
    assert {"model", "model_root", "signals", "max_age", "online", "horizon", "tf", "use_sim_time"} <= set(names)
    assert "qos_overrides./dynssm/prediction.publisher.reliability" in names
    asked = ["model", "max_age", "tf"]
    described = call_service(car.collector, DescribeParameters, "/dynssm/describe_parameters", names=asked).descriptors
    assert all(one.description.endswith(".") for one in described)
    (limits,) = described[1].floating_point_range
    assert (limits.from_value, limits.to_value) == (0.01, 10.0)
    assert [one.read_only for one in described] == [False, True, True]
    values = call_service(car.collector, GetParameters, "/dynssm/get_parameters", names=asked).values
    assert (values[0].string_value, values[1].double_value, values[2].bool_value) == (str(small_model), 0.2, False)


def test_the_pose_of_a_prediction_claims_no_certainty(car) -> None:
    from nav_msgs.msg import Odometry

    from dynssm_ros.nodes.support import SENSOR_QOS

    prediction = heard(car, Odometry, "/dynssm/prediction", SENSOR_QOS)
    np.testing.assert_array_equal(np.reshape(prediction.pose.covariance, (6, 6)), UNKNOWN * np.eye(6))
    stated = np.diag(np.reshape(prediction.twist.covariance, (6, 6)))
    assert (stated[[0, 1, 5]] < 1.0).all()
    np.testing.assert_array_equal(stated[2:5], UNKNOWN)


def test_models_are_taken_from_below_their_root_only(start_car, small_model: Path, tmp_path: Path) -> None:
    root = tmp_path / "models"
    car = start_car(model=shutil.copytree(small_model, root / "a"), model_root=root)
    car.drive_until_answered()
    (root / "link").symlink_to(small_model)
    for outside in (small_model, root / "link", root / ".." / "models_of_others"):
        successful, reason = car.set_parameter("model", str(outside))
        assert not successful
        assert reason == f"{outside}: is not below {root}; expected a folder in it (parameter model_root)"
    assert car.set_parameter("model", str(shutil.copytree(small_model, root / "b"))) == (True, "")


def test_the_process_holds_no_torch(car) -> None:
    car.drive_until_answered()
    mapped = Path(f"/proc/{car.process.pid}/maps").read_text()
    assert "onnxruntime" in mapped
    assert "torch" not in mapped


@pytest.mark.slow
def test_simulated_time_without_a_clock_does_not_hinder_predictions(start_car) -> None:
    car = start_car(use_sim_time=True)
    assert car.drive_until_answered() == H
