"""Faults of a live stack: ``python -m benchmarks.endurance.live_faults --model ORCA --model AV21 --count 30``.

Simulated car, predictor and a controller in the loop are processes of their own. Odometry goes through this process, which
spoils it. What breaks, when, how much, at what speed and with which car follows from a hash of the fault's number. Afterwards
every node must be there, the verdict must not have been OK for longer than a second, and the car must be on the road, or have
stopped within the way that full brakes take from where the fault was told. Ends with status 1 otherwise. ``--healthy
MINUTES`` drives without faults instead; then nothing may be braked for, and nothing but OK be said.
"""

from __future__ import annotations

import argparse
import hashlib
import math
import os
import re
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from copy import deepcopy
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from lifecycle_msgs.srv import ChangeState
from nav_msgs.msg import Odometry
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState

from benchmarks.endurance.live_run import Collector, LiveRun, collecting, isolated_environment, node_process
from dynssm_ros.cli.console import console, progress_bar
from dynssm_ros.errors import UserError
from dynssm_ros.files import write_json
from dynssm_ros.nodes.support import SENSOR_QOS, set_pose, set_stamp
from dynssm_ros.signals.decoding import header_stamp_ns
from dynssm_ros.signals.messages import COMMAND_TOPIC, ODOMETRY_TOPIC, PARAMETERS_TOPIC, PREDICTION_TOPIC
from dynssm_ros.signals.signal_map import compile_field
from dynssm_ros.vehicle import COEFFICIENTS, Vehicle, load_vehicle
from dynssm_ros.vehicle.limits import vehicle_limits

CARS = {"orca": {"vehicle": "orca", "scale": 1.0}, "av21": {"vehicle": "av21", "scale": 25.0}}
SPEEDS = (0.5, 0.7, 0.9)
"""Shares of the car's limits in the line's speed."""
_SIMULATED = "/sim/odometry"
_START = 90.0  # s until the car drives
_STEADY = 4.0  # s of driving before the earliest fault
_AFTER = {"orca": 4.0, "av21": 14.0}  # s that a fault lasts: until the car has stood
_SILENT = 1.0  # s for which OK may be said of a fault
_STANDS = 0.05  # of the speed before
_SLACK = 1.2  # times the way of full brakes
_yaw = compile_field("yaw(pose.pose.orientation)")
Spoil = Callable[[Odometry], list[Odometry]]


@dataclass(frozen=True)
class Drawn:
    """A fault."""

    number: int
    what: str
    after: float  # s of driving
    share: float  # of how much, from 0 to 1
    car: str
    speed: float

    @classmethod
    def of(cls, number: int) -> Drawn:
        """The one with this number."""
        draws = hashlib.sha256(f"live fault {number}".encode()).digest()
        what = tuple(FAULTS)[int.from_bytes(draws[:2], "big") % len(FAULTS)]
        car, speed = tuple(CARS)[draws[4] % len(CARS)], SPEEDS[draws[5] % len(SPEEDS)]
        return cls(number, what, _STEADY + 4.0 * draws[2] / 255, draws[3] / 255, car, speed)


@dataclass
class Outcome:
    """What became of a fault."""

    fault: Drawn
    how_much: str
    speed: float  # when it began (m/s)
    told: float | None = None  # s until a verdict that was not OK
    words: str = ""  # the first such verdict
    least_room: float = math.nan  # of the car's centre to the borders (m); negative outside
    way: float = math.nan  # from where the fault was told until the car stood (m)
    brakes: float = math.nan  # what full brakes take from the speed there (m)
    ended: tuple[str, ...] = ()  # nodes that are gone
    wrong: str = ""  # what must not happen, in words


class Stack:
    """The processes of one car, and what they say."""

    def __init__(self, stack: ExitStack, model: Path, car: str, speed: float) -> None:
        os.environ.update(isolated_environment())
        self.vehicle = load_vehicle(car)
        self.run = LiveRun(round(self.vehicle.sampling_time * 1e9))
        self.collector: Collector = stack.enter_context(collecting(self.run))
        self.spoil: Spoil = lambda message: [message]
        self.driven: deque[tuple[float, float, float, float]] = deque(maxlen=100_000)  # s, m/s, m, m: as it truly is
        self._publish = self.collector.create_publisher(Odometry, ODOMETRY_TOPIC, SENSOR_QOS).publish
        self.collector.create_subscription(Odometry, _SIMULATED, self._relay, SENSOR_QOS)
        self.said: list[tuple[float, str, int, str]] = []  # s, node, level, words
        self.room = math.inf
        environment, how = os.environ.copy(), CARS[car]
        remapped = {ODOMETRY_TOPIC.removeprefix("/"): _SIMULATED}
        predictor = {"model": model, "diagnostics_period": 0.2}
        controller = {**how, "speed_scale": speed, "diagnostics_period": 0.2}
        self.nodes = {
            "simulator": stack.enter_context(
                node_process("simulator", {**how, "driver": "external"}, environment, remapped=remapped)
            ),
            "controller": stack.enter_context(node_process("controller", controller, environment)),
            "predictor": stack.enter_context(node_process("predictor", predictor, environment)),
        }

    @property
    def v_x(self) -> float:
        return self.driven[-1][1] if self.driven else 0.0

    def _relay(self, message: Odometry) -> None:
        twist, place = message.twist.twist.linear, message.pose.pose.position
        self.driven.append((time.monotonic(), math.hypot(twist.x, twist.y), place.x, place.y))
        for each in self.spoil(message):
            self._publish(each)

    def look(self) -> None:
        """Takes in what was said since the last look."""
        with self.collector.changed:
            news, self.run.diagnostics[:] = list(self.run.diagnostics), []
            self.run.predicted.clear()
            self.run.received.clear()
            self.run.parameters.clear()
        now = time.monotonic()
        for level, words, values in news:
            if "laps" in values:
                self.said.append((now, "controller", level, words))
            elif "model" in values:
                self.said.append((now, "predictor", level, words))
            elif (room := values.get("least room to the borders so far (m)")) is not None:
                self.room = float(room)

    def wait(self, seconds: float, done: Callable[[], bool] = lambda: False) -> bool:
        """Lets it drive for so long, or until something is ``done``."""
        end, tick = time.monotonic() + seconds, threading.Event()
        while time.monotonic() < end:
            self.look()
            if done():
                return True
            tick.wait(0.02)  # nobody sets it: the rate at which it is looked
        return False

    def newest(self, node: str) -> tuple[int, str]:
        """Level and words of its last verdict."""
        return next(((level, words) for _, who, level, words in reversed(self.said) if who == node), (2, ""))


def _changed(change: Callable[[Odometry], object]) -> Spoil:
    def spoil(message: Odometry) -> list[Odometry]:
        change(message)
        return [message]

    return spoil


def _frozen(pose_alone: bool) -> Spoil:
    first: list[Odometry] = []

    def freeze(message: Odometry) -> None:
        first[:] = first or [deepcopy(message)]
        message.pose = first[0].pose
        if not pose_alone:
            message.twist = first[0].twist

    return _changed(freeze)


def _late(seconds: float) -> Spoil:
    kept: deque[tuple[float, Odometry]] = deque()

    def spoil(message: Odometry) -> list[Odometry]:
        kept.append((time.monotonic(), message))
        return [kept.popleft()[1] for _ in range(len(kept)) if time.monotonic() - kept[0][0] >= seconds]

    return spoil


def _pose(message: Odometry, dx: float = 0.0, turned: float = 0.0) -> None:
    place, heading = message.pose.pose.position, _yaw(message)
    assert heading is not None
    set_pose(message.pose.pose, place.x + dx, place.y, heading + turned)


def _twist(message: Odometry, factor: float = 1.0, turned: float = 0.0) -> None:
    v = message.twist.twist.linear
    c, s = math.cos(turned), math.sin(turned)
    v.x, v.y = factor * (c * v.x - s * v.y), factor * (s * v.x + c * v.y)


def _disorient(message: Odometry) -> None:
    message.pose.pose.orientation.z = message.pose.pose.orientation.w = 0.0


def _set(change: Callable[[Any, float], None], value: float) -> Spoil:
    return _changed(lambda message: change(message, value))


def _stamped(seconds: float) -> Spoil:
    return _changed(lambda m: set_stamp(m.header, (header_stamp_ns(m) or 0) + round(1e9 * seconds)))


Break = Callable[[Stack, float, float], str]
"""Breaks something by a share (0 to 1), of a car with a wheelbase (m); says how much."""


def _odometry(make: Callable[[float], Spoil], low: float, high: float, words: str) -> Break:
    """Spoils odometry by a value between ``low`` and ``high``."""

    def apply(stack: Stack, share: float, wheelbase: float) -> str:
        value = low * (high / low) ** share
        stack.spoil = make(wheelbase * value if "wheelbases" in words else value)
        return words.format(f"{value:.3g}")

    return apply


def _stopped(node: str, low: float, high: float) -> Break:
    """SIGSTOP for a while."""

    def apply(stack: Stack, share: float, wheelbase: float) -> str:
        seconds = low * (high / low) ** share
        stack.nodes[node].send_signal(signal.SIGSTOP)
        threading.Timer(seconds, lambda: stack.nodes[node].send_signal(signal.SIGCONT)).start()
        return f"{seconds:.2f} s"

    return apply


def _killed(stack: Stack, share: float, wheelbase: float) -> str:
    stack.nodes.pop("predictor").kill()
    return "SIGKILL"


def _second_commander(stack: Stack, share: float, wheelbase: float) -> str:
    low, high = stack.vehicle.inputs.throttle
    command = JointState(name=["throttle", "steering"], position=[low + share * (high - low), 0.0])
    publish = stack.collector.create_publisher(JointState, COMMAND_TOPIC, SENSOR_QOS).publish
    stack.spoil = _changed(lambda message: publish(command))
    return f"throttle {command.position[0]:.2f}"


def _rogue_predictor(stack: Stack, share: float, wheelbase: float) -> str:
    factor = 10 ** (6 * share - 1)
    publish = stack.collector.create_publisher(Odometry, PREDICTION_TOPIC, SENSOR_QOS).publish

    def said(message: Odometry) -> None:
        wrong = deepcopy(message)
        set_stamp(wrong.header, (header_stamp_ns(message) or 0) + stack.run.T_s)
        _twist(wrong, factor, 0.5)
        publish(wrong)

    stack.spoil = _changed(said)
    return f"states times {factor:.3g}"


def _rogue_coefficients(stack: Stack, share: float, wheelbase: float) -> str:
    lower, upper = stack.vehicle.lower, stack.vehicle.upper
    theta = (lower + share * (upper - lower)).tolist()
    publish = stack.collector.create_publisher(JointState, PARAMETERS_TOPIC, SENSOR_QOS).publish

    def said(message: Odometry) -> None:
        wrong = JointState(name=list(COEFFICIENTS), position=theta)
        set_stamp(wrong.header, (header_stamp_ns(message) or 0) + stack.run.T_s)
        publish(wrong)

    stack.spoil = _changed(said)
    return f"all at {share:.2f} of their ranges"


def _invalid_requests(stack: Stack, share: float, wheelbase: float) -> str:
    for node in ("controller", "dynssm"):
        change = stack.collector.create_client(ChangeState, f"/{node}/change_state")
        request = ChangeState.Request()
        request.transition.id = round(1 + 3 * share)
        change.call_async(request)
        values = stack.collector.create_client(SetParameters, f"/{node}/set_parameters")
        for name, value in (("x" * 256, 1.0), ("model", "/dev/zero"), ("max_age", "soon")):
            values.call_async(SetParameters.Request(parameters=[_message(name, value)]))
    return f"transition {round(1 + 3 * share)}, a name of 256 letters, /dev/zero as model"


def _message(name: str, value: object) -> Any:
    return Parameter(name, value=value).to_parameter_msg()  # type: ignore[no-untyped-call]


FAULTS: dict[str, Break] = {
    "frozen": _odometry(lambda _: _frozen(False), 1.0, 1.0, "all of it"),
    "pose frozen": _odometry(lambda _: _frozen(True), 1.0, 1.0, "the pose"),
    "late": _odometry(_late, 0.12, 0.5, "{} s"),
    "beside": _odometry(lambda d: _set(lambda m, v: _pose(m, dx=v), d), 3.0, 100.0, "{} wheelbases"),
    "heading turned": _odometry(lambda a: _set(lambda m, v: _pose(m, turned=v), a), 0.6, math.pi, "{} rad"),
    "twist turned": _odometry(lambda a: _set(lambda m, v: _twist(m, turned=v), a), 0.8, math.pi, "{} rad"),
    "speed scaled": _odometry(lambda f: _set(_twist, f), 2.5, 20.0, "times {}"),
    "not a number": _odometry(lambda _: _set(lambda m, v: _pose(m, dx=math.nan), 0.0), 1.0, 1.0, "x"),
    "no orientation": _odometry(lambda _: _changed(_disorient), 1.0, 1.0, "zeros"),
    "other frame": _odometry(lambda _: _set(lambda m, v: setattr(m, "child_frame_id", "map"), 0.0), 1.0, 1.0, "map"),
    "silent": _odometry(lambda _: lambda message: [], 1.0, 1.0, "no odometry"),
    "stamps ahead": _odometry(_stamped, 1.0, 3600.0, "{} s"),
    "stamps back": _odometry(lambda s: _stamped(-s), 1.0, 3600.0, "{} s"),
    "controller stopped": _stopped("controller", 0.3, 2.0),
    "predictor stopped": _stopped("predictor", 0.3, 5.0),
    "simulator stopped": _stopped("simulator", 0.3, 2.0),
    "predictor killed": _killed,
    "second commander": _second_commander,
    "rogue predictor": _rogue_predictor,
    "rogue coefficients": _rogue_coefficients,
    "invalid requests": _invalid_requests,
}
_HARMLESS = ("predictor stopped", "predictor killed", "rogue predictor", "rogue coefficients", "invalid requests")
"""With these it drives on."""


def drive(model: Path, fault: Drawn) -> Outcome:
    """Lets a stack drive, breaks something, and looks what comes of it.

    Raises:
        UserError: the car did not begin to drive.
    """
    with ExitStack() as entered:
        stack = Stack(entered, model, fault.car, fault.speed)
        _begin(stack, fault.after)
        before, began = stack.v_x, time.monotonic()
        constants = stack.vehicle.constants
        how_much = FAULTS[fault.what](stack, fault.share, constants.l_f + constants.l_r)
        outcome = Outcome(fault, how_much, round(before, 3))
        stack.wait(_AFTER[fault.car])
        stack.look()
        _judge(stack, outcome, began)
        outcome.ended = tuple(name for name, process in stack.nodes.items() if process.poll() is not None)
        if outcome.ended:
            outcome.wrong = f"ended: {', '.join(outcome.ended)}"
    return outcome


def _begin(stack: Stack, seconds: float) -> None:
    """Drives for so long with a verdict of OK.

    Raises:
        UserError: it does not.
    """
    if not stack.wait(_START, lambda: stack.newest("controller")[1].startswith("drives") and stack.v_x > 0.3):
        raise UserError(f"it does not drive within {_START:g} s: {stack.said[-2:]}")
    stack.wait(seconds)


def _judge(stack: Stack, outcome: Outcome, began: float) -> None:
    usual = {_kind(words) for at, _, level, words in stack.said if at <= began and level > 0}
    heard = [said for said in stack.said if said[0] > began and said[2] > 0 and _kind(said[3]) not in usual]
    if heard:
        told, _, _, outcome.words = heard[0]
        outcome.told = round(told - began, 2)
    outcome.least_room = round(stack.room, 4)
    at, speeds, x, y = np.array(stack.driven).T
    since = at >= began + (outcome.told or 0.0)
    stands = bool(speeds[-1] < max(_STANDS * outcome.speed, 0.02))
    outcome.way = round(float(np.hypot(np.diff(x[since]), np.diff(y[since])).sum()), 3) if since.any() else 0.0
    outcome.brakes = round(way_of_full_brakes(stack.vehicle, float(speeds[since][0]) if since.any() else 0.0), 3)
    if outcome.fault.what in _HARMLESS:
        if outcome.least_room < 0:
            outcome.wrong = "off the road"
        return
    if outcome.told is None or outcome.told > _SILENT:
        outcome.wrong = f"OK for {outcome.told} s"
    elif outcome.least_room < 0 and not (stands and outcome.way <= _SLACK * outcome.brakes):
        outcome.wrong = "off the road, and not stopped as full brakes stop"


def _kind(words: str) -> str:
    """A verdict without its numbers."""
    return re.sub(r"[\d.]+", "", words)


def way_of_full_brakes(vehicle: Vehicle, speed: float) -> float:
    """From ``speed`` (m/s) until it stands (m)."""
    limits = vehicle_limits(vehicle)
    v = np.linspace(0.0, speed, 200)
    return float(np.trapezoid(v / np.interp(v, limits.speed, limits.brake), v))


def healthy(model: Path, minutes: float, car: str, speed: float) -> dict[str, Any]:
    """Drives without a fault; how often it braked and what was said other than OK."""
    with ExitStack() as entered:
        stack = Stack(entered, model, car, speed)
        _begin(stack, 2.0)
        stack.said.clear()
        stack.wait(60 * minutes)
        alarms = [f"{who}: {words}" for _, who, level, words in stack.said if level > 0]
        return {"car": car, "speed": speed, "verdicts": len(stack.said), "alarms": alarms, "least_room": stack.room}


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs it and says what came of it."""
    parser = argparse.ArgumentParser(prog="benchmarks.endurance.live_faults", description=__doc__)
    parser.add_argument("--model", type=Path, action="append", required=True, help="model folder; one for each car")
    parser.add_argument("--first", type=int, default=0, help="number of the first fault")
    parser.add_argument("--count", type=int, default=30, help="how many")
    parser.add_argument("--healthy", type=float, help="minutes without faults instead, over cars and speeds")
    parser.add_argument("--json", type=Path, help="also write the result as JSON")
    given = parser.parse_args(arguments)
    models = dict(zip(CARS, given.model, strict=True))
    with progress_bar("driving") as progress:
        if given.healthy is not None:
            cells = [(car, speed) for car in CARS for speed in SPEEDS]
            found: list[Any] = []
            for car, speed in cells:
                found.append(healthy(models[car], given.healthy / len(cells), car, speed))
                progress(len(found), len(cells))
            failed = [drive for drive in found if drive["alarms"]]
        else:
            found = []
            for number in range(given.first, given.first + given.count):
                fault = Drawn.of(number)
                found.append(asdict(drive(models[fault.car], fault)))
                progress(len(found), given.count)
                if given.json is not None:
                    write_json(given.json, {"drives": found})
            failed = [outcome for outcome in found if outcome["wrong"]]
    if given.json is not None:
        write_json(given.json, {"drives": found})
    for each in found:
        console.print(each, markup=False, highlight=False)
    console.print(f"{len(found) - len(failed)} of {len(found)} as they should be", markup=False, highlight=False)
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
