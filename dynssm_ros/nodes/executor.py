"""Where the callbacks of a node run: an exception in one is counted and logged, and the node goes on.

Whoever asked a service whose callback fails is answered that it did not succeed.
"""

from __future__ import annotations

import threading
import time
import traceback
from collections.abc import Awaitable, Callable, Mapping
from functools import partial
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

from rcl_interfaces.msg import Parameter, SetParametersResult
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor, await_or_execute
from rclpy.node import Node
from rclpy.task import Future

from dynssm_ros.errors import UserError
from dynssm_ros.runtime.health import Level

_Result = TypeVar("_Result")
_RECENT_S = 10.0  # for which the verdict speaks of an exception


class FinishedError(UserError):
    """A node cannot go on by its own judgement: raised in a callback, it ends the node."""


class Failures:
    """Exceptions in the callbacks of a node.

    Attributes:
        count: how many.
        last: the last one, in one line.
    """

    def __init__(self) -> None:
        self.count = 0
        self.last = ""
        self._newest = -float("inf")
        self._kinds: set[tuple[type, str]] = set()

    def add(self, node: Node, error: Exception, asked: str = "") -> None:
        """Counts an exception; the first of its type and place in the code is logged.

        Args:
            node: that logs it.
            error: that was caught.
            asked: name of the service whose caller is told; empty if nobody asked.
        """
        frames = traceback.extract_tb(error.__traceback__)
        place = f"{frames[-1].filename.rpartition('/')[2]}:{frames[-1].lineno}" if frames else ""
        self.count += 1
        self.last = " ".join(f"{type(error).__name__}: {error}"[:300].split()) + (f" ({place})" if place else "")
        self._newest = time.monotonic()
        if (kind := (type(error), place)) not in self._kinds:
            self._kinds.add(kind)
            told = bool(asked) or isinstance(error, UserError)
            words = self.last if told else "".join(traceback.format_exception(error))
            node.get_logger().error(f"{asked}: refused: {words}" if asked else f"goes on after an exception: {words}")

    def told(self, level: int, words: str, values: Mapping[str, str]) -> tuple[int, str, dict[str, str]]:
        """A verdict and its figures with what failed."""
        if time.monotonic() - self._newest < _RECENT_S:
            level, words = max(level, Level.WARN), f"{words}; goes on after an exception: {self.last}"
        return level, words, {**values, "exceptions": str(self.count), "last exception": self.last}


_FAILURES: WeakKeyDictionary[Node, Failures] = WeakKeyDictionary()


def failures(node: Node) -> Failures:
    """What failed in a node so far."""
    return _FAILURES.setdefault(node, Failures())


class EnduringExecutor(SingleThreadedExecutor):
    """Serves one node, whatever its callbacks raise.

    Args:
        node: with all its services.
    """

    def __init__(self, node: Node) -> None:
        super().__init__(context=node.context)
        self._node = node
        self.add_node(node)
        for service in node.services:
            answer: Any = partial(self._answer, service.srv_name, service.callback)  # rclpy awaits it
            service.callback = answer

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Serves what is ready.

        Raises:
            ExternalShutdownException: rclpy was shut down.
            FinishedError: of a callback.
        """
        try:
            super().spin_once(timeout_sec)
        except (ExternalShutdownException, FinishedError):
            raise
        except Exception as error:
            if not self.context.ok():
                raise
            failures(self._node).add(self._node, error)

    async def _answer(self, name: str, callback: Callable[..., Any], request: Any, response: Any) -> Any:
        try:
            return await await_or_execute(callback, request, response)
        except Exception as error:
            failures(self._node).add(self._node, error, name)
            return refused(request, type(response)(), failures(self._node).last)


def refused(request: Any, response: Any, reason: str) -> Any:
    """The ``response`` to a ``request`` that failed: without success, with the reason where there is a place for it."""
    refusal = SetParametersResult(successful=False, reason=reason)
    if isinstance(response, SetParameters.Response):
        response.results = [refusal] * len(request.parameters)
    elif isinstance(response, SetParametersAtomically.Response):
        response.result = refusal
    return response


def let_wait(node: Node, prepare: Callable[[list[Parameter]], Awaitable[None]]) -> None:
    """Lets requests for parameters of ``node`` wait for ``prepare``, while all else of the node goes on.

    Args:
        node: whose parameters are set.
        prepare: takes the parameters that are asked for.
    """
    alone = MutuallyExclusiveCallbackGroup()

    async def prepared(callback: Callable[..., Any], request: Any, response: Any) -> Any:
        await prepare(request.parameters)
        return callback(request, response)

    for service in node.services:
        if service.srv_type in (SetParameters, SetParametersAtomically):
            callback: Any = partial(prepared, service.callback)  # rclpy awaits it
            service.callback, service.callback_group = callback, alone
            alone.add_entity(service)


async def in_thread(node: Node, work: Callable[[], _Result]) -> _Result:
    """What ``work`` returns in a thread of its own, while the executor of ``node`` serves others."""
    future: Future = Future()

    def act() -> None:
        try:
            future.set_result(work())
        except Exception as error:
            future.set_exception(error)
        if (executor := node.executor) is not None:
            executor.wake()

    threading.Thread(target=act, daemon=True).start()
    result: _Result = await future
    return result
