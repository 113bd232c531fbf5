"""Plays a bag on DDS in real time: ``ros2 run dynssm_ros player --ros-args -p bag:=BAG -p rate:=1.0``.

Messages go out as they were recorded, byte for byte, in their recorded order and rhythm. Before the first one it waits
until somebody listens, because DDS matching takes a moment and messages sent before it are lost.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import rclpy
from builtin_interfaces.msg import Time
from rclpy.duration import Duration
from rclpy.node import Node
from rosgraph_msgs.msg import Clock

from dynssm_ros.errors import BagError
from dynssm_ros.nodes.executor import EnduringExecutor
from dynssm_ros.nodes.support import describe, message_class, output, run
from dynssm_ros.signals.bags import BagMessage, open_bag

MATCH_TIMEOUT = 10.0  # s
_SETTLE = 0.3  # s; the listener's side of a match comes a moment after ours
_LINGER = 1.0  # s after the last message; best-effort delivery tells no publisher when it is done
_UNACKNOWLEDGED = 10.0  # s that a reliable listener may take for the last messages
_SPIN_BELOW = 1e-3  # s; shorter waits are not worth a sleep
_LONGEST_SLEEP = 0.1  # s; after it, whether the context was shut down is looked at


class Playback:
    """Publishers for the topics of a bag, and their messages in time.

    Args:
        node: that publishes.
        bag: rosbag2 folder or file.
        topics: to publish; all of the bag if empty.
        clock: whether the time at which messages were recorded goes to ``/clock``.

    Raises:
        BagError: unreadable, or a topic is missing.
        ConfigurationError: a message type is not installed.
    """

    def __init__(self, node: Node, bag: str | Path, topics: tuple[str, ...] = (), clock: bool = False) -> None:
        self.bag = Path(bag)
        self._context = node.context
        with open_bag(bag) as opened:
            types = opened.types
        for topic in topics:
            if topic not in types:
                raise BagError(f"{bag}: topic {topic} is missing; the bag has {', '.join(sorted(types))}")
        self.topics = topics or tuple(types)
        self._publishers = {topic: output(node, message_class(types[topic]), topic) for topic in self.topics}
        self._tell_time = node.create_publisher(Clock, "/clock", 10).publish if clock else None

    def wait_for_listeners(self, spin: Callable[[float], None], timeout: float = MATCH_TIMEOUT) -> tuple[str, ...]:
        """Waits until every topic has a subscription.

        Args:
            spin: lets the middleware work for that many seconds.
            timeout: at most this long (s).

        Returns:
            The topics that still have none.
        """
        end = time.monotonic() + timeout
        while True:
            waiting = tuple(t for t, publisher in self._publishers.items() if publisher.get_subscription_count() == 0)
            if not waiting:
                spin(_SETTLE)
                return ()
            if time.monotonic() > end:
                return waiting
            spin(0.05)

    def play(
        self, rate: float = 1.0, duration: float = float("inf"), start: float = 0.0
    ) -> Iterator[tuple[BagMessage, float]]:
        """Publishes message after message at ``rate`` times real time, until rclpy is shut down.

        Args:
            rate: speed factor.
            duration: of the recording that is played (s).
            start: of the recording that is left out before (s).

        Yields:
            Each message, and ``time.monotonic()`` just before it was published.
        """
        with open_bag(self.bag) as opened:
            begin = first = None
            for message in opened.messages(self.topics):
                first = message.log_time if first is None else first
                elapsed = (message.log_time - first) * 1e-9 - start
                if elapsed < 0:
                    continue
                begin = time.monotonic() if begin is None else begin
                if elapsed > duration:
                    return
                self._wait_until(begin + elapsed / rate)
                if not self._context.ok():
                    return
                if self._tell_time is not None:
                    seconds, nanoseconds = divmod(message.log_time, 1_000_000_000)
                    self._tell_time(Clock(clock=Time(sec=seconds, nanosec=nanoseconds)))
                sent = time.monotonic()
                self._publishers[message.topic].publish(message.raw)
                yield message, sent

    @property
    def acknowledged(self) -> bool:
        """Whether all who listen reliably have all messages."""
        return all(publisher.wait_for_all_acked(Duration()) for publisher in self._publishers.values())

    def _wait_until(self, due: float) -> None:
        while self._context.ok() and (remaining := due - time.monotonic()) > _SPIN_BELOW:
            time.sleep(min(remaining, _LONGEST_SLEEP))


class PlayerNode(Node):
    """Parameters of the player as a ROS node."""

    def __init__(self, **options: Any) -> None:
        super().__init__("player", **options)
        bag = describe(self, "bag", "", "rosbag2 folder or file to play.", read_only=True)
        self.rate = describe(self, "rate", 1.0, "Speed factor.", (0.01, 100.0), read_only=True)
        self.loop = describe(self, "loop", False, "Begin again at the end.", read_only=True)
        self.start_offset = describe(
            self, "start_offset", 0.0, "What is left out at the start (s).", (0.0, 1e6), read_only=True
        )
        topics = describe(self, "topics", "", "Topics to play, apart by blanks; empty: all.", read_only=True)
        clock = describe(self, "clock", False, "Publish the time of the recording on /clock.", read_only=True)
        if not bag:
            raise BagError("parameter bag: not set; expected a rosbag2 folder, e.g. -p bag:=out/laps")
        self.playback = Playback(self, bag, tuple(topics.split()), clock)

    def play(self) -> None:
        """Plays the bag, once or in a loop, when somebody listens."""
        self._spin_once = EnduringExecutor(self).spin_once
        unheard = self.playback.wait_for_listeners(self._spin_once)
        if unheard:
            self.get_logger().warning(f"nobody listens to {', '.join(unheard)}")
        while True:
            for _ in self.playback.play(self.rate, start=self.start_offset):
                pass
            if not (self.loop and rclpy.ok()):
                self._linger()
                return

    def _linger(self) -> None:
        """Stays until listeners have taken the last messages: what this process shares with them goes when it ends."""
        begin = time.monotonic()
        while rclpy.ok() and (elapsed := time.monotonic() - begin) < _UNACKNOWLEDGED:
            if elapsed > _LINGER and self.playback.acknowledged:
                return
            self._spin_once(0.1)


def main(args: list[str] | None = None) -> None:
    """Plays until the end of the bag or an interrupt; a user error is one line and exit status 1."""
    run(PlayerNode, args, PlayerNode.play)


if __name__ == "__main__":
    main()
