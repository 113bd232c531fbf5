"""Damaged messages for the predictor, in process: ``python -m benchmarks.endurance.fuzz --model DIR --messages 1000000``.

A car drives straight on, and each of its messages may be spoilt: numbers that are none or beyond any car, stamps that
repeat, run backwards or far ahead, joints without a name, a position or an order, messages that are lost or come twice.
Whatever comes, nothing may be raised, nothing published that is not finite, and nothing predicted from an odometry message
that is not finite or beyond what the car can do. Ends with status 1 otherwise.
"""

from __future__ import annotations

import argparse
import math
import sys
import traceback
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from dynssm_ros.cli.console import console, progress_bar
from dynssm_ros.progress import Progress
from dynssm_ros.runtime.artifact import open_artifact
from dynssm_ros.runtime.onnx_model import OnnxModel
from dynssm_ros.runtime.plausibility import ranges
from dynssm_ros.runtime.predictor import Prediction, Predictor
from dynssm_ros.signals import messages
from dynssm_ros.signals.decoding import frames_of, header_stamp_ns, live_decoders
from dynssm_ros.signals.signal_map import load_signal_map
from dynssm_ros.vehicle import Vehicle
from dynssm_ros.vehicle.limits import vehicle_limits

_START = 1_700_000_000_000_000_000  # ns
_PERIOD = 10_000_000  # ns between odometry messages
_SPOILT = 0.15  # share of messages
_ODD = 0.01  # share of those that are lost, and of those that come twice
_SPEED = 0.3  # of the car's top speed
_REPORTED = 1000  # messages between reports of progress
_NUMBERS = (math.nan, math.inf, -math.inf, 1e308, -1e308, 1e6, -1e6, 5e-324, 1e3, -1e3)
_STAMPS = (0, -1, -_PERIOD, -(10**9), -3600 * 10**9, _PERIOD, 10**9, 10 * 10**9, 3600 * 10**9, 10**18)
_JOINTS: tuple[dict[str, float], ...] = (
    {}, {"throttle": 0.2}, {"steering": 0.0}, {"steering": 0.0, "throttle": 0.2}, {"brake": 1.0},
    {"throttle": 0.2, "steering": 0.0, "gear": 3.0},
)  # fmt: skip


@dataclass
class Fuzzed:
    """What came of it."""

    messages: int = 0  # that went in
    spoilt: int = 0  # those that were damaged
    predictions: int = 0  # that came out
    refusals: Counter[str] = field(default_factory=Counter)  # by their reason
    violations: dict[str, str] = field(default_factory=dict)
    """What must not happen, in words, the first of each kind with the number of its message."""


class Traffic:
    """The messages of a car that drives straight on, every ``period`` (ns) one of odometry.

    A share ``spoilt`` is damaged. A hundredth of all is lost and as many come twice, if any are. What ``vehicle`` can
    do says what is beyond it, and how fast it drives.
    """

    def __init__(self, vehicle: Vehicle, seed: int, period: int = _PERIOD, spoilt: float = _SPOILT) -> None:
        self.random = np.random.default_rng(seed)
        self.spoilt, self.period = spoilt, period
        self.ranges = ranges(vehicle)
        self.speed = _SPEED * vehicle_limits(vehicle).top_speed
        self.stamp = _START

    def step(self) -> Iterator[tuple[str, Any, bool]]:
        """A period: actuators, then odometry, each with its topic and whether it is spoilt."""
        self.stamp += self.period
        odd = _ODD if self.spoilt else 0.0
        for topic in (messages.FEEDBACK_TOPIC, messages.COMMAND_TOPIC, messages.ODOMETRY_TOPIC):
            for _ in range(int(self.random.choice((1, 0, 2), p=(1 - 2 * odd, odd, odd)))):
                spoil = bool(self.random.random() < self.spoilt)
                make = self._odometry if topic == messages.ODOMETRY_TOPIC else self._actuators
                yield topic, make(spoil), spoil

    def invalid(self, values: Mapping[str, float]) -> str:
        """What of the decoded values of a message no car has, in words; empty if nothing."""
        for name, value in values.items():
            limit = self.ranges.get(name)
            if not math.isfinite(value) or (limit is not None and not limit.low <= value <= limit.high):
                return f"{name} = {value}"
        return ""

    def _stamp(self, spoil: bool) -> int:
        moved = int(self.random.choice(_STAMPS)) if spoil and self.random.random() < 1 / 3 else 0
        return max(self.stamp + moved, 0) if moved else self.stamp

    def _odometry(self, spoil: bool) -> Any:
        noise = self.random.normal(size=6)
        pose = [self.speed * (self.stamp - _START) / 1e9, *(0.01 * noise[1:3])]
        state = [self.speed * (1 + 0.01 * noise[3]), 0.01 * self.speed * noise[4], 0.05 * noise[5]]
        if spoil and self.random.random() < 2 / 3:
            place = int(self.random.integers(6))
            (pose if place < 3 else state)[place % 3] = float(self.random.choice(_NUMBERS))
        x, y, theta = pose
        v_x, v_y, omega = state
        theta = theta if math.isfinite(theta) else 0.0  # a quaternion of no number is made below
        message = messages.odometry(self._stamp(spoil), (x, y, theta), (v_x, v_y, omega))
        if spoil and self.random.random() < 0.1:
            message.pose.pose.orientation.w = message.pose.pose.orientation.z = float(
                self.random.choice((math.nan, 0.0))
            )
        return message

    def _actuators(self, spoil: bool) -> Any:
        values = {"throttle": 0.2 + 0.01 * self.random.normal(), "steering": 0.01 * self.random.normal()}
        if spoil and self.random.random() < 1 / 3:
            values = dict(_JOINTS[int(self.random.integers(len(_JOINTS)))])
        elif spoil and self.random.random() < 1 / 2:
            values[str(self.random.choice(list(values)))] = float(self.random.choice(_NUMBERS))
        message = messages.joint_state(self._stamp(spoil), values)
        if spoil and self.random.random() < 0.2:
            message.position = message.position[: int(self.random.integers(len(message.position) + 1))]
        if spoil and self.random.random() < 0.1:
            message.name = message.name * 2
        return message


class _Predicting:
    """A predictor in this process, whose answers are judged."""

    def __init__(self, predictor: Predictor, seed: int) -> None:
        self.predictor = predictor
        self.traffic = Traffic(predictor.model.artifact.card.vehicle, seed)
        self.decoders = live_decoders(predictor.signal_map)
        self.done = Fuzzed()

    def step(self) -> None:
        for topic, message, spoilt in self.traffic.step():
            self.done.messages += 1
            self.done.spoilt += spoilt
            self._send(topic, message)

    def _send(self, topic: str, message: Any) -> None:
        try:
            stamp = header_stamp_ns(message)
            assert stamp is not None
            values = self.decoders[topic].decode(message)
            if topic == messages.ODOMETRY_TOPIC:
                self._judge(stamp, values, self.predictor.predict(stamp, values, frames_of(message)))
                self.predictor.finish()
            else:
                self.predictor.observe(stamp, values)
        except Exception as error:  # that there is none is what is tried here
            self._violated(f"{type(error).__name__} raised", traceback.format_exc())

    def _judge(self, stamp: int, values: dict[str, float], outcome: Any) -> None:
        if not isinstance(outcome, Prediction):
            self.done.refusals[outcome.name.lower()] += 1
            return
        self.done.predictions += 1
        parts = (
            outcome.state,
            outcome.pose,
            outcome.theta,
            outcome.theta_std,
            outcome.variance,
            outcome.residual_share,
        )
        if not all(np.all(np.isfinite(part)) for part in parts if part is not None):
            self._violated("an output is not finite", repr(outcome))
        if invalid := self.traffic.invalid(values):
            self._violated("predicted from an invalid sample", invalid)
        if outcome.stamp <= stamp:
            self._violated("the predicted instant is not ahead", f"{outcome.stamp} of {stamp}")

    def _violated(self, kind: str, words: str) -> None:
        self.done.violations.setdefault(kind, f"message {self.done.messages}: {words}")


def fuzz(model: Path, count: int, seed: int, progress: Progress | None = None) -> Fuzzed:
    """Sends at least ``count`` messages to a predictor of ``model``; what they are follows from ``seed``."""
    car = _Predicting(Predictor(OnnxModel(open_artifact(model)), load_signal_map("default")), seed)
    while car.done.messages < count:
        for _ in range(_REPORTED):
            car.step()
        if progress is not None:
            progress(min(car.done.messages, count), count)
    return car.done


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs it and says what came of it."""
    parser = argparse.ArgumentParser(prog="benchmarks.endurance.fuzz", description=__doc__)
    parser.add_argument("--model", type=Path, required=True, help="model folder")
    parser.add_argument("--messages", type=int, default=1_000_000, help="how many")
    parser.add_argument("--seed", type=int, default=0, help="what they are")
    given = parser.parse_args(arguments)
    with progress_bar("fuzzing") as progress:
        done = fuzz(given.model, given.messages, given.seed, progress)
    refused = ", ".join(f"{count} {reason}" for reason, count in done.refusals.most_common())
    console.print(
        f"{done.messages} messages, {done.spoilt} of them spoilt (seed {given.seed}): {done.predictions} predictions; "
        f"refused: {refused}",
        markup=False,
    )
    for kind, words in done.violations.items():
        console.print(f"{kind}: {words}", markup=False)
    sys.exit(1 if done.violations else 0)


if __name__ == "__main__":
    main()
