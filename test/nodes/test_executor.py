"""Nothing that a callback raises ends a node: it is counted, logged once, and told to who asked."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import pytest
import rclpy
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import ListParameters, SetParameters, SetParametersAtomically
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter as Value
from std_msgs.msg import String
from std_srvs.srv import Trigger

from dynssm_ros.errors import ConfigurationError
from dynssm_ros.nodes.controller import ControllerNode
from dynssm_ros.nodes.executor import EnduringExecutor, Failures, failures, in_thread, refused
from dynssm_ros.nodes.managed import ManagedNode
from dynssm_ros.runtime.health import Level


class Logging:
    """Stands in for a node."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def get_logger(self) -> Any:
        return SimpleNamespace(error=self.lines.append)


def raised(text: str) -> Exception:
    try:
        raise RuntimeError(text)
    except RuntimeError as error:
        return error


def test_exceptions_are_logged_once_for_each_place_and_all_are_counted() -> None:
    node, counted = Logging(), Failures()
    for k in range(3):
        counted.add(node, raised(f"number\n{k}"))
    assert len(node.lines) == 1
    assert "Traceback" in node.lines[0]
    counted.add(node, ConfigurationError("one line"), "/dynssm/set_parameters")
    assert node.lines[1:] == ["/dynssm/set_parameters: refused: ConfigurationError: one line"]
    assert counted.count == 4


def test_a_verdict_speaks_of_an_exception_for_a_while_and_counts_it_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    counted = Failures()
    assert counted.told(Level.OK, "drives", {"laps": "3"}) == (
        Level.OK, "drives", {"laps": "3", "exceptions": "0", "last exception": ""},
    )  # fmt: skip
    counted.add(Logging(), raised("of a sort"))
    level, words, _ = counted.told(Level.OK, "drives", {})
    assert level == Level.WARN
    assert words.startswith("drives; goes on after an exception: RuntimeError: of a sort (test_executor.py:")
    assert counted.told(Level.ERROR, "", {})[0] == Level.ERROR
    monkeypatch.setattr("dynssm_ros.nodes.executor._RECENT_S", 0.0)
    level, words, values = counted.told(Level.OK, "drives", {})
    assert (level, words, values["exceptions"]) == (Level.OK, "drives", "1")


def test_who_asks_for_what_fails_is_told_why_as_far_as_there_is_a_place_for_it() -> None:
    asked = SetParameters.Request(parameters=[Parameter(name="a"), Parameter(name="b")])
    results = refused(asked, SetParameters.Response(), "why").results
    assert [(one.successful, one.reason) for one in results] == [(False, "why")] * 2
    result = refused(SetParametersAtomically.Request(), SetParametersAtomically.Response(), "why").result
    assert (result.successful, result.reason) == (False, "why")
    assert refused(ListParameters.Request(), ListParameters.Response(), "why") == ListParameters.Response()


class Failing(ManagedNode):
    """Its timer fails three times."""

    def __init__(self) -> None:
        super().__init__("failing")
        self.calls = 0
        self.create_timer(1e-3, self._on_time)
        self.start()

    def prepare(self) -> None:
        """Nothing to prepare."""

    def _on_time(self) -> None:
        self.calls += 1
        if self.calls <= 3:
            raise RuntimeError("of the timer")


@pytest.mark.live
@pytest.mark.timeout(60)
def test_a_node_survives_its_timers_forbidden_transitions_and_parameters_of_no_type(ros: None) -> None:
    node, asking = Failing(), rclpy.create_node("asking")
    executor, asker = EnduringExecutor(node), SingleThreadedExecutor()
    asker.add_node(asking)
    while node.calls < 4:
        executor.spin_once(1.0)
    assert failures(node).count == 3

    def answer(service: Any, name: str, **request: Any) -> Any:
        client = asking.create_client(service, f"/failing/{name}")
        assert client.wait_for_service(10.0)
        future = client.call_async(service.Request(**request))
        for _ in range(1000):
            executor.spin_once(0.01)
            asker.spin_once(0.0)
            if future.done():
                return future.result()
        raise AssertionError(f"{name}: no answer")

    for transition in (0, Transition.TRANSITION_CONFIGURE):  # none that exists, and none for an active node
        assert not answer(ChangeState, "change_state", transition=Transition(id=transition)).success
    assert node.active
    nonsense = Parameter(name="autostart", value=ParameterValue(type=99))
    results = answer(SetParameters, "set_parameters", parameters=[nonsense]).results
    assert not results[0].successful
    assert results[0].reason
    good = Value("use_sim_time", value=False).to_parameter_msg()
    assert answer(SetParameters, "set_parameters", parameters=[good]).results[0].successful
    assert failures(node).count == 6
    node.destroy_node()
    asking.destroy_node()


@pytest.fixture
def node(ros: None) -> Iterator[Node]:
    made = rclpy.create_node("served")
    yield made
    made.destroy_node()


@pytest.fixture
def executor(node: Node) -> EnduringExecutor:
    return EnduringExecutor(node)


def spin_until(executor: EnduringExecutor, done: Callable[[], bool]) -> None:
    """Fails if it is not done within 30 s."""
    end = time.monotonic() + 30.0
    while not done():
        assert time.monotonic() < end
        executor.spin_once(0.1)


@pytest.mark.live
@pytest.mark.timeout(60)
def test_subscriptions_are_served_in_their_order_and_one_that_raises_holds_up_no_other(
    node: Node, executor: EnduringExecutor
) -> None:
    heard: list[str] = []

    def fail(message: String) -> None:
        heard.append(f"fails {message.data}")
        raise RuntimeError("of the message")

    node.create_subscription(String, "first", lambda message: heard.append(f"first {message.data}"), 10)
    node.create_subscription(String, "fails", fail, 10)
    node.create_subscription(
        String, "last", lambda message, times: heard.append(f"last {message.data}" * bool(times)), 10
    )
    first, fails, last = (node.create_publisher(String, topic, 10) for topic in ("first", "fails", "last"))
    spin_until(executor, lambda: all(each.get_subscription_count() for each in (first, fails, last)))
    for publisher in (last, fails, first):
        publisher.publish(String(data="1"))
        assert publisher.wait_for_all_acked(Duration(seconds=30)), "all wait before the executor looks"
    spin_until(executor, lambda: len(heard) == 3)
    assert heard == ["first 1", "fails 1", "last 1"]
    assert failures(node).count == 1


@pytest.mark.live
@pytest.mark.timeout(60)
def test_what_a_callback_makes_is_waited_for_and_what_it_destroys_no_more(
    node: Node, executor: EnduringExecutor
) -> None:
    heard: list[int] = []

    def begin() -> None:
        node.destroy_timer(timer)
        node.create_subscription(String, "made_later", lambda _: heard.append(1), 10)

    timer = node.create_timer(1e-3, begin)
    publisher = node.create_publisher(String, "made_later", 10)
    spin_until(executor, lambda: publisher.get_subscription_count() > 0)
    publisher.publish(String())
    spin_until(executor, lambda: bool(heard))
    assert [*node.timers] == []


@pytest.mark.live
@pytest.mark.timeout(60)
def test_messages_guards_and_other_services_are_served_while_a_service_waits_for_a_thread(
    node: Node, executor: EnduringExecutor
) -> None:
    heard: list[str] = []
    go_on = threading.Event()

    async def wait(request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        await in_thread(node, lambda: go_on.wait(30.0))
        response.message = "waited"
        return response

    def answer(request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.message = "at once"
        return response

    group = MutuallyExclusiveCallbackGroup()
    node.create_service(Trigger, "waits", wait, callback_group=group)
    node.create_service(Trigger, "answers", answer)
    node.create_subscription(String, "topic", lambda message: heard.append(message.data), 10)
    guard = node.create_guard_condition(lambda: heard.append("guard"))
    publisher = node.create_publisher(String, "topic", 10)
    waits, answers = (node.create_client(Trigger, name) for name in ("waits", "answers"))
    spin_until(executor, lambda: waits.service_is_ready() and answers.service_is_ready())
    spin_until(executor, lambda: publisher.get_subscription_count() > 0)
    waiting = waits.call_async(Trigger.Request())
    spin_until(executor, lambda: bool(executor._tasks))
    at_once = answers.call_async(Trigger.Request())
    publisher.publish(String(data="message"))
    guard.trigger()
    spin_until(executor, lambda: at_once.done() and len(heard) == 2)
    assert at_once.result().message == "at once"
    assert sorted(heard) == ["guard", "message"]
    assert not waiting.done()
    go_on.set()
    spin_until(executor, waiting.done)
    assert waiting.result().message == "waited"


@pytest.mark.live
@pytest.mark.timeout(60)
def test_a_controller_that_cannot_plan_brakes_says_so_and_drives_on_when_it_can(
    ros: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    node = ControllerNode()
    commands, told = [], []
    node._publish_command = commands.append
    node._publish_diagnostics = lambda array: told.append(array.status[0])
    message = Odometry()
    message.header.stamp.sec = 1
    message.pose.pose.orientation.w = 1.0

    def refuse(*_: Any, **__: Any) -> None:
        raise MemoryError("of the solver")

    with monkeypatch.context() as ill:
        ill.setattr(node._driver, "step", refuse)
        node._on_odometry(message)
        node._diagnose()
    assert commands[-1].position[0] == node._driver.brake().r < 0
    assert told[-1].level == b"\x02"
    assert told[-1].message.startswith("cannot plan: brakes; goes on after an exception: MemoryError: of the solver")
    message.header.stamp.sec = 2
    for k in range(8):
        message.header.stamp.nanosec = k * 20_000_000
        node._on_odometry(message)
    node._diagnose()
    assert "cannot plan" not in told[-1].message
    node._command.rival = lambda: "another node publishes on /vehicle/actuator_command: /joystick"
    node._diagnose()
    assert told[-1].level == b"\x02"
    assert told[-1].message.startswith("another node publishes on /vehicle/actuator_command: /joystick: brakes")
    node.destroy_node()
