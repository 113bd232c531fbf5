"""A car on the bus: publishes single messages to a predictor in its own process and waits for what comes back."""

from __future__ import annotations

import gc
import importlib
import os
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
import rclpy
from nav_msgs.msg import Odometry
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState

from benchmarks.endurance.live_run import Collector, LiveRun, collecting, isolated_environment, predictor_process
from dynssm_ros.nodes.support import SENSOR_QOS, set_pose
from dynssm_ros.signals.messages import COMMAND_TOPIC, FEEDBACK_TOPIC, ODOMETRY_TOPIC, PREDICTION_TOPIC
from dynssm_ros.vehicle import State
from dynssm_ros.vehicle.kinematics import SCALAR, Pose, advance_pose

PERIOD = 20_000_000  # ns
LONG_AGO = 1000 * 10**9  # ns: farther than any test moves stamps


def call(collector: Collector, service: Any, name: str, **request: Any) -> Any:
    """What a service answers that may be asked twice: an answer is lost where its server has not yet met the client."""
    client = collector.create_client(service, name)
    assert client.wait_for_service(20.0)
    for _ in range(2):
        done = threading.Event()
        future = client.call_async(service.Request(**request))
        future.add_done_callback(lambda _, done=done: done.set())
        if done.wait(25.0):  # a model that is tried on a busy machine
            return future.result()
    raise AssertionError(f"{name}: no answer to either of two requests")


class Car:
    """Drives straight at 1 m/s on simulated stamps; what it sends can be spoilt message by message.

    It goes where its velocities say, as far as a car can.
    """

    def __init__(self, collector: Collector, run: LiveRun, process: subprocess.Popen[str]) -> None:
        self.collector, self.run, self.process = collector, run, process
        self.stamp = self._moved = 1_700_000_000_000_000_000
        self.pose = Pose(0.0, 0.0, 0.0)
        self.spoil: Callable[[Odometry], object] | None = None
        """Spoils odometry before it is sent."""
        self._odometry = collector.create_publisher(Odometry, ODOMETRY_TOPIC, SENSOR_QOS)
        self._feedback = collector.create_publisher(JointState, FEEDBACK_TOPIC, SENSOR_QOS)
        self._command = collector.create_publisher(JointState, COMMAND_TOPIC, SENSOR_QOS)

    def wait_for_match(self) -> None:
        publishers = (self._odometry, self._feedback, self._command)
        deadline = time.monotonic() + 30
        matched = threading.Event()
        while not all(p.get_subscription_count() for p in publishers) or not self.collector.count_publishers(
            PREDICTION_TOPIC
        ):
            assert self.process.poll() is None, "the predictor stopped"
            assert time.monotonic() < deadline, "no match within 30 s"
            matched.wait(0.02)  # nobody sets it: discovery raises no event in rclpy
        while not self._all_heard():  # the node's side of a match comes later than ours
            assert time.monotonic() < deadline, "the node hears nothing after 30 s"
            self.step()
        self.stamp += 10_000_000_000  # a gap: the window starts anew

    def _all_heard(self) -> bool:
        """Whether the next diagnostics know of a message of every topic."""
        assert self.diagnosed(""), "no diagnostics"
        return "nothing received" not in self.run.diagnostics[-1][1]

    def odometry(self, v_x: float = 1.0, v_y: float = 0.0, omega: float = 0.0) -> int:
        """Sends odometry at the present stamp; returns the stamp that a prediction for it has."""
        message = Odometry()
        self._stamp(message)
        message.header.frame_id, message.child_frame_id = "map", "base_link"
        twist = message.twist.twist
        twist.linear.x, twist.linear.y, twist.angular.z = v_x, v_y, omega
        self._move(v_x, v_y, omega)
        set_pose(message.pose.pose, *self.pose)
        if self.spoil is not None:
            self.spoil(message)
        self._odometry.publish(message)
        return self.stamp + PERIOD

    def _move(self, v_x: float, v_y: float, omega: float) -> None:
        elapsed, possible = (self.stamp - self._moved) / 1e9, abs(v_x) < 10 and abs(v_y) < 10 and abs(omega) < 30
        if 0 < elapsed < 1 and possible:
            state = State(v_x, v_y, omega)
            self.pose = advance_pose(SCALAR, self.pose, state, state, elapsed)
        self._moved = self.stamp

    def actuators(self, commands: bool = True, throttle: float = 0.2, steering: float = 0.0) -> None:
        for publisher in (self._feedback, self._command) if commands else (self._feedback,):
            message = JointState(name=["throttle", "steering"], position=[throttle, steering])
            self._stamp(message)
            publisher.publish(message)

    def step(self, v_x: float = 1.0, commands: bool = True, actuators: bool = True) -> int:
        """One period of driving: actuators, then odometry, then the clock goes on."""
        if actuators:
            self.actuators(commands)
        expected = self.odometry(v_x)
        self.stamp += PERIOD
        return expected

    def answered(self, expected: int, timeout: float = 5.0) -> bool:
        """Waits for the prediction with that stamp."""
        return self.collector.wait_for(lambda: expected in self.run.predicted, timeout)

    def drive_until_answered(self, limit: int = 50, **how: bool) -> int:
        """Drives, waiting a little for each answer, until there is one; returns the number of periods it took."""
        for count in range(1, limit + 1):
            if self.answered(self.step(**how), timeout=0.3):
                return count
        raise AssertionError(f"no prediction within {limit} periods; diagnostics: {self.run.diagnostics[-1:]}")

    def diagnosed(self, words: str, timeout: float = 5.0) -> bool:
        """Waits for a diagnostic status from now on whose message contains ``words``."""
        seen = len(self.run.diagnostics)
        return self.collector.wait_for(lambda: any(words in m for _, m, _ in self.run.diagnostics[seen:]), timeout)

    def steps_until_diagnosed(self, words: str, limit: int = 600) -> list[int]:
        """Drives until a status contains ``words``, which may be true only of a car that drives; stamps as of ``step``."""
        expected: list[int] = []
        while not self.diagnosed(words, timeout=0.05):
            assert len(expected) < limit, f"never said '{words}'; diagnostics: {self.run.diagnostics[-1:]}"
            expected.append(self.step())
        return expected

    def set_parameter(self, name: str, value: object) -> tuple[bool, str]:
        result = self._call(SetParameters, "set_parameters", [(name, value)]).results[0]
        return result.successful, result.reason

    def set_atomically(self, values: list[tuple[str, object]]) -> tuple[bool, str]:
        """Sets several parameters at once: all of them or none."""
        result = self._call(SetParametersAtomically, "set_parameters_atomically", values).result
        return result.successful, result.reason

    def _call(self, service: Any, name: str, values: list[tuple[str, object]]) -> Any:
        parameters = [Parameter(key, value=value).to_parameter_msg() for key, value in values]
        return call(self.collector, service, f"/dynssm/{name}", parameters=parameters)

    def _stamp(self, message: Odometry | JointState) -> None:
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(self.stamp, 1_000_000_000)


StartCar = Callable[..., Car]


def _started(stack: ExitStack, model: Path, wait: bool = True, **parameters: object) -> Car:
    os.environ.update(isolated_environment())
    process = stack.enter_context(
        predictor_process(model, {"diagnostics_period": 0.1, **parameters}, os.environ.copy())
    )
    run = LiveRun(PERIOD)
    car = Car(stack.enter_context(collecting(run)), run, process)
    if wait:
        car.wait_for_match()
    return car


@pytest.fixture
def start_car(small_model: Path) -> Iterator[StartCar]:
    """Starts predictors with the small model (or another) and hands out cars that talk to them."""
    with ExitStack() as stack:

        def start(model: Path = small_model, wait: bool = True, **parameters: object) -> Car:
            return _started(stack, model, wait, **parameters)

        yield start


@pytest.fixture(scope="module")
def parked_car(small_model: Path) -> Iterator[Callable[[], Car]]:
    """The one car of a module, which talks to one predictor; a new one where the last test has stopped it."""
    with ExitStack() as stack:
        cars: list[Car] = []

        def fetch() -> Car:
            if not cars or cars[-1].process.poll() is not None:
                cars.append(_started(stack, small_model))
            return cars[-1]

        yield fetch


@pytest.fixture
def car(parked_car: Callable[[], Car]) -> Car:
    """A car that other tests of the module have driven, long ago: for tests that leave the node's parameters alone."""
    car = parked_car()
    car.stamp += LONG_AGO
    return car


@pytest.fixture(scope="session")
def call_service() -> Callable[..., Any]:
    """Calls a service with the fields of a request by name; returns what it answers."""
    return call


@pytest.fixture(scope="module")
def ros() -> Iterator[None]:
    """rclpy in this process, apart from other buses."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in isolated_environment().items():
            patch.setenv(name, value)
        rclpy.init()
        yield
        rclpy.shutdown()


RefusedStart = Callable[..., str]


@pytest.fixture
def refused_start(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> RefusedStart:
    """Starts a node in this process with parameters that it refuses; returns the one line that it ends with."""
    for name, value in isolated_environment().items():
        monkeypatch.setenv(name, value)

    def start(node: str, *parameters: str) -> str:
        gc.collect()  # the node of a start before; rclpy warns of a second one of its name
        capfd.readouterr()
        with pytest.raises(SystemExit) as stopped:
            importlib.import_module(f"dynssm_ros.nodes.{node}").main(
                ["--ros-args", *(part for text in parameters for part in ("-p", text))] if parameters else []
            )
        assert stopped.value.code == 1
        lines = capfd.readouterr().err.strip().splitlines()
        assert len(lines) == 1
        assert lines[0].startswith("error: ")
        return lines[0]

    return start
