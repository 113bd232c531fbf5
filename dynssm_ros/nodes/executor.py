"""Where the callbacks of a node run: an exception in one is counted and logged, and the node goes on.

Whoever asked a service whose callback fails is answered that it did not succeed.
"""

from __future__ import annotations

import threading
import time
import traceback
from collections.abc import Awaitable, Callable, Iterable, Mapping
from contextlib import ExitStack
from functools import partial
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

from rcl_interfaces.msg import Parameter, SetParametersResult
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.executors import (
    ExternalShutdownException,
    SingleThreadedExecutor,
    TimeoutException,
    await_or_execute,
    timeout_sec_to_nsec,
)
from rclpy.guard_condition import GuardCondition
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.subscription import Subscription
from rclpy.task import Future
from rclpy.timer import Timer

from dynssm_ros.errors import UserError
from dynssm_ros.runtime.health import Level

_Result = TypeVar("_Result")
_KINDS = ("subscription", "guard_condition", "timer", "client", "service")  # as a wait set counts them
_LOOK_S = 1.0  # after which rclpy looks for what is not in the kept wait set
_POLL_S = 0.02  # between looks at callbacks that wait for something
_RECENT_S = 10.0  # for which the verdict speaks of an exception


def take(subscription: Subscription) -> tuple[Any, Mapping[str, int]] | None:
    """Takes the oldest message that waits, with its times; ``None`` if none does."""
    with subscription.handle:
        taken: tuple[Any, Mapping[str, int]] | None = subscription.handle.take_message(
            subscription.msg_type, subscription.raw
        )
    return taken


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


class _KeptWaitSet:
    """What a node waits for, in one wait set that is kept from wait to wait.

    Args:
        node: whose entities they are, as they are now. Events of the middleware are not among them.
        guards: of its executor.
    """

    def __init__(self, node: Node, guards: Iterable[GuardCondition]) -> None:
        self._timers, self._subscriptions, self._guards = list(node.timers), list(node.subscriptions), list(node.guards)
        groups: list[list[Any]] = [
            self._subscriptions, [*guards, *self._guards], self._timers, list(node.clients), list(node.services)
        ]  # fmt: skip
        self._set = rclpy_implementation.WaitSet(*map(len, groups), 0, node.context.handle)
        self._in_use, self._add = ExitStack(), list[Callable[[], object]]()
        handles: list[Any] = [node.context.handle]
        for kind, entities in zip(_KINDS, groups, strict=True):
            for entity in entities:
                handles.append(entity.handle)
                self._add.append(partial(getattr(self._set, f"add_{kind}"), entity.handle))
        for handle in handles:
            self._in_use.enter_context(handle)

    def wait(self, nanoseconds: int) -> tuple[list[Timer], list[Subscription], bool]:
        """Timers that are due, subscriptions with a message, and whether anything else is to be done.

        Args:
            nanoseconds: how long at most; for ever if negative.
        """
        self._set.clear_entities()
        for add in self._add:
            add()
        self._set.wait(nanoseconds)
        messages, guards, timers, *asked = map(self._set.get_ready_entities, _KINDS)
        for guard in self._guards:  # the wait took its trigger; rclpy gives it back where this says so
            guard._executor_triggered |= guard.handle.pointer in guards
        return (
            [timer for timer in self._timers if timer.handle.pointer in timers],
            [subscription for subscription in self._subscriptions if subscription.handle.pointer in messages],
            bool(guards or any(asked)),
        )

    def close(self) -> None:
        """Lets entities be destroyed."""
        self._in_use.close()


class EnduringExecutor(SingleThreadedExecutor):
    """Serves one node, whatever its callbacks raise.

    Callbacks of timers and subscriptions, which are functions, are called straight from a wait set that is kept. rclpy makes
    a new one for each, and a second one after it, which takes longer than a prediction. All else is left to rclpy: what is
    in the wait set at once, events of the middleware within a second.

    Args:
        node: with all its services.
    """

    def __init__(self, node: Node) -> None:
        super().__init__(context=node.context)
        self._node = node
        self._kept: _KeptWaitSet | None = None
        self._looked = time.monotonic()
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
            self._serve(timeout_sec_to_nsec(timeout_sec))
        except (ExternalShutdownException, FinishedError):
            raise
        except Exception as error:
            if not self.context.ok():
                raise
            failures(self._node).add(self._node, error)

    def spin(self) -> None:
        """Serves until rclpy is shut down."""
        try:
            super().spin()
        finally:
            self._forget()

    def _serve(self, nanoseconds: int) -> None:
        if self._kept is None:
            self._kept = _KeptWaitSet(self._node, (self._guard, self._sigint_gc))
        unfinished = any(not task.done() for task, *_ in self._tasks)
        timers, subscriptions, others = self._kept.wait(int(1e9 * _POLL_S) if unfinished else nanoseconds)
        if not self.context.ok():
            raise ExternalShutdownException
        if others or time.monotonic() - self._looked > (_POLL_S if unfinished else _LOOK_S):
            self._forget()  # entities that came or went are among what wakes an executor
            self._serve_others()
            return
        for timer in timers:
            if timer.handle.is_timer_ready():
                timer.handle.call_timer()
                timer.callback()
        for subscription in subscriptions:
            if (taken := take(subscription)) is not None:
                alone = subscription._callback_type is Subscription.CallbackType.MessageOnly
                subscription.callback(*taken[: 1 if alone else 2])

    def _serve_others(self) -> None:
        """Lets rclpy serve each that is due once, timers and messages among them."""
        self._looked, self._cb_iter = time.monotonic(), None
        while True:
            try:
                handler, _, _ = self.wait_for_ready_callbacks(0)
            except TimeoutException:
                return
            handler()
            handler.result()

    def _forget(self) -> None:
        if self._kept is not None:
            self._kept.close()
            self._kept = None

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
