"""Nodes with ROS's managed life cycle: ``configure`` prepares them, ``activate`` lets them publish.

Who says nothing gets a node that does both by itself as it starts. With ``autostart:=false`` a manager of life cycles,
or ``ros2 lifecycle set``, says when.
"""

from __future__ import annotations

import traceback
from typing import Any

from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn

from dynssm_ros.errors import UserError
from dynssm_ros.nodes.support import describe

_DONE, _REFUSED = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE


class ManagedNode(LifecycleNode):
    """A node whose work begins with :meth:`prepare` and which publishes while it is ``active``.

    Attributes:
        active: whether it publishes.
        prepared: whether it is configured.

    Args:
        name: of the node.
        options: as of :class:`rclpy.node.Node`.
    """

    def __init__(self, name: str, **options: Any) -> None:
        super().__init__(name, **options)
        self.active = False
        self.prepared = False
        self._autostart: bool = describe(
            self, "autostart", True, "Whether the node configures and activates itself.", read_only=True
        )
        self._refusal: Exception | None = None
        self._before: set[Any] = set()

    def prepare(self) -> None:
        """Loads what the node works with and makes its publishers, subscriptions and timers.

        Raises:
            UserError: it cannot work so; the node stays unconfigured.
        """
        raise NotImplementedError

    def keep(self) -> None:
        """Saves what is to outlast the node, before it forgets what it prepared."""

    def start(self) -> None:
        """Configures and activates the node if it starts by itself.

        Raises:
            UserError: what :meth:`prepare` raised.
        """
        if self._autostart:
            self.trigger_configure()
            if self._refusal is not None:
                raise self._refusal
            self.trigger_activate()

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Prepares; what hinders it is logged, as rclpy itself drops exceptions of transitions."""
        self._before, self._refusal = set(self._entities()), None
        try:
            self.prepare()
        except Exception as error:
            self._refusal = error
            self._forget()
            if not self._autostart:
                self.get_logger().error(str(error) if isinstance(error, UserError) else traceback.format_exc())
            return _REFUSED
        self.prepared = True
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """From now on the node publishes."""
        self.active = True
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """From now on it publishes nothing but its diagnostics."""
        self.active = False
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Forgets what was prepared."""
        if self.prepared:
            self.keep()
        self._forget()
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """As a clean-up, and for good."""
        self.active = False
        self.on_cleanup(state)
        return _DONE

    def destroy_node(self) -> None:
        """Saves what is to outlast the node before it ends."""
        if self.prepared:
            self.keep()
        super().destroy_node()

    def _entities(self) -> list[Any]:
        return [*self.publishers, *self.subscriptions, *self.timers]

    def _forget(self) -> None:
        """Destroys the publishers, subscriptions and timers that were made since the node began to prepare."""
        self.prepared = False
        ways: tuple[tuple[Any, Any], ...] = (
            (self.timers, self.destroy_timer),
            (self.subscriptions, self.destroy_subscription),
            (self.publishers, self.destroy_publisher),
        )
        for made, destroy in ways:
            for entity in [entity for entity in made if entity not in self._before]:
                destroy(entity)
