"""A simulated car on the bus: ``ros2 run dynssm_ros simulator --ros-args -p vehicle:=orca -p track:=club``.

Publishes odometry and actuator feedback once per T_s, as the predictor's default topics. Its own driver laps the track
and publishes the commands, or, with ``driver:=external``, it obeys those that somebody else sends. With ``lockstep:=true``
the car's time waits for them. All driving is in :mod:`dynssm_ros.simulation`; this node converts, keeps the time and
publishes.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Iterator
from typing import Any, Literal, get_args

from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from sensor_msgs.msg import JointState

from dynssm_ros.errors import ConfigurationError
from dynssm_ros.nodes.executor import FinishedError
from dynssm_ros.nodes.support import (
    actuators,
    choose,
    describe,
    diagnostics,
    listen,
    output,
    relative,
    repeat,
    run,
    set_pose,
    set_stamp,
)
from dynssm_ros.runtime.health import Level
from dynssm_ros.signals.decoding import decoders, header_stamp_ns
from dynssm_ros.signals.messages import COMMAND_TOPIC, FEEDBACK_TOPIC, ODOMETRY_TOPIC
from dynssm_ros.signals.signal_map import STANDARD_MAPS, command_signals, load_signal_map
from dynssm_ros.simulation.external import CommandHolder, Pace, drive_by_commands
from dynssm_ros.simulation.laps import Sample, SimulationError, drive
from dynssm_ros.simulation.plant import PLANTS, PlantKind
from dynssm_ros.simulation.sensing import MOST_LATE, Sensing, Sensors
from dynssm_ros.track.driver import Style
from dynssm_ros.track.racing_line import LineKind, line_of
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import Applied, State, load_vehicle
from dynssm_ros.vehicle.effects import parse_effect
from dynssm_ros.vehicle.kinematics import Pose

DriverKind = Literal["pure_pursuit", "external"]
_DIAGNOSTICS = 1.0  # s between them
_UNANSWERED = 10.0  # s that a command is waited for in lockstep: a driver may be held up for seconds


class SimulatorNode(Node):
    """Drives one car in real time."""

    def __init__(self, **options: Any) -> None:
        super().__init__("simulator", **options)
        vehicle = describe(self, "vehicle", "orca", "Vehicle: shipped name or file.", read_only=True)
        effects = describe(
            self, "effects", "", "Physics beyond the vehicle file: NAME[:k=v,...], apart by blanks.", read_only=True
        )
        track = describe(self, "track", "club", "Track: built-in name or CSV file.", read_only=True)
        scale = describe(self, "scale", 1.0, "Size of the track.", (1e-4, 1e4), read_only=True)
        self._plant: PlantKind = choose(self, "plant", "euler", tuple(PLANTS), "How the car is modelled.")
        self._line: LineKind = choose(self, "line", "centre", get_args(LineKind), "What the own driver follows.")
        self._driver: DriverKind = choose(
            self, "driver", "pure_pursuit", get_args(DriverKind), f"The own one, or whoever sends {COMMAND_TOPIC}."
        )
        self._seed = describe(self, "seed", 0, "Of the driver's variation and the noise.", read_only=True)
        aggressiveness = describe(
            self, "aggressiveness", 0.95, "Share of the limits in use.", (0.1, 1.2), read_only=True
        )
        variation = describe(self, "variation", 0.5, "How much speed and line vary.", (0.0, 1.0), read_only=True)
        self._rate = describe(self, "rate", 1.0, "Speed factor over real time.", (0.01, 100.0), read_only=True)
        watchdog = describe(
            self, "watchdog", 0.2, "Age of an external command, in the car's time, at which it brakes (s).", (0.01, 10.0),
            read_only=True,
        )  # fmt: skip
        self._lockstep = describe(
            self, "lockstep", False, "Whether time waits for the external command.", read_only=True
        )
        if self._seed < 0:
            raise ConfigurationError(f"parameter seed: {self._seed}; expected at least 0")
        self._vehicle = load_vehicle(vehicle).with_effects(map(parse_effect, effects.split()))
        self._track = load_track(track).require_closed().scaled(scale)
        for words in self._track.notes:
            self.get_logger().warning(f"track {self._track.name}: {words}")
        self._style = Style(aggressiveness, variation)
        self._sensors = self._make_sensors()
        self._commands = CommandHolder(self._vehicle, watchdog, lambda: self._pace.count * self._vehicle.sampling_time)
        self._obeyed = self._on_road = True
        self._commanded: tuple[int, float] | None = None  # when the last command acts (ns), and when it came (s)

        self._publish_feedback = output(self, JointState, FEEDBACK_TOPIC).publish
        self._publish_odometry = output(self, Odometry, ODOMETRY_TOPIC).publish
        if self._driver == "pure_pursuit":
            self._publish_command = output(self, JointState, COMMAND_TOPIC).publish
        else:
            self._decoder = decoders(load_signal_map(STANDARD_MAPS[self._vehicle.inputs.set_point]))[COMMAND_TOPIC]
            listen(self, JointState, relative(COMMAND_TOPIC), self._on_command)
        self._publish_diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10).publish
        self._room = self._least = math.inf  # to the borders: now, and the least so far (m)
        self._samples = self._drive()
        stamp = int(self.get_clock().now().nanoseconds)
        T_s = self._vehicle.sampling_time
        self._pace = Pace(T_s, self._rate, time.monotonic(), stamp, waits=self._lockstep)
        self._stamps: deque[int] = deque(maxlen=1 + MOST_LATE)  # of the last samples (ns)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(self._pace.period, self._on_time, clock=steady)
        repeat(self, _DIAGNOSTICS, self._diagnose)
        self.get_logger().info(
            f"{self._vehicle.name} on {self._track.name} ({self._track.length:.4g} m), plant {self._plant}, "
            f"driver {self._driver}, {1 / self._pace.period:.4g} Hz"
        )

    def _make_sensors(self) -> Sensors:
        """What the parameters ask for."""
        noise = describe(
            self, "noise", [0.0, 0.0, 0.0], "Of v_x, v_y (m/s), omega (rad/s): deviations.", read_only=True
        )
        pose_noise = describe(
            self, "pose_noise", [0.0, 0.0, 0.0], "Likewise of x, y (m), heading (rad).", read_only=True
        )
        delay = describe(
            self, "delay", 0.0, "By which odometry is sent late, in the car's time (s).", (0.0, 10.0), read_only=True
        )
        sensing = Sensing(tuple(noise), tuple(pose_noise), delay, self._seed)
        return Sensors(sensing, self._vehicle.sampling_time)

    def _drive(self) -> Iterator[Sample]:
        if self._driver == "external":
            return drive_by_commands(self._vehicle, self._track, self._plant, self._commands.command)
        line = line_of(self._line, self._vehicle, self._track)
        return drive(self._vehicle, self._track, plant=self._plant, seed=self._seed, style=self._style, line=line)

    def _on_command(self, message: JointState) -> None:
        values = self._decoder.decode(message)
        command = Applied(*(values.get(name, math.nan) for name in command_signals(self._vehicle.inputs.set_point)))
        acts = header_stamp_ns(message) or self._pace.stamp
        if self._commands.receive(command, after=(acts - self._pace.stamp) / 1e9):
            self._commanded = acts, time.monotonic()
            if not self._lockstep and acts >= self._pace.stamp and self._pace.behind(time.monotonic()):
                self._step()
        else:
            self.get_logger().warning(
                f"{COMMAND_TOPIC}: {command.r:g} and steering {command.delta:g} ignored; expected finite numbers",
                throttle_duration_sec=1.0,
            )

    def _on_time(self) -> None:
        """Publishes what is due. Nothing is caught up without an answer of an external driver: see :meth:`_on_command`."""
        if self._lockstep and self._is_unanswered():
            return
        behind = self._pace.behind(time.monotonic())
        for _ in range(1 + behind if self._driver == "pure_pursuit" else 1):
            self._step()

    def _step(self) -> None:
        """Drives one sample on."""
        try:
            sample = next(self._samples)
        except SimulationError as error:
            raise FinishedError(str(error)) from error
        self._publish(sample)

    def _is_unanswered(self) -> bool:
        """Whether the command that is due is still to come, from somebody who was heard lately."""
        if self._commanded is None:
            return False
        acts, came = self._commanded
        return acts < self._pace.stamp and time.monotonic() - came < _UNANSWERED

    def _publish(self, sample: Sample) -> None:
        """Actuators first, as a predictor needs them when the odometry arrives."""
        stamp = self._pace.stamp
        self._stamps.append(stamp)
        self._newest, self._room = sample, float(self._track.room(sample.s, sample.lateral))
        self._least = min(self._least, self._room)
        self._publish_feedback(actuators(stamp, sample.feedback, self._vehicle.inputs.set_point))
        if self._driver == "pure_pursuit":
            self._publish_command(actuators(stamp, sample.command, self._vehicle.inputs.set_point))
        else:
            self._tell(sample)
        self._sensors.measure(sample.pose, State(*sample.measured))
        if self._sensors.is_full:
            pose, measured, age = self._sensors.arrived
            self._publish_odometry(_odometry(self._stamps[-1 - age], pose, measured))
        self._pace.count += 1

    def _diagnose(self) -> None:
        """Tells what is true of the car, whatever is measured."""
        if not self._pace.count:
            return
        sample = self._newest
        level, words = (Level.OK, "on the road") if self._room >= 0 else (Level.WARN, "off the road")
        values = {
            "driven (laps)": f"{sample.s / self._track.length:.3f}",
            "place on the track (m)": f"{sample.s % self._track.length:.3f}",
            "beside the centre line (m)": f"{sample.lateral:.4f}",
            "least room to the borders so far (m)": f"{self._least:.4f}",
            "held up so far (s)": f"{self._pace.held_up:.3f}",
        }
        self._publish_diagnostics(diagnostics(self, "car", self._vehicle.name, level=level, words=words, values=values))

    def _tell(self, sample: Sample) -> None:
        """Logs when an external driver falls silent, comes back, leaves the road or returns to it."""
        obeyed = self._commands.fresh
        if obeyed != self._obeyed:
            self.get_logger().info(f"obeys {COMMAND_TOPIC}" if obeyed else f"{COMMAND_TOPIC} is silent: brakes")
        on_road = self._room >= 0
        if on_road != self._on_road:
            words = "is back on" if on_road else "leaves"
            self.get_logger().warning(f"{self._vehicle.name} {words} the road at s = {sample.s:.4g} m")
        self._obeyed, self._on_road = obeyed, on_road


def _odometry(stamp: int, pose: Pose, measured: State) -> Odometry:
    message = Odometry(child_frame_id="base_link")
    message.header.frame_id = "map"
    set_stamp(message.header, stamp)
    set_pose(message.pose.pose, *pose)
    twist = message.twist.twist
    twist.linear.x, twist.linear.y, twist.angular.z = (float(value) for value in measured)
    return message


def main(args: list[str] | None = None) -> None:
    """Runs the node; a user error is one line and exit status 1."""
    run(SimulatorNode, args)


if __name__ == "__main__":
    main()
