"""The life cycle of the predictor and the controller, as a manager drives it over DDS."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState

from benchmarks.endurance.live_run import Collector, LiveRun, collecting, isolated_environment, node_process

pytestmark = [pytest.mark.live, pytest.mark.timeout(240)]

CONFIGURE, CLEANUP = Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_CLEANUP
ACTIVATE, DEACTIVATE = Transition.TRANSITION_ACTIVATE, Transition.TRANSITION_DEACTIVATE


Change = Callable[[Collector, str, int], bool]


@pytest.fixture
def change(call_service: Callable[..., Any]) -> Change:
    """Asks a node for a transition; whether it was made."""
    return lambda collector, node, transition: (
        call_service(collector, ChangeState, f"/{node}/change_state", transition=Transition(id=transition)).success
    )


@pytest.fixture
def state(call_service: Callable[..., Any]) -> Callable[[Collector, str], str]:
    """The state of a node, in a word."""
    return lambda collector, node: call_service(collector, GetState, f"/{node}/get_state").current_state.label


def test_a_predictor_is_configured_stands_by_and_takes_over_with_its_window_full(
    start_car: Callable[..., Any],
    change: Change,
    state: Callable[[Collector, str], str],
    small_model: Path,
    tmp_path: Path,
) -> None:
    car = start_car(tmp_path / "none", wait=False, autostart=False)
    collector, run = car.collector, car.run
    assert state(collector, "dynssm") == "unconfigured"
    assert not change(collector, "dynssm", CONFIGURE), "there is no such model"
    assert state(collector, "dynssm") == "unconfigured"
    assert car.set_parameter("model", str(small_model)) == (True, "")
    assert change(collector, "dynssm", CONFIGURE)
    assert state(collector, "dynssm") == "inactive"

    car.wait_for_match()
    silent = [car.step() for _ in range(10)]
    silent += car.steps_until_diagnosed("inactive, publishes nothing: predicting")
    assert change(collector, "dynssm", ACTIVATE)
    assert car.answered(car.step()), "the first odometry, as the window is full"
    assert not set(silent) & set(run.predicted)
    car.steps_until_diagnosed("predicting")

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


@pytest.fixture
def parked() -> Iterator[tuple[Collector, LiveRun]]:
    """Hears a simulated car and a controller that waits to be configured."""
    run, given = LiveRun(20_000_000), {"vehicle": "orca", "track": "club"}
    waiting = given | {"autostart": False, "diagnostics_period": 0.1}
    os.environ.update(isolated_environment())
    with (
        node_process("simulator", given | {"driver": "external"}, os.environ.copy()),
        node_process("controller", waiting, os.environ.copy()),
        collecting(run) as collector,
    ):
        yield collector, run


def test_a_controller_drives_while_it_is_active(parked: tuple[Collector, LiveRun], change: Change) -> None:
    from sensor_msgs.msg import JointState

    collector, run = parked
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
    assert not change(collector, "controller", ACTIVATE), "it is active"
    assert not change(collector, "controller", CONFIGURE)
    seen = len(commands)
    assert collector.wait_for(lambda: len(commands) > seen + 20, 20.0), "and it drives on"
    assert change(collector, "controller", DEACTIVATE)
    assert told("inactive, drives nothing")
    seen = len(commands)
    assert told("inactive, drives nothing")
    assert len(commands) == seen
