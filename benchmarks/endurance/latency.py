"""What the predictor adds to the middleware: ``python -m benchmarks.endurance.latency --model DIR --model DIR``.

A car that drives straight on sends its messages over DDS. A bare rclpy node, which publishes each odometry message again, and
the predictor with each model answer it, in turn and in rounds, each in a process of its own. The time runs from odometry
published to the answer received, in one process, so that no clocks are compared. What a model adds are the percentiles of its
times less those of the echo at the same rate.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import rclpy
from nav_msgs.msg import Odometry
from rclpy.executors import ExternalShutdownException

from benchmarks.endurance.live_run import (
    LiveRun,
    collecting,
    isolated_environment,
    predictor_process,
    wait_for_the_last,
)
from benchmarks.endurance.soak import Drive, Soaked, ticks
from dynssm_ros.arrays import Vector
from dynssm_ros.cli.console import console, progress_bar
from dynssm_ros.errors import UserError
from dynssm_ros.nodes.support import SENSOR_QOS, output, set_stamp
from dynssm_ros.reporting.tables import Column, Table
from dynssm_ros.runtime.artifact import open_artifact
from dynssm_ros.signals.decoding import header_stamp_ns
from dynssm_ros.signals.messages import ODOMETRY_TOPIC, PREDICTION_TOPIC

ECHO = "echo"
_SETTLED = 1.0  # s of answers that are not counted: imports and caches of the first ones


class Measured(NamedTuple):
    """Of one node at one rate, over all rounds."""

    node: str
    rate: float
    latency: Vector
    """Odometry published to answer received (ms)."""
    unanswered: int
    """Odometry messages that newer ones overtook, or that were lost."""


def echo(T_s: float) -> None:
    """Publishes each odometry message with its stamp moved by ``T_s`` (s) until the process is interrupted."""
    rclpy.init()
    node = rclpy.create_node("echo")
    publisher = output(node, Odometry, PREDICTION_TOPIC)

    def answer(message: Odometry) -> None:
        set_stamp(message.header, (header_stamp_ns(message) or 0) + round(T_s * 1e9))
        publisher.publish(message)

    node.create_subscription(Odometry, ODOMETRY_TOPIC, answer, SENSOR_QOS)
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        rclpy.try_shutdown()


@contextmanager
def _echo_process(T_s: float) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-m", "benchmarks.endurance.latency", "--echo", str(T_s)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:  # noqa: S603 - own module
        try:
            yield process
        finally:
            process.kill()


def measure(models: Sequence[Path], rates: Sequence[float], seconds: float, *, rounds: int = 1) -> Iterator[Measured]:
    """Drives for so long at each rate (Hz) with the echo and each model, in each round.

    Raises:
        UserError: a node does not answer, or the models are not of one sampling time.
    """
    if len(periods := {open_artifact(model).card.sampling_time for model in models}) != 1:
        raise UserError(f"models with sampling times of {sorted(periods)} s; expected one")
    (T_s,) = periods
    for rate in [*rates] * rounds:
        yield Measured(ECHO, rate, *_drive(_echo_process(T_s), models[0], rate, seconds))
        for model in models:
            yield Measured(model.name, rate, *_drive(predictor_process(model), model, rate, seconds))


def _drive(
    node: AbstractContextManager[subprocess.Popen[str]], model: Path, rate: float, seconds: float
) -> tuple[Vector, int]:
    """The latencies (ms), and how many messages have no answer; ``model`` says which car drives."""
    run = LiveRun(round(open_artifact(model).card.sampling_time * 1e9))
    with node as process, collecting(run) as collector:
        drive = Drive(model, collector, rate, 0, 0.0)
        drive.wait_for_answer(run, process)
        begin = time.monotonic()
        for _ in ticks(begin, 1 / rate, seconds + _SETTLED):
            drive.step(run, Soaked())
        wait_for_the_last(run, collector.wait_for)
    for stamp in [stamp for stamp, sent in run.sent.items() if sent < begin + _SETTLED]:
        del run.sent[stamp]
    return 1e3 * run.latencies, sum(stamp + run.T_s not in run.predicted for stamp in run.sent)


def table(measured: Sequence[Measured]) -> Table:
    """The rounds together: the times, and what each model adds to the echo at its rate (ms)."""
    columns = (
        Column("node"), Column("rate", "Hz"), Column("p50", "ms"), Column("p99", "ms"), Column("adds at p50", "ms"),
        Column("adds at p99", "ms"), Column("messages"), Column("unanswered"),
    )  # fmt: skip
    rows: list[list[Any]] = []
    for node, rate in dict.fromkeys((each.node, each.rate) for each in measured):
        own, bare = (_percentiles(measured, name, rate) for name in (node, ECHO))
        same = [each for each in measured if (each.node, each.rate) == (node, rate)]
        unanswered = sum(each.unanswered for each in same)
        added = (None, None) if node == ECHO else (own - bare)
        rows.append([node, rate, *own, *added, unanswered + sum(len(each.latency) for each in same), unanswered])
    return Table(columns, rows)


def _percentiles(measured: Sequence[Measured], node: str, rate: float) -> Vector:
    found = np.concatenate([each.latency for each in measured if (each.node, each.rate) == (node, rate)])
    return np.asarray(np.percentile(found, (50, 99)))


def main(arguments: Sequence[str] | None = None) -> None:
    """Measures and prints a table."""
    parser = argparse.ArgumentParser(prog="benchmarks.endurance.latency", description=__doc__)
    parser.add_argument("--model", type=Path, action="append", default=[], help="model folder; repeatable, one car's")
    parser.add_argument("--rate", type=float, action="append", default=[], help="of the odometry (Hz); repeatable")
    parser.add_argument("--seconds", type=float, default=20.0, help="of each drive")
    parser.add_argument("--rounds", type=int, default=3, help="how often")
    parser.add_argument("--echo", type=float, metavar="T_S", help=argparse.SUPPRESS)
    given = parser.parse_args(arguments)
    if given.echo is not None:
        echo(given.echo)
        return
    os.environ.update(isolated_environment())
    rates = given.rate or [100.0, 200.0, 400.0]
    found: list[Measured] = []
    try:
        with progress_bar("driving") as progress:
            for each in measure(given.model, rates, given.seconds, rounds=given.rounds):
                found.append(each)
                progress(len(found), given.rounds * len(rates) * (len(given.model) + 1))
    except UserError as error:
        sys.exit(f"error: {error}")
    console.print(table(found).markdown(), markup=False, highlight=False, soft_wrap=True)


if __name__ == "__main__":
    main()
