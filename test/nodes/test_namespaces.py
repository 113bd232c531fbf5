"""Several cars on one bus: each in its namespace, with no message from one to the other."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from sensor_msgs.msg import JointState

from benchmarks.endurance.live_run import LiveRun, collecting, isolated_environment, predictor_process
from dynssm_ros.nodes.support import SENSOR_QOS, set_pose

pytestmark = pytest.mark.live
PERIOD = 20_000_000  # ns
START = 1_700_000_000_000_000_000


class NamespacedCar:
    """Publishes in a namespace and keeps the predictions from there, by their stamps."""

    def __init__(self, node, namespace: str, start: int) -> None:
        self.predicted: dict[int, float] = {}
        self.stamp = start
        self.x = 0.0
        self._odometry = node.create_publisher(Odometry, f"/{namespace}/vehicle/odometry", SENSOR_QOS)
        self._actuators = [
            node.create_publisher(JointState, f"/{namespace}/vehicle/actuator_{kind}", SENSOR_QOS)
            for kind in ("feedback", "command")
        ]
        node.create_subscription(Odometry, f"/{namespace}/dynssm/prediction", self._received, SENSOR_QOS)

    def _received(self, message: Odometry) -> None:
        stamp = message.header.stamp
        self.predicted[stamp.sec * 10**9 + stamp.nanosec] = message.twist.twist.linear.x

    def step(self, v_x: float) -> int:
        """One period of driving; returns the stamp that its prediction has."""
        actuators = JointState(name=["throttle", "steering"], position=[0.2, 0.0])
        odometry = Odometry()
        odometry.twist.twist.linear.x = v_x
        self.x += v_x * PERIOD / 1e9
        set_pose(odometry.pose.pose, self.x, 0.0, 0.0)
        for message in (actuators, odometry):
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(self.stamp, 10**9)
        for publisher in self._actuators:
            publisher.publish(actuators)
        self._odometry.publish(odometry)
        self.stamp += PERIOD
        return self.stamp


@pytest.mark.slow
def test_two_cars_in_two_namespaces_do_not_hear_each_other(small_model: Path) -> None:
    """The second car drives half an hour later than the first, and both at the same time."""
    with ExitStack() as stack:
        os.environ.update(isolated_environment())
        for namespace in ("car1", "car2"):
            stack.enter_context(
                predictor_process(small_model, {"diagnostics_period": 0.1}, os.environ.copy(), namespace)
            )
        collector = stack.enter_context(collecting(LiveRun(PERIOD)))
        said: dict[str, str] = {}
        collector.create_subscription(
            DiagnosticArray, "/diagnostics", lambda array: said.update((s.name, s.message) for s in array.status), 10
        )
        first = NamespacedCar(collector, "car1", START)
        second = NamespacedCar(collector, "car2", START + 1800 * 10**9)
        waiting = threading.Event()  # nobody sets it: discovery raises no event in rclpy

        def drive(car: NamespacedCar, v_x: float, until: Callable[[int], bool]) -> None:
            for _ in range(600):
                expected = car.step(v_x)
                if collector.wait_for(lambda expected=expected: until(expected), 0.05):
                    return
                waiting.wait(0.001)
            pytest.fail(f"in vain; predicted {len(car.predicted)}, diagnostics: {said}")

        drive(first, 1.0, first.predicted.__contains__)
        assert not second.predicted, "nobody drives there"
        drive(second, 1.5, second.predicted.__contains__)
        for _ in range(20):
            for car, v_x in ((first, 1.0), (second, 1.5)):
                expected = car.step(v_x)
                assert collector.wait_for(lambda car=car, expected=expected: expected in car.predicted, 5.0)
        assert max(first.predicted) < START + 900 * 10**9 < min(second.predicted)
        # a car that stands is rightly called silent, so each drives until it is said to predict
        drive(first, 1.0, lambda _: said.get("/car1/dynssm: prediction") == "predicting")
        drive(second, 1.5, lambda _: said.get("/car2/dynssm: prediction") == "predicting")
