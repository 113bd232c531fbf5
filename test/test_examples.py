"""The examples do what their first lines say."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from dynssm_ros import simulate
from dynssm_ros.signals.messages import PARAMETERS_TOPIC, PREDICTION_TOPIC
from dynssm_ros.simulation.laps import write_run
from dynssm_ros.vehicle import load_vehicle
from examples import a_hidden_cause_found, a_log_to_a_prediction

ROOT = Path(__file__).resolve().parent.parent


@pytest.mark.slow
def test_a_log_becomes_a_prediction_that_beats_persistence(tmp_path: Path) -> None:
    write_run(simulate("orca", "club", duration=30.0, plant="euler", noise=(0.01, 0.01, 0.03)), tmp_path / "laps")
    ade = a_log_to_a_prediction.main(tmp_path / "laps", "default", "orca", tmp_path)
    assert ade["rls"] < ade["single_track"] < 0.5 * ade["persistence"]


@pytest.mark.slow
def test_the_hidden_cause_is_found() -> None:
    (cause,) = a_hidden_cause_found.main().causes
    assert cause.effect == "steering_offset"
    assert abs(cause.values["offset"] - 0.03) < 3 * cause.std["offset"] + 0.003


@pytest.mark.slow
@pytest.mark.live
@pytest.mark.timeout(300)
def test_an_mpc_of_ones_own_follows_the_line_on_published_coefficients() -> None:
    from nav_msgs.msg import Odometry
    from sensor_msgs.msg import JointState

    from benchmarks.endurance.live_run import LiveRun, collecting, isolated_environment, node_process
    from dynssm_ros.nodes.support import SENSOR_QOS
    from dynssm_ros.track.tracks import load_track
    from dynssm_ros.vehicle import COEFFICIENTS, load_vehicle

    centre = load_track("club").centre
    nominal = load_vehicle("orca").nominal
    driven: list[Odometry] = []
    run = LiveRun(20_000_000)
    os.environ.update(isolated_environment())
    with collecting(run) as collector:

        def odometry(message: Odometry) -> None:
            coefficients = JointState(name=list(COEFFICIENTS), position=[float(value) for value in nominal])
            coefficients.header.stamp = message.header.stamp
            parameters.publish(coefficients)
            with collector.changed:
                driven.append(message)
                collector.changed.notify_all()

        parameters = collector.create_publisher(JointState, "/dynssm/parameters", SENSOR_QOS)
        collector.create_subscription(Odometry, "/vehicle/odometry", odometry, SENSOR_QOS)
        environment = os.environ.copy()
        mpc = subprocess.Popen([sys.executable, "-m", "examples.an_mpc_of_ones_own"], cwd=ROOT, env=environment)
        try:
            with node_process("simulator", {"driver": "external", "lockstep": True, "watchdog": 0.5}, environment):
                assert collector.wait_for(lambda: len(driven) > 0 and driven[-1].twist.twist.linear.x > 1.0, 120)
                begin = len(driven)
                assert collector.wait_for(lambda: len(driven) > begin + 75, 120)
        finally:
            mpc.terminate()
            mpc.wait(30)
    places = np.array([(m.pose.pose.position.x, m.pose.pose.position.y) for m in driven[begin:]])
    s, lateral = centre.project(places)
    assert np.abs(lateral).max() < 0.08
    assert np.unwrap(s, period=centre.length)[-1] - s[0] > 1.2


CONSUMER = ROOT / "examples" / "cpp_consumer"


def test_the_cpp_consumer_listens_to_the_topics_of_the_predictor() -> None:
    source = (CONSUMER / "consumer.cpp").read_text(encoding="utf-8")
    assert set(re.findall(r'"(dynssm/\w+)"', source)) == {PREDICTION_TOPIC[1:], PARAMETERS_TOPIC[1:]}
    (name, own) = re.findall(r'coefficient\("(\w+)", ([\d.]+)\)', source)[0]
    assert float(own) == load_vehicle("orca").coefficients[name].nominal


@pytest.mark.skipif(
    not any(
        (Path(prefix) / "share" / "rclcpp").is_dir() for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(":")
    ),
    reason="no ROS 2 with rclcpp is sourced",
)
def test_the_cpp_consumer_compiles(tmp_path: Path) -> None:
    subprocess.run(["cmake", "-S", str(CONSUMER), "-B", str(tmp_path)], check=True)
    subprocess.run(["cmake", "--build", str(tmp_path)], check=True)
