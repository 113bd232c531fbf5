"""Whether another node publishes what this one does: two controllers of one car, a joystick that was left on."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.subscription import Subscription

from dynssm_ros.nodes.support import SENSOR_QOS, output
from dynssm_ros.signals.decoding import header_stamp_ns

_REMEMBERED = 1000  # stamps of own messages


class WatchedOutput:
    """A topic that a node publishes, and that it hears itself while there are other publishers of it.

    A publisher that is counted may be a stand-by, or dead for 20 s. So others are named that are heard.

    Args:
        node: that publishes.
        msgtype: class of the messages; they have a header.
        topic: in the node's namespace.
        on_rival: called when another node's message is heard.
    """

    def __init__(self, node: Node, msgtype: Any, topic: str, on_rival: Callable[[], None] = lambda: None) -> None:
        self._node, self._msgtype = node, msgtype
        self._publisher = output(node, msgtype, topic)
        self._subscription: Subscription | None = None
        self._sent: Counter[int] = Counter()
        self._foreign = 0
        self._on_rival = on_rival

    @property
    def topic(self) -> str:
        """Its full name."""
        return self._publisher.topic_name

    def publish(self, message: Any) -> None:
        """Publishes a message."""
        if self._subscription is not None:
            self._sent[header_stamp_ns(message) or 0] += 1
        self._publisher.publish(message)

    def look(self) -> None:
        """Listens while there are other publishers."""
        topic = self.topic
        shared = self._node.count_publishers(topic) > 1
        if shared and self._subscription is None:
            self._sent.clear()
            self._subscription = self._node.create_subscription(self._msgtype, topic, self._hear, SENSOR_QOS)
        elif not shared and self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
            self._subscription = None
        for stamp in sorted(self._sent)[:-_REMEMBERED]:
            del self._sent[stamp]

    def rival(self) -> str:
        """Looks; who else was heard since the last time, in words, empty if nobody was."""
        self.look()
        topic, foreign, self._foreign = self.topic, self._foreign, 0
        if not foreign:
            return ""
        infos = self._node.get_publishers_info_by_topic(topic)
        names = [f"{info.node_namespace.rstrip('/')}/{info.node_name}" for info in infos]
        if (own := self._node.get_fully_qualified_name()) in names:
            names.remove(own)
        return f"another node publishes on {topic}: {', '.join(sorted(names)) or 'gone'}"

    def _hear(self, message: Any) -> None:
        stamp = header_stamp_ns(message) or 0
        if self._sent[stamp] > 0:
            self._sent[stamp] -= 1
        else:
            self._foreign += 1
            self._on_rival()
