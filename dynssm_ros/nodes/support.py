"""What the nodes share: message classes by name, quality of service, parameter declaration, a clean main."""

from __future__ import annotations

import gc
import importlib
import math
import re
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from copy import copy
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException
from rclpy.logging import LoggingSeverity, set_logger_level
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription
from sensor_msgs.msg import JointState

from dynssm_ros.configuration import config_root
from dynssm_ros.errors import ConfigurationError, UserError
from dynssm_ros.extras import load_plugins
from dynssm_ros.nodes.executor import EnduringExecutor, failures, take
from dynssm_ros.vehicle import Applied
from dynssm_ros.vehicle.single_track import SetPoint

NodeType = TypeVar("NodeType", bound=Node)

_AWAKE = 1.0  # s after which a spinning node looks whether it is to end

_KEPT = 1000  # messages of a topic: a pause of the process (a model swap, a busy core) loses nothing; 10 s at 100 Hz

SENSOR_QOS = QoSProfile(reliability=ReliabilityPolicy.BEST_EFFORT, history=HistoryPolicy.KEEP_LAST, depth=_KEPT)
# for a controller: one that was held up goes on from the newest odometry
NEWEST_QOS = QoSProfile(reliability=ReliabilityPolicy.BEST_EFFORT, history=HistoryPolicy.KEEP_LAST, depth=1)
_RELIABLE_QOS = QoSProfile(reliability=ReliabilityPolicy.RELIABLE, history=HistoryPolicy.KEEP_LAST, depth=_KEPT)


def output(node: Node, msgtype: Any, topic: str) -> Publisher:
    """Publishes in the node's namespace, reliably unless ``qos_overrides`` say otherwise.

    Who asks for best effort gets that.
    """
    return node.create_publisher(
        msgtype,
        relative(topic),
        copy(_RELIABLE_QOS),  # rclpy writes the overrides into it
        qos_overriding_options=QoSOverridingOptions.with_default_policies(),
    )


def listen(
    node: Node, msgtype: Any, topic: str, callback: Callable[..., None], qos: QoSProfile = SENSOR_QOS
) -> Subscription:
    """Subscribes with ``qos`` unless ``qos_overrides`` say otherwise: best effort takes what any sensor publishes.

    Reliable, it takes what reliable publishers send alone, and loses nothing of that while it is held up. A ``callback``
    that takes two arguments is given the message's times as well.
    """
    return node.create_subscription(
        msgtype, topic, callback, copy(qos), qos_overriding_options=QoSOverridingOptions.with_default_policies()
    )


def waiting(subscription: Subscription) -> Iterator[tuple[Any, Mapping[str, int]]]:
    """Takes the messages that wait, oldest first, with their times."""
    while (taken := take(subscription)) is not None:
        yield taken


def waited(times: Mapping[str, int]) -> float:
    """How long ago a message with these ``times`` arrived in this process (s)."""
    return max(0.0, (time.time_ns() - times["received_timestamp"]) / 1e9)


def repeat(node: Node, period: float, work: Callable[[], None]) -> None:
    """Calls ``work`` every ``period`` seconds, of a clock that simulated time does not stop.

    They are counted from the end of the call before. One that takes longer than a period would be due again at once, and
    of the messages that wait the executor serves one from each topic between two timers.
    """

    def due() -> None:
        work()
        timer.reset()

    timer = node.create_timer(period, due, clock=Clock(clock_type=ClockType.STEADY_TIME))


def message_class(msgtype: str) -> Any:
    """The Python class of ``package/msg/Name``.

    Raises:
        ConfigurationError: the message package is not installed.
    """
    package, _, name = msgtype.split("/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError) as error:
        raise ConfigurationError(
            f"message type {msgtype} is not installed here; source the workspace that builds {package}, or convert the bag "
            "to the standard topics with `dynssm extract ... --bag`"
        ) from error


def relative(topic: str) -> str:
    """A topic of a bag as a node names it: in the node's namespace, which is the same name without one."""
    return topic.removeprefix("/")


def describe(
    node: Node,
    name: str,
    default: Any,
    description: str,
    bounds: tuple[float, float] | None = None,
    *,
    read_only: bool = False,
) -> Any:
    """Declares a described, typed, bounded parameter and returns its value; ``~/`` in front of a path is the home."""
    ranges = [FloatingPointRange(from_value=bounds[0], to_value=bounds[1])] if bounds else []
    descriptor = ParameterDescriptor(description=description, floating_point_range=ranges, read_only=read_only)
    return expanded(node.declare_parameter(name, default, descriptor).value)


def expanded(value: Any) -> Any:
    """A parameter's value with the home directory for ``~/`` in front of a path."""
    return str(Path(value).expanduser()) if isinstance(value, str) and value.startswith("~/") else value


def choose(node: Node, name: str, default: str, allowed: tuple[str, ...], description: str) -> Any:
    """Declares a read-only parameter that is one of a few words, and returns it.

    Raises:
        ConfigurationError: it is none of them.
    """
    value = describe(node, name, default, f"{description} One of: {', '.join(allowed)}.", read_only=True)
    if value not in allowed:
        raise ConfigurationError(f"parameter {name}: '{value}'; expected {' or '.join(allowed)}")
    return value


def actuators(stamp: int, applied: Applied, set_point: SetPoint = "throttle") -> JointState:
    """Throttle or speed set-point, and steering, as a message with ``stamp`` (ns)."""
    message = JointState(name=[set_point, "steering"], position=[float(applied.r), float(applied.delta)])
    set_stamp(message.header, stamp)
    return message


def diagnostics(
    node: Node, part: str, hardware: str, *, level: int, words: str, values: Mapping[str, str]
) -> DiagnosticArray:
    """What ``node`` says of its ``part`` and of exceptions in its callbacks, stamped now."""
    level, words, values = failures(node).told(level, words, values)
    status = DiagnosticStatus(
        level=bytes([level]),
        name=f"{node.get_fully_qualified_name()}: {part}",
        message=words,
        hardware_id=hardware,
        values=[KeyValue(key=key, value=value) for key, value in values.items()],
    )
    array = DiagnosticArray(status=[status])
    array.header.stamp = node.get_clock().now().to_msg()
    return array


def set_stamp(header: Any, stamp: int) -> None:
    """Writes ``stamp`` (ns) into a message header."""
    header.stamp.sec, header.stamp.nanosec = divmod(stamp, 1_000_000_000)


def set_pose(pose: Any, x: float, y: float, theta: float) -> None:
    """Writes a planar pose (m, m, rad) into a pose message."""
    pose.position.x, pose.position.y = x, y
    pose.orientation.z, pose.orientation.w = math.sin(theta / 2), math.cos(theta / 2)


def spin(node: Node) -> None:
    """Serves a node's callbacks until rclpy is shut down.

    On SIGTERM, rclpy wakes the executor and shuts its context down in another thread. An executor that is quicker finds the
    context as it was and waits again; a node that nothing else wakes would then wait for ever (4 of 240 idle nodes). So
    something wakes it every second, on a clock that simulated time does not stop.

    What is there before the spinning begins stays, so the garbage collector need not search through it again. With the
    search, the slowest answer at a swap of models took 23 ms, without it 13 ms.
    """
    gc.collect()
    gc.freeze()
    node.create_timer(_AWAKE, lambda: None, clock=Clock(clock_type=ClockType.STEADY_TIME))
    EnduringExecutor(node).spin()


def run(
    make_node: Callable[[], NodeType], args: list[str] | None = None, work: Callable[[NodeType], None] = spin
) -> None:
    """Starts rclpy, lets a node ``work`` until it is done or interrupted, and ends cleanly.

    A user error becomes one line and exit status 1. ``--help`` prints what the node is and its parameters.
    """
    if {"-h", "--help"} & set(sys.argv[1:] if args is None else args):
        print(_help(sys.modules[make_node.__module__]))
        return
    interrupt = signal.signal(signal.SIGINT, _leave_it_to_rclpy)
    node: NodeType | None = None
    try:
        _start_rclpy(args)
        load_plugins()
        node = make_node()
        work(node)
    except (UserError, ParameterException) as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(1)
    except ExternalShutdownException:
        return
    except RuntimeError:  # what was interrupted in the middle of its work finds rclpy shut down
        if rclpy.ok():
            raise
    finally:
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
        signal.signal(signal.SIGINT, interrupt)


def _start_rclpy(args: list[str] | None) -> None:
    """Starts rclpy; the places of its own code that it names are left out.

    Raises:
        ConfigurationError: ROS arguments that it cannot read: a log level, a parameters file, a remapping.
    """
    set_logger_level("rcl", LoggingSeverity.FATAL)  # it would say the same in a line of its own
    try:
        rclpy.init(args=args)
        set_logger_level("rcl", LoggingSeverity.UNSET)
    except RuntimeError as error:
        words = re.sub(r", at \S+:\d+", "", str(error)).removeprefix("failed to initialize rcl: ")
        raise ConfigurationError(f"ROS arguments: {words}") from error


def _help(module: ModuleType) -> str:
    """The docstring of a node's module, and its parameters as its shipped file explains them."""
    file = config_root() / f"{Path(module.__file__ or '').stem}.yaml"
    return f"{(module.__doc__ or '').strip()}\n\nParameters, as in {file}:\n\n{file.read_text(encoding='utf-8')}"


def _leave_it_to_rclpy(*_: object) -> None:
    """On SIGINT: nothing, as rclpy's own handler shuts its context down, and then the spinning ends.

    A KeyboardInterrupt would come in the midst of a callback, and it would destroy the executor while rclpy's handler
    still uses it (a segmentation fault in 1 of 5 interrupts of a busy node).
    """
