"""A predictor at work for an hour, in a process of its own: ``python -m benchmarks.endurance.soak --model DIR --minutes 60``.

A car that drives straight on sends its messages over DDS at a steady rate. What comes back is counted and timed, and every
second the operating system is asked what the node's process holds. ``--spoilt 0.15`` damages messages as
:mod:`benchmarks.endurance.fuzz` does; then nothing may be predicted from an invalid one. ``--swap DIR`` exchanges the model
for another one and back, again and again. Ends with status 1 if messages are lost that were good, if the node predicts what
it must not, or if it refuses a swap.
"""

from __future__ import annotations

import argparse
import math
import os
import struct
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import JointState

from benchmarks.endurance.fuzz import Traffic
from benchmarks.endurance.live_run import (
    Collector,
    LiveRun,
    check_running,
    collecting,
    isolated_environment,
    predictor_process,
    wait_for_the_last,
)
from dynssm_ros.cli.console import console, progress_bar
from dynssm_ros.errors import UserError
from dynssm_ros.files import write_json
from dynssm_ros.nodes.support import SENSOR_QOS
from dynssm_ros.progress import Progress
from dynssm_ros.runtime.artifact import open_artifact
from dynssm_ros.runtime.bounded import TIME_LIMIT_S
from dynssm_ros.signals import messages
from dynssm_ros.signals.decoding import header_stamp_ns, live_decoders
from dynssm_ros.signals.signal_map import load_signal_map

_TYPESTORE = get_typestore(Stores.ROS2_JAZZY)
_START = 60.0  # s that the node may take until it answers
_SETTLED = 60.0  # s after which memory is to be flat
_AFTER_SWAP = 1.0  # s in which answers are those of a swap
_MB = 1e6


@dataclass
class Soaked:
    """What came of it. Times are of no meaning where messages are spoilt, and are left empty."""

    messages: int = 0  # that were sent
    spoilt: int = 0  # how many of them damaged
    odometry: int = 0  # and how many of them odometry
    predictions: int = 0  # that came back
    lost: int = (
        0  # odometry messages without a prediction, after the first one; of no meaning where messages are spoilt
    )
    latency_ms: dict[str, float] = field(default_factory=dict)  # percentiles, odometry published to prediction received
    passed_over: int = 0  # odometry messages without a prediction, as newer ones waited
    late: int = 0  # predictions that took longer than T_s
    longest_gap_ms: float | None = None  # the longest time between two predictions
    # of the node's process: after the first minute (or at the start of a shorter run), the most since then, at the end
    rss_mb: tuple[float, float, float] = (0.0, 0.0, 0.0)
    open_files: tuple[int, int, int] = (0, 0, 0)
    swaps: int = 0  # models that were taken
    slowest_at_swap_ms: float | None = None  # the largest latency in the second after a swap
    slowest_else_ms: float | None = None  # and at other times
    violations: dict[str, str] = field(default_factory=dict)  # what must not happen, in words, the first of each kind


class Drive:
    """The traffic on the bus, and what is known of it."""

    def __init__(self, model: Path, collector: Collector, rate: float, seed: int, spoilt: float) -> None:
        vehicle = open_artifact(model).card.vehicle
        self.traffic = Traffic(vehicle, seed, round(1e9 / rate), spoilt)
        self.period = 1.0 / rate
        self.decoders = live_decoders(load_signal_map("default"))
        self.collector = collector
        self.invalid: dict[int, str] = {}
        """Odometry that nothing may be predicted from, by its stamp, in words."""
        kinds = {
            messages.FEEDBACK_TOPIC: JointState,
            messages.COMMAND_TOPIC: JointState,
            messages.ODOMETRY_TOPIC: Odometry,
        }
        self.publishers = {topic: collector.create_publisher(kind, topic, SENSOR_QOS) for topic, kind in kinds.items()}

    def wait_for_answer(self, run: LiveRun, process: subprocess.Popen[str]) -> None:
        """Drives undamaged until the node predicts; what was sent until then is forgotten.

        Raises:
            UserError: it does not.
        """
        spoilt, self.traffic.spoilt = self.traffic.spoilt, 0.0
        deadline = time.monotonic() + _START
        while not run.predicted:
            check_running("predictor", process)
            if time.monotonic() > deadline:
                raise UserError(f"no prediction within {_START:g} s; diagnostics: {run.diagnostics[-1:]}")
            self.step(run, Soaked())
            time.sleep(self.period)
        self.traffic.spoilt = spoilt
        run.sent.clear()

    def step(self, run: LiveRun, done: Soaked) -> None:
        for topic, message, spoilt in self.traffic.step():
            try:
                raw = bytes(_TYPESTORE.serialize_cdr(message, message.__msgtype__))
            except struct.error:  # a stamp that no message can carry
                continue
            done.messages += 1
            done.spoilt += spoilt
            if topic == messages.ODOMETRY_TOPIC:
                self._note(message, run, done)
            self.publishers[topic].publish(raw)

    def _note(self, message: Any, run: LiveRun, done: Soaked) -> None:
        stamp = header_stamp_ns(message)
        assert stamp is not None
        done.odometry += 1
        run.sent.setdefault(stamp, time.monotonic())
        words = self.traffic.invalid(self.decoders[messages.ODOMETRY_TOPIC].decode(message))
        if not words:
            self.invalid[stamp] = ""  # one good message at that instant is enough
        else:
            self.invalid.setdefault(stamp, words)


class _Swapper:
    """Gives the node another model and the first one back, in turn, without waiting for its answers."""

    def __init__(self, collector: Collector, models: Sequence[Path], every: float) -> None:
        self.collector, self.models, self.every = collector, models, every
        self.client = collector.create_client(SetParameters, "/dynssm/set_parameters")
        self.asked: list[float] = []
        self.answers: list[Any] = []
        self.due = time.monotonic() + every

    def step(self) -> None:
        if len(self.models) < 2 or time.monotonic() < self.due:
            return
        self.due += self.every
        self.asked.append(time.monotonic())
        model = self.models[len(self.asked) % len(self.models)]
        value = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=str(model))
        request = SetParameters.Request(parameters=[Parameter(name="model", value=value)])
        answer = self.client.call_async(request)
        answer.add_done_callback(self._note)  # type: ignore[no-untyped-call]

    def _note(self, future: Any) -> None:
        with self.collector.changed:
            self.answers.append(future.result().results[0])
            self.collector.changed.notify_all()


def soak(
    models: Sequence[Path],
    seconds: float,
    rate: float,
    seed: int = 0,
    spoilt: float = 0.0,
    swap_every: float = 5.0,
    progress: Progress | None = None,
) -> Soaked:
    """Drives for so long, with odometry at ``rate`` (Hz) and a share ``spoilt`` of damaged messages.

    The node has the first of the model folders; with further ones it is given each in turn, every ``swap_every``
    seconds.

    Raises:
        UserError: the node does not start, or stops.
    """
    os.environ.update(isolated_environment())
    card = open_artifact(models[0]).card
    run, done, held = LiveRun(round(card.sampling_time * 1e9)), Soaked(), list[tuple[float, int]]()
    with predictor_process(models[0], {}, os.environ.copy()) as process, collecting(run) as collector:
        drive = Drive(models[0], collector, rate, seed, spoilt)
        drive.wait_for_answer(run, process)
        swapper = _Swapper(collector, models, swap_every)
        begin = time.monotonic()
        for tick in ticks(begin, 1 / rate, seconds):
            drive.step(run, done)
            swapper.step()
            if tick - begin >= len(held):
                check_running("predictor", process)
                held.append(_holds(process.pid))
                run.parameters.clear()
                del run.diagnostics[:-1]
                if progress is not None:
                    progress(len(held), round(seconds))
        wait_for_the_last(run, collector.wait_for)
        waiting = len(swapper.asked) - len(swapper.answers)
        collector.wait_for(lambda: len(swapper.answers) == len(swapper.asked), waiting * TIME_LIMIT_S)
    _judge(run, drive, done)
    if not spoilt:  # else a stamp does not say which message was answered
        _time(run, swapper.asked, done)
    settled = held[round(_SETTLED) :] or held
    rss, files = zip(*settled, strict=True)
    done.rss_mb, done.open_files = (rss[0], max(rss), rss[-1]), (files[0], max(files), files[-1])
    done.swaps = sum(answer.successful for answer in swapper.answers)
    if refused := [answer.reason for answer in swapper.answers if not answer.successful]:
        done.violations["a swap was refused"] = refused[0]
    if unanswered := len(swapper.asked) - len(swapper.answers):
        done.violations["swaps without an answer"] = str(unanswered)
    if done.lost and not spoilt:
        done.violations["good messages without a prediction"] = f"{done.lost}, the first at {run.missing()[0]} ns"
    return done


def ticks(begin: float, period: float, seconds: float) -> Iterator[float]:
    """Yields the time when each period begins; one that was held up for long is not caught up with in a burst."""
    due = begin
    while (now := time.monotonic()) < begin + seconds:
        if now < due:
            time.sleep(due - now)
            now = due
        yield now
        due = max(due + period, now - period)


def _holds(pid: int) -> tuple[float, int]:
    """Resident memory (MB) and open files of a process."""
    pages = int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / _MB, len(os.listdir(f"/proc/{pid}/fd"))


def _judge(run: LiveRun, drive: Drive, done: Soaked) -> None:
    done.predictions = sum(stamp - run.T_s in run.sent for stamp in run.predicted)
    done.lost = run.lost
    done.passed_over = len(run.missing()) - done.lost
    for stamp, state in run.predicted.items():
        if not all(map(math.isfinite, state)):
            done.violations.setdefault("an output is not finite", f"{state} at {stamp} ns")
        if words := drive.invalid.get(stamp - run.T_s):
            done.violations.setdefault("predicted from an invalid sample", f"{words} at {stamp - run.T_s} ns")


def _time(run: LiveRun, swaps: Sequence[float], done: Soaked) -> None:
    answered = [(run.sent[stamp - run.T_s], at) for stamp, at in run.received.items() if stamp - run.T_s in run.sent]
    sent, received = np.array(sorted(answered)).T
    latency = 1e3 * (received - sent)
    done.latency_ms = {f"p{share:g}": float(np.percentile(latency, share)) for share in (50, 99, 99.9, 100)}
    done.late = int((latency > run.T_s / 1e6).sum())
    done.longest_gap_ms = float(1e3 * np.diff(np.sort(received)).max(initial=0.0))
    at_swap = np.zeros(len(sent), dtype=bool)
    for asked in swaps:
        at_swap |= (sent >= asked - run.T_s / 1e9) & (sent < asked + _AFTER_SWAP)
    if at_swap.any() and not at_swap.all():
        done.slowest_at_swap_ms, done.slowest_else_ms = float(latency[at_swap].max()), float(latency[~at_swap].max())


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs it and says what came of it."""
    parser = argparse.ArgumentParser(prog="benchmarks.endurance.soak", description=__doc__)
    parser.add_argument("--model", type=Path, required=True, help="model folder")
    parser.add_argument("--minutes", type=float, default=60.0, help="how long")
    parser.add_argument("--rate", type=float, default=100.0, help="of the odometry (Hz)")
    parser.add_argument("--spoilt", type=float, default=0.0, help="share of messages that are damaged")
    parser.add_argument("--swap", type=Path, action="append", default=[], help="another model folder; repeatable")
    parser.add_argument("--swap-every", type=float, default=5.0, help="time between swaps (s)")
    parser.add_argument("--seed", type=int, default=0, help="what the messages are")
    parser.add_argument("--json", type=Path, help="also write the result as JSON")
    given = parser.parse_args(arguments)
    models = [given.model, *given.swap]
    try:
        with progress_bar("driving") as progress:
            done = soak(models, 60 * given.minutes, given.rate, given.seed, given.spoilt, given.swap_every, progress)
    except UserError as error:
        sys.exit(f"error: {error}")
    for name, value in asdict(done).items():
        console.print(f"{name}: {value}", markup=False, highlight=False)
    if given.json is not None:
        write_json(given.json, asdict(done))
    sys.exit(1 if done.violations else 0)


if __name__ == "__main__":
    main()
