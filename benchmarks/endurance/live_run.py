"""A live run end to end: the predictor in its own process, a bag played to it through DDS, its answers collected.

The demo, the benchmark and the tests use it. Times are ``time.monotonic()`` of one process, so that the latency from
odometry published to prediction received needs no clock synchronisation.
"""

from __future__ import annotations

import os
import random
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState

from dynssm_ros.errors import UserError
from dynssm_ros.nodes.player import MATCH_TIMEOUT, Playback
from dynssm_ros.signals.decoding import header_stamp_ns
from dynssm_ros.signals.messages import ODOMETRY_TOPIC, PARAMETERS_TOPIC, PREDICTION_TOPIC

# reliable: a message that a process was sending when it was stopped is sent again
_EVERYTHING = QoSProfile(depth=1000)
_END_TIMEOUT = 10.0  # s
_CRASHES = (signal.SIGSEGV, signal.SIGABRT, signal.SIGBUS, signal.SIGFPE, signal.SIGILL)
_TOLD = 5.0  # s until the next diagnostics, at most
_DRAIN = 2.0  # s without an answer after the last message before the run counts as over
_PARTICIPANTS = 20  # of a test's domain, at most
_SHARED_MEMORY = Path("/dev/shm")  # noqa: S108, which is Fast DDS's choice
PROFILES = "FASTRTPS_DEFAULT_PROFILES_FILE"  # environment variable that a process reads once


@dataclass
class LiveRun:
    """What went in and what came out."""

    T_s: int  # from input stamp to predicted stamp (ns)
    sent: dict[int, float] = field(default_factory=dict)
    """Time at which each odometry message was published, by its stamp (ns)."""
    predicted: dict[int, tuple[float, float, float]] = field(default_factory=dict)
    """Predicted ``[v_x, v_y, omega]`` by the stamp of the predicted instant (ns)."""
    received: dict[int, float] = field(default_factory=dict)  # time at which that prediction arrived
    parameters: dict[int, list[float]] = field(default_factory=dict)  # adapted coefficients by the same stamp
    diagnostics: list[tuple[int, str, dict[str, str]]] = field(default_factory=list)
    """Level, message and values of each status, in order."""

    @property
    def latencies(self) -> npt.NDArray[np.float64]:
        """Odometry published to prediction received (s), in the order of the predictions."""
        return np.array(
            [self.received[s] - self.sent[s - self.T_s] for s in sorted(self.received) if s - self.T_s in self.sent]
        )

    def missing(self) -> list[int]:
        """Stamps of odometry messages after the first prediction that got none (ns)."""
        if not self.predicted:
            return sorted(self.sent)
        first = min(self.predicted) - self.T_s
        return sorted(stamp for stamp in self.sent if stamp >= first and stamp + self.T_s not in self.predicted)

    @property
    def passed_over(self) -> int:
        """Odometry that the predictor says it did not answer as newer one waited."""
        return int(self.diagnostics[-1][2].get("refused: skipped", 0)) if self.diagnostics else 0

    @property
    def lost(self) -> int:
        """Odometry messages after the first prediction that got none and were not passed over."""
        return max(0, len(self.missing()) - self.passed_over)


class Collector(Node):
    """Keeps everything that the predictor publishes."""

    def __init__(self, run: LiveRun, context: Context) -> None:
        super().__init__("collector", context=context)
        self._run = run
        self.create_subscription(Odometry, PREDICTION_TOPIC, self._on_prediction, _EVERYTHING)
        self.create_subscription(JointState, PARAMETERS_TOPIC, self._on_parameters, _EVERYTHING)
        self.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
        self.changed = threading.Condition()

    def _on_prediction(self, message: Odometry) -> None:
        now = time.monotonic()
        stamp = header_stamp_ns(message)
        assert stamp is not None
        twist = message.twist.twist
        with self.changed:
            self._run.received[stamp] = now
            self._run.predicted[stamp] = (twist.linear.x, twist.linear.y, twist.angular.z)
            self.changed.notify_all()

    def _on_parameters(self, message: JointState) -> None:
        stamp = header_stamp_ns(message)
        assert stamp is not None
        self._run.parameters[stamp] = list(message.position)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        with self.changed:
            for status in message.status:
                values = {pair.key: pair.value for pair in status.values}
                self._run.diagnostics.append((status.level[0], status.message, values))
            self.changed.notify_all()

    def wait_for(self, condition: Callable[[], bool], timeout: float) -> bool:
        """Waits until ``condition`` holds after some message; returns whether it came true within ``timeout`` s."""
        with self.changed:
            return self.changed.wait_for(condition, timeout)


_RESERVED: deque[socket.socket] = deque(maxlen=20)
"""What keeps other runs on this host out of the domains of the last runs of this process."""


def isolated_environment() -> dict[str, str]:
    """The environment with a ROS domain of its own on this host, so that parallel runs do not hear each other.

    With a file of Fast DDS profiles the transports are the file's; ``LOCALHOST`` would add those that there are without it.
    """
    domains = random.SystemRandom().sample(range(1, 101), 100)
    domain = next(filter(_reserve, domains), domains[0])
    reach = "SUBNET" if PROFILES in os.environ else "LOCALHOST"
    return os.environ | {"ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": reach}


def _reserve(domain: int) -> bool:
    """Takes ``domain`` if nobody else takes part in it, nor has reserved it.

    Its participants hold every other port from the tenth of the domain's 250 on (DDSI-RTPS); the last one, which none of
    them uses, says that it is reserved, also while no participant is there yet. What killed participants have left in
    shared memory is removed: messages to the next ones would be lost until Fast DDS finds out that nobody reads there.
    """
    ports = 7400 + 250 * domain
    try:
        for participant in range(_PARTICIPANTS):
            _bound(ports + 10 + 2 * participant).close()
        reserved = _bound(ports + 249)
    except OSError:
        return False
    for left in _SHARED_MEMORY.glob("*fastrtps_port*"):
        if (port := re.search(r"port(\d+)", left.name)) and int(port[1]) in range(ports, ports + 250):
            left.unlink(missing_ok=True)
    if len(_RESERVED) == _RESERVED.maxlen:
        _RESERVED.popleft().close()
    _RESERVED.append(reserved)
    return True


def _bound(port: int) -> socket.socket:
    """A socket that holds a UDP port of this host.

    Raises:
        OSError: somebody has it.
    """
    holder = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        holder.bind(("", port))
    except OSError:
        holder.close()
        raise
    return holder


@contextmanager
def node_process(
    node: str,
    parameters: Mapping[str, object] | None = None,
    environment: Mapping[str, str] | None = None,
    namespace: str = "",
    remapped: Mapping[str, str] | None = None,
) -> Iterator[subprocess.Popen[str]]:
    """Starts a node of this package (``predictor``, ``simulator``, ``controller``) with ROS parameters and ``remapped``
    topics as a process of its own; interrupts it in the end.

    Raises:
        UserError: it crashed, or it did not end when it was interrupted.
    """
    arguments = [part for name, value in (parameters or {}).items() for part in ("-p", f"{name}:={value}")]
    arguments += ["-r", f"__ns:=/{namespace}"] if namespace else []
    arguments += [part for name, other in (remapped or {}).items() for part in ("-r", f"{name}:={other}")]
    command = [sys.executable, "-m", f"dynssm_ros.nodes.{node}", *(["--ros-args", *arguments] if arguments else [])]
    process = subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)  # noqa: S603 - own module
    try:
        yield process
    finally:
        process.send_signal(signal.SIGINT)
        try:
            _, words = process.communicate(timeout=_END_TIMEOUT)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
            raise UserError(f"the {node} did not end within {_END_TIMEOUT:g} s of an interrupt") from None
    if -process.returncode in _CRASHES:
        raise UserError(f"the {node} crashed with {signal.Signals(-process.returncode).name}: {words.strip()}")


def check_running(node: str, process: subprocess.Popen[str]) -> None:
    """Makes sure that a node of :func:`node_process` has not ended.

    Raises:
        UserError: it has; carries its own words.
    """
    if process.poll() is not None:
        assert process.stderr is not None
        raise UserError(f"the {node} stopped: {process.stderr.read().strip() or 'no message'}")


def predictor_process(
    model: Path,
    parameters: Mapping[str, object] | None = None,
    environment: Mapping[str, str] | None = None,
    namespace: str = "",
) -> AbstractContextManager[subprocess.Popen[str]]:
    """Starts the predictor with a model folder; see :func:`node_process`."""
    return node_process("predictor", {"model": model, **(parameters or {})}, environment, namespace)


@contextmanager
def collecting(run: LiveRun) -> Iterator[Collector]:
    """A collector that is served by a thread of its own for as long as the context lasts."""
    context = Context()
    rclpy.init(context=context)
    collector = Collector(run, context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(collector)
    thread = threading.Thread(target=executor.spin, daemon=True)
    thread.start()
    try:
        yield collector
    finally:
        executor.shutdown()
        thread.join(5.0)
        collector.destroy_node()
        rclpy.try_shutdown(context=context)


def run_live(
    model: Path,
    bag: Path,
    T_s: float,
    rate: float = 1.0,
    duration: float = float("inf"),
    odometry_topic: str = ODOMETRY_TOPIC,
    parameters: Mapping[str, object] | None = None,
    progress: Callable[[int, int], None] | None = None,
    held_up: tuple[float, float] | None = None,
    in_step: bool = False,
) -> LiveRun:
    """Starts the predictor, plays ``bag`` to it in real time and collects its answers.

    Args:
        model: model folder.
        bag: with the topics that the predictor listens to, in installed message types.
        T_s: sampling time of the model (s).
        rate: speed factor.
        duration: of the recording that is played (s).
        odometry_topic: whose messages are answered.
        parameters: further ROS parameters of the predictor.
        progress: told of seconds played and to be played.
        held_up: from when to when in the recording the predictor is stopped, as if it got no computing time (s).
        in_step: whether what follows odometry waits for its answer, from the first prediction on.

    Raises:
        UserError: the predictor does not start; carries its own words.
    """
    os.environ.update(isolated_environment())
    run = LiveRun(round(T_s * 1e9))
    with predictor_process(model, parameters, os.environ.copy()) as process, collecting(run) as collector:
        playback = Playback(collector, bag)
        deadline = time.monotonic() + 3 * MATCH_TIMEOUT
        while playback.wait_for_listeners(time.sleep, timeout=0.2):
            check_running("predictor", process)
            if time.monotonic() > deadline:
                raise UserError("the predictor did not subscribe to the bag's topics within 30 s")
        # a match has two sides: who listens tells what it has found, and its own publishers are to be found too
        if not collector.wait_for(lambda: _finds(run.diagnostics, playback.topics), MATCH_TIMEOUT):
            raise UserError(f"the predictor did not find the bag's topics within {MATCH_TIMEOUT:g} s")
        collector.wait_for(lambda: collector.count_publishers(PREDICTION_TOPIC) > 0, MATCH_TIMEOUT)
        first: int | None = None
        signals = deque(zip(held_up or (), (signal.SIGSTOP, signal.SIGCONT), strict=False))
        for message, sent in playback.play(rate, duration):
            if message.topic == odometry_topic:
                stamp = _stamp_of(message.raw)
                run.sent[stamp] = sent
                first = first or message.log_time
                while signals and message.log_time - first > signals[0][0] * 1e9:
                    process.send_signal(signals.popleft()[1])
                if progress is not None and len(run.sent) % 25 == 0:
                    progress(round((message.log_time - first) / 1e9), round(min(duration, 1e6)))
                if in_step and run.predicted:
                    collector.wait_for(partial(run.predicted.__contains__, stamp + run.T_s), _DRAIN)
        wait_for_the_last(run, collector.wait_for)
    return run


def _finds(diagnostics: list[tuple[int, str, dict[str, str]]], topics: tuple[str, ...]) -> bool:
    """Whether the predictor's last diagnostics count a publisher of each of ``topics`` that it listens to."""
    values = diagnostics[-1][2] if diagnostics else {}
    counts = [values.get(f"{topic} publishers") for topic in topics]
    return any(counts) and "0" not in counts


def wait_for_the_last(run: LiveRun, wait_for: Callable[[Callable[[], bool], float], bool]) -> None:
    """Waits until the last message is answered, or nothing is for a while: a predictor that was held up has a queue.

    Then it waits for the next diagnostics, which tell what was passed over. ``wait_for``: as :meth:`Collector.wait_for`.
    """
    last, answered = max(run.sent, default=0) + run.T_s, -1
    while last not in run.predicted and len(run.predicted) > answered:
        answered = len(run.predicted)
        wait_for(lambda: last in run.predicted, _DRAIN)
    told = len(run.diagnostics)
    wait_for(lambda: len(run.diagnostics) > told, _TOLD)


def _stamp_of(raw: bytes) -> int:
    """Header stamp (ns) at the head of a serialised stamped message: CDR header, int32 s, uint32 ns."""
    seconds, nanoseconds = np.frombuffer(raw, dtype="<u4", count=2, offset=4)
    return int(seconds) * 1_000_000_000 + int(nanoseconds)
