"""The life cycle of the predictor and the controller, as a manager drives it over DDS."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter

from benchmarks.live_run import Collector, LiveRun, collecting, isolated_environment, node_process
from test.nodes.conftest import PERIOD, Car, call

pytestmark = [pytest.mark.live, pytest.mark.timeout(240)]

CONFIGURE, CLEANUP = Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_CLEANUP
ACTIVATE, DEACTIVATE = Transition.TRANSITION_ACTIVATE, Transition.TRANSITION_DEACTIVATE


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        os.environ.update(isolated_environment())
        yield stack


def change(collector: Collector, node: str, transition: int) -> bool:
    """Asks for a transition; whether it was made."""
    return call(collector, ChangeState, f"/{node}/change_state", transition=Transition(id=transition)).success


def state(collector: Collector, node: str) -> str:
    return call(collector, GetState, f"/{node}/get_state").current_state.label


def test_a_predictor_is_configured_stands_by_and_takes_over_with_its_window_full(
    stack: ExitStack, small_model: Path, tmp_path: Path
) -> None:
    given = {"autostart": False, "diagnostics_period": 0.1, "model": tmp_path / "none"}
    process = stack.enter_context(node_process("predictor", given, os.environ.copy()))
    run = LiveRun(PERIOD)
    collector = stack.enter_context(collecting(run))
    assert state(collector, "dynssm") == "unconfigured"
    assert not change(collector, "dynssm", CONFIGURE), "there is no such model"
    assert state(collector, "dynssm") == "unconfigured"
    parameter = Parameter("model", value=str(small_model)).to_parameter_msg()
    assert call(collector, SetParameters, "/dynssm/set_parameters", parameters=[parameter]).results[0].successful
    assert change(collector, "dynssm", CONFIGURE)
    assert state(collector, "dynssm") == "inactive"

    car = Car(collector, run, process)
    car.wait_for_match()
    silent = [car.step() for _ in range(10)]
    assert car.diagnosed("inactive, publishes nothing: predicting"), run.diagnostics[-1:]
    assert change(collector, "dynssm", ACTIVATE)
    assert car.answered(car.step()), "the first odometry, as the window is full"
    assert not set(silent) & set(run.predicted)
    assert car.diagnosed("predicting")

    assert change(collector, "dynssm", DEACTIVATE)
    unanswered = car.step()
    assert change(collector, "dynssm", ACTIVATE)
    assert car.answered(car.step())
    assert unanswered not in run.predicted
    assert change(collector, "dynssm", DEACTIVATE)
    assert change(collector, "dynssm", CLEANUP)
    assert state(collector, "dynssm") == "unconfigured"
    assert change(collector, "dynssm", CONFIGURE), "and anew"
    assert change(collector, "dynssm", ACTIVATE)
    car.wait_for_match()
    car.drive_until_answered()


def test_a_controller_drives_while_it_is_active(stack: ExitStack) -> None:
    from sensor_msgs.msg import JointState

    given = {"vehicle": "orca", "track": "club"}
    stack.enter_context(node_process("simulator", given | {"driver": "external"}, os.environ.copy()))
    stack.enter_context(
        node_process("controller", given | {"autostart": False, "diagnostics_period": 0.1}, os.environ.copy())
    )
    run = LiveRun(PERIOD)
    collector = stack.enter_context(collecting(run))
    commands: list[JointState] = []

    def keep(message: JointState) -> None:
        with collector.changed:
            commands.append(message)
            collector.changed.notify_all()

    collector.create_subscription(JointState, "/vehicle/actuator_command", keep, 10)
    assert change(collector, "controller", CONFIGURE)

    def told(words: str) -> bool:
        seen = len(run.diagnostics)
        return collector.wait_for(lambda: any(words in m for _, m, _ in run.diagnostics[seen:]), 20.0)

    assert told("inactive, drives nothing")
    assert not commands
    assert change(collector, "controller", ACTIVATE)
    assert collector.wait_for(lambda: len(commands) > 20, 20.0)
    assert change(collector, "controller", DEACTIVATE)
    assert told("inactive, drives nothing")
    seen = len(commands)
    assert told("inactive, drives nothing")
    assert len(commands) == seen
