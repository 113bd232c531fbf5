"""The controller over real DDS, in a process of its own: with the simulated car and the predictor, and alone."""

from __future__ import annotations

import math
import os
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from geometry_msgs.msg import Quaternion
from nav_msgs.msg import Odometry
from sensor_msgs.msg import JointState

from benchmarks.endurance.live_laps import drive_live
from benchmarks.endurance.live_run import LiveRun, collecting, isolated_environment, node_process
from dynssm_ros.nodes.support import SENSOR_QOS, set_pose, set_stamp
from dynssm_ros.signals.decoding import header_stamp_ns
from dynssm_ros.signals.messages import COMMAND_TOPIC, ODOMETRY_TOPIC, PARAMETERS_TOPIC, PREDICTION_TOPIC
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import COEFFICIENTS, load_vehicle

pytestmark = [pytest.mark.live, pytest.mark.timeout(300)]

PERIOD = 20_000_000  # ns
PATIENCE = 120.0  # s for a lap, and for processes to start
CLUB = load_track("club")
RATE = 0.5  # of real time: these laps are not about the machine's speed; `benchmarks.endurance.live_laps` is


class Stand:
    """At the side of the track: starts nodes, hears everything, and can send odometry itself."""

    def __init__(self, stack: ExitStack) -> None:
        self._stack = stack
        self.run = LiveRun(PERIOD)
        self.collector = stack.enter_context(collecting(self.run))
        self.odometry: list[Odometry] = []
        self.commands: list[JointState] = []
        subscribe, publish = self.collector.create_subscription, self.collector.create_publisher
        subscribe(Odometry, ODOMETRY_TOPIC, lambda message: self._keep(self.odometry, message), SENSOR_QOS)
        subscribe(JointState, COMMAND_TOPIC, lambda message: self._keep(self.commands, message), SENSOR_QOS)
        self._odometry = publish(Odometry, ODOMETRY_TOPIC, SENSOR_QOS)
        self._parameters = publish(JointState, PARAMETERS_TOPIC, SENSOR_QOS)
        self.spoil: Callable[[Odometry], object] | None = None
        """Spoils odometry before it is sent."""
        self.stamp = self._began = 1_700_000_000_000_000_000

    def start(self, node: str, **parameters: object) -> subprocess.Popen[str]:
        return self._stack.enter_context(node_process(node, parameters, os.environ.copy()))

    def control(self, **parameters: object) -> subprocess.Popen[str]:
        """Starts the controller, for odometry however late, and waits until it tells of itself."""
        process = self.start("controller", **{"diagnostics_period": 0.1, "max_late": 10.0} | parameters)
        deadline = time.monotonic() + PATIENCE
        while not self.wait_for(lambda: bool(self.told), 0.5):
            assert process.poll() is None, "the controller stopped"
            assert time.monotonic() < deadline, "nothing heard of the controller"
        return process

    @property
    def told(self) -> list[tuple[int, str, dict[str, str]]]:
        """The controller's diagnostics: level, words, values."""
        return [status for status in self.run.diagnostics if "laps" in status[2]]

    @property
    def newest(self) -> list[float]:
        """The newest command; NaN before the first."""
        return list(self.commands[-1].position) if self.commands else [math.nan, math.nan]

    def laps(self) -> int:
        return int(self.told[-1][2]["laps"])

    def wait_for(self, condition: Callable[[], bool], timeout: float = PATIENCE) -> bool:
        return self.collector.wait_for(condition, timeout)

    def diagnosed(self, words: str, timeout: float = PATIENCE) -> bool:
        """Waits for the controller to say ``words`` from now on."""
        seen = len(self.run.diagnostics)
        return self.wait_for(
            lambda: any("laps" in values and words in said for _, said, values in self.run.diagnostics[seen:]), timeout
        )

    def send_odometry(self, x: float = 0.0, v_x: float = 1.0) -> None:
        """The next odometry message of a car on the centre line of the club track, or ``x`` (m) beside it."""
        message = Odometry()
        set_stamp(message.header, self.stamp)
        at = (self.stamp - self._began) / 1e9
        place, heading = CLUB.centre.position(at), float(CLUB.centre.heading(at))
        set_pose(message.pose.pose, float(place[0]) + x, float(place[1]), heading)
        message.twist.twist.linear.x = v_x
        if self.spoil is not None:
            self.spoil(message)
        self._odometry.publish(message)
        self.stamp += PERIOD

    def send_parameters(self, **values: float) -> None:
        """Coefficients for the odometry message that was sent last."""
        theta = dict(zip(COEFFICIENTS, load_vehicle("orca").nominal.tolist(), strict=True)) | values
        message = JointState(name=list(theta), position=[float(value) for value in theta.values()])
        set_stamp(message.header, self.stamp)
        self._parameters.publish(message)

    def keep_sending(self, until: Callable[[], bool], **parameters: float) -> bool:
        """Sends odometry, and coefficients if given, until something comes true; returns whether it did."""
        pause, deadline = threading.Event(), time.monotonic() + PATIENCE
        while not until() and time.monotonic() < deadline:
            self.send_odometry()
            if parameters:
                self.send_parameters(**parameters)
            pause.wait(PERIOD / 1e9)  # nobody sets it: the rate of a car
        return until()

    def _keep(self, place: list, message: Odometry | JointState) -> None:
        with self.collector.changed:
            place.append(message)
            self.collector.changed.notify_all()


@pytest.fixture
def stand() -> Iterator[Stand]:
    with ExitStack() as stack:
        os.environ.update(isolated_environment())
        yield Stand(stack)


def assert_on_the_road(odometry: list[Odometry]) -> None:
    places = np.array([(m.pose.pose.position.x, m.pose.pose.position.y) for m in odometry])
    assert np.min(CLUB.clearance(places)) > 0


def assert_possible(commands: list[JointState]) -> None:
    limits = load_vehicle("orca").inputs
    for message in commands:
        assert list(message.name) == ["throttle", "steering"]
        throttle, steering = message.position
        assert limits.throttle[0] <= throttle <= limits.throttle[1]
        assert limits.steering[0] <= steering <= limits.steering[1]


def test_three_processes_drive_laps_and_the_predictor_may_die(stand: Stand, small_model: Path) -> None:
    predictor = stand.start("predictor", model=small_model, diagnostics_period=0.1)
    stand.control(line="centre", speed_scale=0.7, rate=RATE, watchdog=1.0)
    stand.start("simulator", driver="external", rate=RATE, lockstep=True)
    assert stand.diagnosed("drives, adapted coefficients"), stand.told[-1]
    assert stand.wait_for(lambda: stand.laps() >= 1), stand.told[-1]
    _, words, values = stand.told[-1]
    assert words.startswith("drives, adapted coefficients")
    in_use = np.array([float(values[name]) for name in COEFFICIENTS])
    sent = np.array(list(stand.run.parameters.values()))
    assert np.min(np.max(np.abs(sent / in_use - 1), axis=1)) < 1e-5, "the plan is made with what the predictor sent"
    assert float(values["age of the coefficients (s)"]) <= 0.1

    predictor.kill()
    begun = len(stand.odometry)
    assert stand.diagnosed("drives, nominal car, nothing from the predictor for 0.5 s")
    assert stand.wait_for(lambda: len(stand.odometry) > begun + 100), "two seconds of driving"
    assert stand.diagnosed("drives, nominal car")
    values = stand.told[-1][2]
    assert float(values["D_f"]) == pytest.approx(load_vehicle("orca").coefficients["D_f"].nominal, rel=1e-5)
    assert 5.0 < float(values["last lap (s)"]) < 9.0
    assert float(values["most outside the borders (m)"]) == 0.0
    assert_on_the_road(stand.odometry)
    assert_possible(stand.commands)


@pytest.mark.slow
def test_a_lap_with_noise_delay_and_a_patch_of_little_grip_stays_on_the_road(small_model: Path) -> None:
    driven = drive_live("orca", 2, small_model, rate=RATE, lockstep=True)
    assert driven.least_room > 0
    assert driven.lap_times[1] < 6.0
    assert driven.controller.startswith("drives, adapted coefficients")


@pytest.mark.slow
def test_the_car_stops_without_its_controller_and_the_controller_brakes_without_its_car(stand: Stand) -> None:
    """Each of the two is killed in turn; the controller comes back in between.

    A car without commands holds its steering. So the straight after the start is long: a machine that is busy kills late.
    """
    simulator = stand.start("simulator", driver="external", rate=RATE, scale=4.0)
    how = {"line": "centre", "scale": 4.0, "speed_scale": 0.5, "rate": RATE, "watchdog": 1.0}
    controller = stand.control(**how)

    def speed() -> float:
        return float(stand.odometry[-1].twist.twist.linear.x)

    assert stand.wait_for(lambda: bool(stand.odometry) and speed() > 0.5)
    controller.kill()
    assert stand.wait_for(lambda: speed() < 0.05), "without commands the car brakes until it stands"
    stand.control(**how)
    assert stand.wait_for(lambda: speed() > 0.5), f"a controller that was started again drives on: {stand.told[-1]}"
    simulator.kill()
    assert stand.diagnosed("/vehicle/odometry: silent for")
    assert stand.wait_for(lambda: stand.newest[0] == load_vehicle("orca").inputs.throttle[0])
    assert_possible(stand.commands)


def test_it_brakes_without_odometry_drives_with_it_and_brakes_when_it_falls_silent(stand: Stand) -> None:
    lowest = load_vehicle("orca").inputs.throttle[0]
    stand.control()
    assert stand.diagnosed("/vehicle/odometry: nothing received: brakes")
    assert stand.told[-1][0] == 2
    assert stand.wait_for(lambda: bool(stand.commands))
    assert stand.newest == [lowest, 0.0]

    assert stand.keep_sending(lambda: stand.newest[0] > 0.0)
    answered = {header_stamp_ns(message) for message in stand.commands}
    assert stand.stamp in answered or stand.wait_for(
        lambda: stand.stamp in {header_stamp_ns(m) for m in stand.commands}
    ), "a command is stamped with the instant at which it acts"
    assert stand.diagnosed("/vehicle/odometry: silent for")
    assert stand.newest[0] == lowest
    assert stand.keep_sending(lambda: stand.newest[0] > 0.0), "and it comes back"
    assert_possible(stand.commands)


def test_bad_messages_change_nothing_but_the_diagnostics(stand: Stand) -> None:
    stand.control(watchdog=5.0, evidence=False)
    assert stand.keep_sending(lambda: "drives" in stand.told[-1][1])
    for count, spoilt in enumerate(({"v_x": math.nan}, {"x": math.inf}), 1):
        stand.send_odometry(**spoilt)
        assert stand.wait_for(lambda: stand.told[-1][2].get("odometry refused: not_finite") == str(count))  # noqa: B023
    assert stand.keep_sending(lambda: "adapted coefficients" in stand.told[-1][1], D_f=0.2)
    assert float(stand.told[-1][2]["D_f"]) == 0.2
    assert stand.keep_sending(lambda: "nominal car" in stand.told[-1][1], D_f=5000.0), "another car's are refused"
    assert float(stand.told[-1][2]["D_f"]) == 0.192
    assert_possible(stand.commands)


def test_odometry_that_stays_wrong_is_braked_for(stand: Stand) -> None:
    stand.control()
    assert stand.keep_sending(lambda: "drives" in stand.told[-1][1])
    stand.spoil = lambda message: setattr(message.pose.pose, "orientation", Quaternion(w=0.0))
    words = "the orientation is no quaternion of length 1: brakes"
    assert stand.keep_sending(lambda: stand.told[-1][1] == words), stand.told[-1]
    assert stand.told[-1][0] == 2
    assert stand.newest[0] == load_vehicle("orca").inputs.throttle[0]
    stand.spoil = None
    assert stand.keep_sending(lambda: "drives" in stand.told[-1][1])


def test_odometry_that_freezes_is_braked_for(stand: Stand) -> None:
    stand.control()
    assert stand.keep_sending(lambda: "drives" in stand.told[-1][1])
    last = Odometry()

    def freeze(message: Odometry) -> None:
        if not last.twist.twist.linear.x:
            last.pose, last.twist = message.pose, message.twist
        message.pose, message.twist = last.pose, last.twist

    stand.spoil = freeze
    assert stand.keep_sending(lambda: stand.told[-1][1] == "the odometry stands still: brakes"), stand.told[-1]
    assert stand.newest[0] == load_vehicle("orca").inputs.throttle[0]
    assert stand.told[-1][2]["braked"] == "2", "and before the first odometry"


def test_a_second_commander_is_braked_for(stand: Stand) -> None:
    stand.control()
    assert stand.keep_sending(lambda: "drives" in stand.told[-1][1])
    joystick = stand.collector.create_publisher(JointState, COMMAND_TOPIC, SENSOR_QOS)
    full = JointState(name=["throttle", "steering"], position=[1.0, 0.0])
    words = f"another node publishes on {COMMAND_TOPIC}: /collector: brakes"

    def is_braked() -> bool:
        joystick.publish(full)
        return stand.told[-1][1] == words

    assert stand.keep_sending(is_braked), stand.told[-1]
    lowest, begun = load_vehicle("orca").inputs.throttle[0], len(stand.commands)
    joystick.publish(full)

    def has_the_last_word() -> bool:
        heard = [command.position[0] for command in stand.commands[begun:]]
        return 1.0 in heard and lowest in heard[heard.index(1.0) :]

    assert stand.wait_for(has_the_last_word), "without odometry too"
    stand.collector.destroy_publisher(joystick)
    assert stand.keep_sending(lambda: "drives" in stand.told[-1][1]), "once it is alone"


def test_predictions_that_no_car_can_follow_are_refused(stand: Stand) -> None:
    stand.control(evidence=False)
    predictions = stand.collector.create_publisher(Odometry, PREDICTION_TOPIC, SENSOR_QOS)
    message = Odometry()

    def predicted(v_x: float, *, until: Callable[[dict[str, str]], bool]) -> bool:
        message.twist.twist.linear.x = v_x

        def done() -> bool:
            set_stamp(message.header, stand.stamp)
            predictions.publish(message)
            return until(stand.told[-1][2])

        return stand.keep_sending(done)

    assert predicted(1.2, until=lambda values: float(values["added to v_x"]) > 0.1)
    assert predicted(1e30, until=lambda values: float(values["age of the coefficients (s)"]) > 0.3)
    assert abs(float(stand.told[-1][2]["added to v_x"])) < 1.0


def test_the_process_holds_no_torch_and_is_warm_before_it_listens(stand: Stand) -> None:
    process = stand.control()
    mapped = Path(f"/proc/{process.pid}/maps").read_text()
    assert "casadi" in mapped
    assert "daqp" in mapped, "the solver is loaded by a plan"
    assert "torch" not in mapped


@pytest.mark.parametrize(
    ("parameter", "expected"),
    [
        ("track:=nowhere", "'nowhere' is neither a file nor a built-in name"),
        ("vehicle:=tank", "'tank' is neither a file nor a shipped name"),
        ("line:=left", "line 'left' is neither centre, racing nor a file"),
        ("objective:=fast", "parameter objective: 'fast'; expected tracking or progress"),
        ("horizon:=1", "parameter horizon: 1; expected 2 to 100"),
        ("vehicle:=av21", "track club is 0.4 m wide"),
    ],
)
def test_a_wrong_start_is_one_clear_line(refused_start: Callable[..., str], parameter: str, expected: str) -> None:
    assert expected in refused_start("controller", parameter)
