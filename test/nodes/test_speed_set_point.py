"""A car with a speed set-point, live: simulated car, predictor and controller over real DDS."""

from __future__ import annotations

import os
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from nav_msgs.msg import Odometry
from sensor_msgs.msg import JointState

from benchmarks.endurance.live_run import LiveRun, collecting, isolated_environment, node_process
from dynssm_ros import api
from dynssm_ros.nodes.support import SENSOR_QOS
from dynssm_ros.signals.decoding import header_stamp_ns
from dynssm_ros.signals.messages import COMMAND_TOPIC, ODOMETRY_TOPIC
from dynssm_ros.vehicle import load_vehicle

pytestmark = [pytest.mark.live, pytest.mark.timeout(300)]

PERIOD = 20_000_000  # ns
ROAD = {"track": "club", "scale": 10.0, "rate": 0.5}
PATIENCE = 150.0  # s
CAR = load_vehicle("f1tenth")


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The online layer on the car as it is."""
    folder = tmp_path_factory.mktemp("model")
    run = api.simulate(
        CAR, "club", duration=20.0, scale=10.0, aggressiveness=0.7, plant="rk4", noise=(0.01, 0.01, 0.03)
    )
    laps = api.recorded(run)
    known = CAR.calibrated_on(laps.fingerprints, CAR).model_copy(update={"integrator": "rk4"})
    api.train(laps, "rls", known, folder / "rls")
    return folder / "rls"


@pytest.mark.slow
def test_a_lap_is_predicted_and_driven_by_set_points(model: Path) -> None:
    run, speed, commands = LiveRun(PERIOD), {}, []
    with ExitStack() as stack:
        os.environ.update(isolated_environment())
        collector = stack.enter_context(collecting(run))

        def on_odometry(message: Odometry) -> None:
            speed[header_stamp_ns(message)] = message.twist.twist.linear.x

        collector.create_subscription(Odometry, ODOMETRY_TOPIC, on_odometry, SENSOR_QOS)
        collector.create_subscription(JointState, COMMAND_TOPIC, commands.append, SENSOR_QOS)
        predictor = {"model": model, "signals": "default_speed", "diagnostics_period": 0.1}
        controller = {"vehicle": "f1tenth", "speed_scale": 0.8, "max_late": 10.0, "diagnostics_period": 0.1, **ROAD}
        simulator = {
            "vehicle": "f1tenth",
            "driver": "external",
            "plant": "rk4",
            "watchdog": 2.0,
            "lockstep": True,
            **ROAD,
        }
        simulator |= {"noise": [0.01, 0.01, 0.03]}
        for node, parameters in (("predictor", predictor), ("controller", controller), ("simulator", simulator)):
            stack.enter_context(node_process(node, parameters, os.environ.copy()))

        def laps() -> int:
            return max((int(values["laps"]) for _, _, values in [*run.diagnostics] if "laps" in values), default=0)

        assert collector.wait_for(lambda: laps() >= 1, PATIENCE), run.diagnostics[-3:]
        told = [values for _, _, values in run.diagnostics if "driven (laps)" in values]
    driven = [values for _, _, values in run.diagnostics if "laps" in values][-1]
    assert float(told[-1]["least room to the borders so far (m)"]) > 0, driven
    assert {tuple(message.name) for message in commands} == {("speed", "steering")}
    asked = np.array([message.position[0] for message in commands])
    assert CAR.inputs.throttle[0] <= asked.min() < 1.0 < 5.0 < asked.max() <= CAR.inputs.throttle[1]
    both = sorted(stamp for stamp in run.predicted.keys() & speed.keys() if stamp - PERIOD in speed)
    assert len(both) > 200
    errors = np.array([run.predicted[stamp][0] - speed[stamp] for stamp in both])
    changes = np.array([speed[stamp] - speed[stamp - PERIOD] for stamp in both])
    assert np.sqrt(np.mean(errors**2)) < 0.5 * np.sqrt(np.mean(changes**2))


@pytest.mark.slow
def test_a_map_with_a_throttle_is_refused_in_one_line(model: Path, refused_start: object) -> None:
    said = refused_start("predictor", f"model:={model}", "signals:=default")  # type: ignore[operator]
    assert "signal map default: has throttle_feedback, but vehicle f1tenth has inputs.set_point: speed" in said
