"""The simulated car on the bus, as its own process: alone, with the predictor, and driven by somebody else."""

from __future__ import annotations

import itertools
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from nav_msgs.msg import Odometry
from sensor_msgs.msg import JointState

from benchmarks.endurance.live_run import LiveRun, collecting, isolated_environment, predictor_process
from dynssm_ros.nodes.support import SENSOR_QOS, actuators
from dynssm_ros.signals.decoding import header_stamp_ns
from dynssm_ros.signals.messages import COMMAND_TOPIC, FEEDBACK_TOPIC, ODOMETRY_TOPIC
from dynssm_ros.simulation.laps import drive
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import Applied, load_vehicle

pytestmark = [pytest.mark.live, pytest.mark.timeout(120)]

PERIOD = 20_000_000  # ns


def _simulator(*parameters: str) -> list[str]:
    arguments = [part for text in parameters for part in ("-p", text)]
    return [sys.executable, "-m", "dynssm_ros.nodes.simulator", *(["--ros-args", *arguments] if arguments else [])]


class Pit:
    """Hears the simulated car and, if asked to, drives it."""

    def __init__(self, stack: ExitStack, *parameters: str) -> None:
        self.run = LiveRun(PERIOD)
        self.collector = stack.enter_context(collecting(self.run))
        self.odometry: list[Odometry] = []
        self.arrived: list[float] = []
        self.speed: dict[int, float] = {}
        self.feedback: dict[int, tuple[float, ...]] = {}
        self.command: dict[int, tuple[float, ...]] = {}
        self.answer: Applied | None = None
        subscribe = self.collector.create_subscription
        subscribe(JointState, FEEDBACK_TOPIC, lambda m: self._keep(self.feedback, m), SENSOR_QOS)
        subscribe(JointState, COMMAND_TOPIC, lambda m: self._keep(self.command, m), SENSOR_QOS)
        subscribe(Odometry, ODOMETRY_TOPIC, self._on_odometry, SENSOR_QOS)
        self.send = self.collector.create_publisher(JointState, COMMAND_TOPIC, SENSOR_QOS).publish
        self.process = subprocess.Popen(
            _simulator(*parameters), env=os.environ.copy(), stderr=subprocess.PIPE, text=True
        )
        stack.callback(self._stop)

    @property
    def v_x(self) -> float:
        return self.odometry[-1].twist.twist.linear.x

    def reply(self, throttle: float, steering: float) -> None:
        """Answers every odometry message from now on with this command, for one T_s later."""
        self.answer = Applied(throttle, steering)

    def wait_for(self, condition: Callable[[], bool], timeout: float = 20.0) -> bool:
        return self.collector.wait_for(condition, timeout)

    def _keep(self, place: dict[int, tuple[float, ...]], message: JointState) -> None:
        place[header_stamp_ns(message) or 0] = tuple(message.position)

    def _on_odometry(self, message: Odometry) -> None:
        with self.collector.changed:
            self.odometry.append(message)
            self.arrived.append(time.monotonic())
            self.speed[header_stamp_ns(message) or 0] = message.twist.twist.linear.x
            self.collector.changed.notify_all()
        answer = self.answer
        if answer is not None:
            self.send(actuators((header_stamp_ns(message) or 0) + PERIOD, answer))

    def _stop(self) -> None:
        self.process.send_signal(signal.SIGINT)
        self.process.communicate(timeout=10)


StartPit = Callable[..., Pit]


@pytest.fixture
def start_pit() -> Iterator[StartPit]:
    with ExitStack() as stack:
        os.environ.update(isolated_environment())
        yield lambda *parameters: Pit(stack, *parameters)


@pytest.mark.slow
def test_it_drives_what_simulate_drives_in_real_time(start_pit: StartPit) -> None:
    pit = start_pit("seed:=3")
    assert pit.wait_for(lambda: bool(pit.odometry and pit.feedback and pit.command))  # topics match one by one
    pit.odometry.clear()
    pit.arrived.clear()
    assert pit.wait_for(lambda: len(pit.odometry) >= 300)
    # a busy machine hands messages over late: the earliest of each 100 say how time went on
    late = np.array(pit.arrived[:300]) - 0.02 * np.arange(300)
    assert np.min(late[200:]) == pytest.approx(np.min(late[:100]), abs=0.25)

    stamps = np.array([header_stamp_ns(m) for m in pit.odometry])
    assert set(np.diff(stamps)) == {PERIOD}
    twists = np.array([(t.linear.x, t.linear.y, t.angular.z) for t in (m.twist.twist for m in pit.odometry)])
    offline = list(itertools.islice(drive(load_vehicle("orca"), load_track("club"), seed=3), 1000))
    states = np.array([sample.state for sample in offline])
    first = int(np.argmin(np.max(np.abs(states - twists[0]), axis=1)))  # a few are lost before the match
    np.testing.assert_array_equal(twists, states[first : first + len(twists)])
    for k, stamp in enumerate(stamps[:100].tolist()):
        assert pit.feedback[stamp] == pytest.approx(offline[first + k].feedback, abs=0)
        assert pit.command[stamp] == pytest.approx(offline[first + k].command, abs=0)
    poses = [m.pose.pose.position for m in pit.odometry]
    assert (poses[50].x, poses[50].y) == offline[first + 50].pose[:2]


def test_effects_are_added_to_the_car_and_to_what_is_measured_of_it(start_pit: StartPit) -> None:
    pit = start_pit("seed:=3", "effects:=mass:factor=1.2 yaw_rate_bias:bias=0.1")
    assert pit.wait_for(lambda: len(pit.odometry) > 10)
    twists = np.array([(t.linear.x, t.linear.y, t.angular.z) for t in (m.twist.twist for m in list(pit.odometry))])
    car = load_vehicle("orca").with_effect("mass", {"factor": 1.2})
    offline = np.array([sample.state for sample in itertools.islice(drive(car, load_track("club"), seed=3), 1000)])
    first = int(np.argmin(np.abs(offline[:, 0] - twists[0, 0])))
    np.testing.assert_allclose(
        twists - offline[first : first + len(twists)], [[0.0, 0.0, 0.1]] * len(twists), atol=1e-12
    )


@pytest.mark.slow
def test_predictor_answers_each_odometry_message_of_the_simulated_car(start_pit: StartPit, small_model: Path) -> None:
    with ExitStack() as stack:
        stack.enter_context(predictor_process(small_model, {"diagnostics_period": 0.1}, os.environ.copy()))
        pit = start_pit("noise:=[0.01, 0.005, 0.05]", "plant:=double_track", "rate:=2.0")

        def answered() -> set[int]:
            return pit.run.predicted.keys() & pit.speed.keys()

        assert pit.wait_for(lambda: len(answered()) >= 100), pit.run.diagnostics[-2:]
        with pit.collector.changed:
            first, last = min(pit.run.predicted), max(pit.run.predicted)
            missing = set(range(first, last + 1, PERIOD)) - set(pit.run.predicted)
            errors = [pit.run.predicted[stamp][0] - pit.speed[stamp] for stamp in answered()]
            assert np.sqrt(np.mean(np.square(errors))) < 0.1
            told = len(pit.run.diagnostics)
        assert pit.wait_for(lambda: len(pit.run.diagnostics) > told + 1)
        assert len(missing) <= pit.run.passed_over, pit.run.diagnostics[-2:]


def test_odometry_comes_late_and_noisy_and_the_diagnostics_tell_the_truth(start_pit: StartPit) -> None:
    pit = start_pit("driver:=external", "delay:=0.06", "pose_noise:=[0.01, 0.02, 0.0]", "seed:=1")
    assert pit.wait_for(lambda: len(pit.odometry) >= 200)
    behind = [(max(pit.feedback) - (header_stamp_ns(pit.odometry[-1]) or 0)) / PERIOD]
    for count in range(201, 220):
        assert pit.wait_for(lambda count=count: len(pit.odometry) >= count)
        behind.append((max(pit.feedback) - (header_stamp_ns(pit.odometry[-1]) or 0)) / PERIOD)
    assert np.median(behind) == pytest.approx(3, abs=1)
    places = np.array([(m.pose.pose.position.x, m.pose.pose.position.y) for m in pit.odometry])  # it stands
    np.testing.assert_allclose(places.std(axis=0), [0.01, 0.02], rtol=0.3)
    assert pit.wait_for(lambda: any("driven (laps)" in values for _, _, values in pit.run.diagnostics))
    _, words, values = next(told for told in pit.run.diagnostics if "driven (laps)" in told[2])
    assert words == "on the road"
    assert (values["beside the centre line (m)"], values["least room to the borders so far (m)"]) == (
        "0.0000",
        "0.2000",
    )


def test_external_driver_is_obeyed_and_its_silence_stops_the_car(start_pit: StartPit) -> None:
    pit = start_pit("driver:=external")
    assert pit.wait_for(lambda: len(pit.odometry) > 20)
    assert {m.twist.twist.linear.x for m in pit.odometry} == {0.0}, "it waits"
    assert set(pit.feedback.values()) == {(0.0, 0.0), (-0.1, 0.0)} or set(pit.feedback.values()) == {(-0.1, 0.0)}

    pit.reply(0.5, 0.03)
    assert pit.wait_for(lambda: pit.v_x > 1.0)
    newest = pit.feedback[max(pit.feedback)]
    assert newest == (0.5, 0.03)
    pit.reply(float("nan"), 0.0)
    assert pit.wait_for(lambda: pit.v_x < 1e-6), "nothing that is worth obeying: it brakes"
    assert pit.feedback[max(pit.feedback)] == (-0.1, 0.03), "with the steering held"

    pit.reply(0.5, 0.0)
    assert pit.wait_for(lambda: pit.v_x > 0.5), "and it comes back"
    pit.answer = None
    assert pit.wait_for(lambda: pit.v_x < 1e-6)


def test_single_missing_commands_do_not_brake(start_pit: StartPit) -> None:
    pit = start_pit("driver:=external", "watchdog:=5.0")
    assert pit.wait_for(lambda: bool(pit.odometry))
    pit.reply(0.4, 0.0)
    assert pit.wait_for(lambda: pit.v_x > 0.3)
    pit.answer = None
    sent = len(pit.odometry)
    assert pit.wait_for(lambda: len(pit.odometry) >= sent + 20)
    assert pit.feedback[max(pit.feedback)] == (0.4, 0.0)


def test_a_car_that_was_held_up_drives_nothing_that_its_driver_could_not_answer(start_pit: StartPit) -> None:
    """The watchdog counts the car's time too: the command from before the pause is not old."""
    pit = start_pit("driver:=external", "watchdog:=0.5")
    assert pit.wait_for(lambda: bool(pit.odometry))
    pit.reply(0.4, 0.0)
    assert pit.wait_for(lambda: pit.v_x > 0.3)
    newest, seen = max(pit.feedback), time.monotonic()
    pit.process.send_signal(signal.SIGSTOP)
    pit.wait_for(lambda: False, 1.3)
    pit.process.send_signal(signal.SIGCONT)
    assert pit.wait_for(lambda: max(pit.feedback) >= newest + 115 * PERIOD), "its stamps leave the pause out"
    assert time.monotonic() - seen > 1.0 + 50 * PERIOD * 1e-9
    assert {pit.feedback[stamp] for stamp in list(pit.feedback) if stamp > newest} == {(0.4, 0.0)}
    held_up = "held up so far (s)"
    assert pit.wait_for(lambda: any(float(values.get(held_up, 0)) > 1.25 for _, _, values in pit.run.diagnostics))


@pytest.mark.slow
def test_in_lockstep_time_waits_for_the_command_that_is_due_and_goes_on_without_a_driver(start_pit: StartPit) -> None:
    pit = start_pit("driver:=external", "lockstep:=true", "rate:=5.0", "watchdog:=0.5")
    assert pit.wait_for(lambda: bool(pit.odometry)), "nobody drives yet: it does not wait"
    pit.reply(0.4, 0.0)
    assert pit.wait_for(lambda: pit.v_x > 0.3)
    pit.answer = None
    seen = len(pit.odometry)
    assert not pit.wait_for(lambda: len(pit.odometry) > seen + 1, 3.0), "it waits, also for one that is held up"
    due = max(pit.feedback) + PERIOD
    throttle = Applied(0.4, 0.0)
    pit.send(actuators(due - PERIOD, throttle))
    assert not pit.wait_for(lambda: max(pit.feedback) >= due, 0.3), "a late answer to an earlier step is none"
    pit.send(actuators(due, throttle))
    assert pit.wait_for(lambda: max(pit.feedback) >= due)
    pit.send(JointState(name=["throttle", "steering"], position=[0.4, 0.0]))
    assert pit.wait_for(lambda: max(pit.feedback) >= due + PERIOD), "without a stamp it is for what is due"
    assert pit.wait_for(lambda: pit.v_x < 1e-6), "a driver that is gone is not waited for; without commands it brakes"


def test_a_car_that_cannot_hold_the_road_ends_in_one_line() -> None:
    command = _simulator("scale:=0.3", "rate:=50.0")
    result = subprocess.run(
        command, capture_output=True, text=True, timeout=60, check=False, env=isolated_environment()
    )
    assert result.returncode == 1
    errors = [line for line in result.stderr.strip().splitlines() if "[INFO]" not in line]
    assert len(errors) == 1
    assert "orca leaves track club after" in errors[0]


@pytest.mark.parametrize(
    ("parameter", "expected"),
    [
        ("track:=nowhere", "'nowhere' is neither a file nor a built-in name"),
        ("vehicle:=tank", "'tank' is neither a file nor a shipped name"),
        ("plant:=rk5", "parameter plant: 'rk5'; expected euler or rk4 or double_track"),
        ("driver:=nobody", "parameter driver: 'nobody'; expected pure_pursuit or external"),
        ("line:=left", "parameter line: 'left'; expected centre or racing"),
        ("noise:=[0.1, -0.2, 0.0]", "noise 0.1, -0.2, 0: expected three finite numbers of at least 0"),
        ("pose_noise:=[0.1]", "pose_noise 0.1: expected three finite numbers of at least 0"),
        ("delay:=1.0", "delay 1 s: expected 0 to 0.4 s"),
        ("seed:=-1", "parameter seed: -1; expected at least 0"),
        ("effects:=drag:size=2", "effect drag has no parameter 'size'"),
    ],
)
def test_a_wrong_start_is_one_clear_line(refused_start: Callable[..., str], parameter: str, expected: str) -> None:
    assert expected in refused_start("simulator", parameter)


def test_the_process_holds_no_torch(start_pit: StartPit) -> None:
    pit = start_pit()
    assert pit.wait_for(lambda: bool(pit.odometry))
    assert "torch" not in Path(f"/proc/{pit.process.pid}/maps").read_text()
