"""The live controller: ``ros2 run dynssm_ros controller --ros-args -p vehicle:=orca -p track:=club``.

Answers odometry with absolute throttle and steering; the predictor's coefficients and predictions go into the car that it
plans with. All driving is in :mod:`dynssm_ros.control`; this node converts, calls and publishes. It drives while it is
active: with ``autostart:=false`` the car stands until somebody activates the node.
"""

from __future__ import annotations

import math
import time
from dataclasses import replace
from typing import Any, get_args

from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from rclpy.clock import Clock, ClockType
from sensor_msgs.msg import JointState

from dynssm_ros.control.live import LiveController
from dynssm_ros.control.reference import load_reference
from dynssm_ros.control.settings import Objective, Settings
from dynssm_ros.errors import ConfigurationError
from dynssm_ros.nodes.commands import COMMAND_TYPES, commands_as
from dynssm_ros.nodes.executor import failures
from dynssm_ros.nodes.managed import ManagedNode
from dynssm_ros.nodes.rivals import WatchedOutput
from dynssm_ros.nodes.support import (
    NEWEST_QOS,
    choose,
    describe,
    diagnostics,
    listen,
    relative,
    repeat,
    run,
)
from dynssm_ros.runtime.health import Delivery, Health, Level
from dynssm_ros.signals.decoding import decoders, frames_of, header_stamp_ns
from dynssm_ros.signals.history import Refusal
from dynssm_ros.signals.messages import COMMAND_TOPIC, ODOMETRY_TOPIC, PARAMETERS_TOPIC, PREDICTION_TOPIC
from dynssm_ros.signals.signal_map import load_signal_map
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import Applied, State, load_vehicle
from dynssm_ros.vehicle.kinematics import Pose

_STEPS = (2, 100)  # of a horizon
_AGAIN_S = 0.005  # between answers to another node's commands, which may answer too


class ControllerNode(ManagedNode):
    """Drives one car in real time."""

    def __init__(self, **options: Any) -> None:
        super().__init__("controller", **options)
        self._rate: float = describe(
            self, "rate", 1.0, "Speed of the car's time over real time, as of the simulator.", (0.01, 100.0), read_only=True
        )  # fmt: skip
        self._watchdog: float = describe(
            self, "watchdog", 0.2, "Silence of the odometry at which the car is braked (s).", (0.01, 10.0), read_only=True
        )  # fmt: skip
        self._period: float = describe(
            self, "diagnostics_period", 1.0, "Time between /diagnostics (s).", (0.1, 60.0), read_only=True
        )
        self._describe_driver()
        self.start()

    def prepare(self) -> None:
        """Makes the controller, with its first step behind it, and listens."""
        self._driver = self._make_driver()
        self._health = Health((ODOMETRY_TOPIC, PREDICTION_TOPIC, PARAMETERS_TOPIC), self._watchdog)
        self._decoder = decoders(load_signal_map("default"))[ODOMETRY_TOPIC]
        self._delivery = Delivery(math.inf, self._max_late)
        self._newest: int | None = None  # stamp of the odometry
        self._refused = -math.inf, Refusal.MISSING  # of odometry, the last one and when it came (s)
        self._answered = -math.inf  # when a rival was answered (s)

        kind, self._as_message = commands_as(self._command_type, self._driver.vehicle)
        self._command = WatchedOutput(self, kind, COMMAND_TOPIC, self._on_rival)
        self._publish_command = self._command.publish
        self._publish_diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10).publish
        # when several messages wait, the executor serves subscriptions in this order
        listen(self, Odometry, relative(PREDICTION_TOPIC), self._on_prediction)
        listen(self, JointState, relative(PARAMETERS_TOPIC), self._on_parameters)
        listen(self, Odometry, relative(ODOMETRY_TOPIC), self._on_odometry, NEWEST_QOS)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(self._driver.period / 1e9 / self._rate, self._watch, clock=steady)
        repeat(self, self._period, self._diagnose)

    def _describe_driver(self) -> None:
        """Declares what :meth:`_make_driver` goes by."""
        self._vehicle: str = describe(self, "vehicle", "orca", "Vehicle: shipped name or file.", read_only=True)
        self._track: str = describe(self, "track", "club", "Track: built-in name or CSV file.", read_only=True)
        self._scale: float = describe(self, "scale", 1.0, "Size of the track.", (1e-4, 1e4), read_only=True)
        self._line: str = describe(self, "line", "racing", "What to follow: centre, racing or a file.", read_only=True)
        self._speed_scale: float = describe(
            self, "speed_scale", 0.9, "Share of the car's limits in the line's speed.", (0.1, 2.0), read_only=True
        )
        self._objective: Objective = choose(
            self, "objective", "tracking", get_args(Objective), "To follow the line's speed, or to go as far as can be."
        )
        self._steps: int = describe(
            self, "horizon", 0, "Steps of T_s planned ahead; 0: as the car needs.", read_only=True
        )
        self._offset_free: bool = describe(
            self, "offset_free", False, "Whether what is mispredicted is followed at a fixed rate.", read_only=True
        )
        self._evidence: bool = describe(
            self,
            "evidence",
            True,
            "Whether what the predictor says is planned with only where it was better than the calibrated car.",
            read_only=True,
        )
        self._delay: float = describe(
            self, "delay", 0.0, "From the stamp of the odometry until it arrives (s).", (0.0, 10.0), read_only=True
        )
        self._max_late: float = describe(
            self, "max_late", 0.1, "By how much more odometry may come late (s).", (0.0, 10.0), read_only=True
        )
        self._frames: tuple[str, str] = (
            describe(self, "frame_id", "", "Frame of the odometry's pose; empty: as it comes first.", read_only=True),
            describe(
                self, "child_frame_id", "", "Frame of the odometry's twist; empty: as it comes first.", read_only=True
            ),
        )
        self._command_type: str = choose(
            self,
            "command_type",
            "sensor_msgs/msg/JointState",
            COMMAND_TYPES,
            "Type of the commands that are published.",
        )
        self._max_age: float = describe(
            self, "max_age", 0.5, "Age to which the predictor's coefficients are held (s).", (0.01, 10.0), read_only=True
        )  # fmt: skip

    def _make_driver(self) -> LiveController:
        """What the parameters ask for; it has its first step behind it."""
        if self._steps and not _STEPS[0] <= self._steps <= _STEPS[1]:
            raise ConfigurationError(f"parameter horizon: {self._steps}; expected {_STEPS[0]} to {_STEPS[1]}, or 0")
        car = load_vehicle(self._vehicle)
        road = load_track(self._track).require_closed().scaled(self._scale)
        for words in road.notes:
            self.get_logger().warning(f"track {road.name}: {words}")
        reference = load_reference(self._line, car, road, self._speed_scale)
        settings = Settings.of(car, self._objective, self._steps or None, self._offset_free, self._evidence)
        settings = replace(settings, deadline=car.sampling_time / self._rate)
        driver = LiveController(
            car, reference, road, settings, max_age=self._max_age, max_gap=self._watchdog, delay=self._delay,
            max_late=self._max_late, frames=self._frames,
        )  # fmt: skip
        self.get_logger().info(
            f"{car.name} on {road.name} ({road.length:.4g} m), {self._objective} of the {reference.name} line "
            f"({reference.lap_time:.4g} s a lap at its own speed), {settings.N} steps of {car.sampling_time:g} s"
        )
        return driver

    def _now(self) -> float:
        """The car's time (s), of any origin."""
        return time.monotonic() * self._rate

    def _on_prediction(self, message: Odometry) -> None:
        self._health.arrived(PREDICTION_TOPIC, self._now())
        twist = message.twist.twist
        state = State(twist.linear.x, twist.linear.y, twist.angular.z)
        self._refuse(PREDICTION_TOPIC, self._driver.predicted(_stamp(message), state))

    def _on_parameters(self, message: JointState) -> None:
        self._health.arrived(PARAMETERS_TOPIC, self._now())
        theta = dict(zip(message.name, message.position, strict=False))
        self._refuse(PARAMETERS_TOPIC, self._driver.remote.adapted(_stamp(message), theta))

    def _refuse(self, topic: str, reason: str) -> None:
        if reason:
            self.get_logger().warning(f"{topic}: ignored: {reason}", throttle_duration_sec=1.0)

    def _on_odometry(self, message: Odometry) -> None:
        if not self.active:
            self._health.arrived(ODOMETRY_TOPIC, self._now())
            return
        stamp, values, now = _stamp(message), self._decoder.decode(message), self._now()
        pose, seen = Pose(*map(values.__getitem__, Pose._fields)), State(*map(values.__getitem__, State._fields))
        self._delivery.arrived(now, stamp)
        outcome: Applied | Refusal | None
        try:
            outcome = self._driver.step(stamp, pose, seen, frames=frames_of(message), late=self._delivery.behind)
        except Exception as error:  # whatever it is: the car must not go on with the command before
            failures(self).add(self, error)
            self._driver.brakes.apply("cannot plan")
            outcome = self._driver.brake()
        if isinstance(outcome, Refusal):
            self._health.refused(outcome)
            self._refused = now, outcome
            return
        self._health.arrived(ODOMETRY_TOPIC, self._now())  # now: a step that took long is no silence of the odometry
        self._newest = stamp
        if outcome is not None:
            self._send(stamp + self._driver.answered_after, outcome)
            if not self._driver.brakes.reason:
                self._driver.learn()

    def _send(self, acts: int, command: Applied) -> None:
        """Publishes a command that acts from an instant on (ns)."""
        self._publish_command(self._as_message(acts, command))

    def _watch(self) -> None:
        """Brakes while there is no good odometry, and looks for others who command."""
        self._command.look()
        if not self.active:
            return
        now = self._now()
        age = self._health.age(ODOMETRY_TOPIC, now)
        if age <= self._watchdog:
            return
        refused, why = self._refused
        if now - refused <= self._watchdog:
            words = why.value
        else:
            words = f"{ODOMETRY_TOPIC}: " + ("nothing received" if math.isinf(age) else f"silent for {age:.1f} s")
        self._driver.brakes.apply(words)
        self._brake()

    def _on_rival(self) -> None:
        """Brakes, also after each command of another node: the actuators obey the last one."""
        now = time.monotonic()
        if self.active and now - self._answered > _AGAIN_S:
            self._answered = now
            self._driver.brakes.apply(f"another node publishes on {self._command.topic}")
            self._brake()

    def _brake(self) -> None:
        if self._newest is None:
            self._send(int(self.get_clock().now().nanoseconds), self._driver.brake())
        else:
            silence = self._health.age(ODOMETRY_TOPIC, self._now())
            acts = self._newest + self._driver.answered_after + round(silence * 1e9)
            self._send(acts, self._driver.brake(acts))

    def _diagnose(self) -> None:
        now, driver, health = self._now(), self._driver, self._health
        level, words = driver.verdict() if self.active else (Level.OK, "inactive, drives nothing")
        if (rival := self._command.rival()) and self.active:
            level, words = Level.ERROR, f"{rival}: brakes"
        values = driver.values()
        for topic in health.topics:
            values[f"{topic} rate (Hz)"] = f"{health.rate(topic, now):.1f}"
            values[f"{topic} age (s)"] = f"{health.age(topic, now):.3f}"
        for refusal, count in health.refusals.items():
            values[f"odometry refused: {refusal.name.lower()}"] = str(count)
        self._publish_diagnostics(
            diagnostics(self, "control", self._driver.vehicle.name, level=level, words=words, values=values)
        )


def _stamp(message: Any) -> int:
    stamp = header_stamp_ns(message)
    assert stamp is not None, "messages with a header"
    return stamp


def main(args: list[str] | None = None) -> None:
    """Runs the node; a user error is one line and exit status 1."""
    run(ControllerNode, args)


if __name__ == "__main__":
    main()
