"""The pilot: what comes in never makes a command that may not go out."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

from dynssm_ros.control.controller import Controller
from dynssm_ros.control.prediction_model import Adaptive, Fixed
from dynssm_ros.control.race_models import true_model
from dynssm_ros.control.settings import Settings
from dynssm_ros.errors import ConfigurationError
from dynssm_ros.runtime.baselines import Persistence, SingleTrack
from dynssm_ros.simulation.plant import Pose, make_plant
from dynssm_ros.vehicle import Applied, State


@pytest.fixture
def pilot(orca, club, club_line):
    """Builds a pilot on the small track."""

    def build(model=None, deadline=math.inf, **options):
        settings = replace(Settings.of(orca, N=10), deadline=deadline)
        return Controller(model or true_model(orca, "rk4"), orca.inputs, club_line, club, settings, **options)

    return build


@pytest.fixture
def on_line(club_line):
    """Pose and motion on the line at its start."""
    (x, y), heading = club_line.line.position(0.0), float(club_line.line.heading(0.0))
    return Pose(float(x), float(y), heading), State(float(club_line.speed_at(0.0)), 0.0, 0.0)


def allowed(command, before, orca):
    """Whether the car may be sent that."""
    low, high = orca.inputs.throttle
    reach = orca.inputs.steering_rate * orca.sampling_time
    left, right = orca.inputs.steering
    return (
        low <= command.r <= high and left <= command.delta <= right and abs(command.delta - before.delta) < reach + 1e-9
    )


class Remembering(Persistence):
    """Keeps the windows that it is asked about."""

    def __init__(self, H):
        self.H = H
        self.windows = []

    def predict(self, windows):
        self.windows.append(windows[0].copy())
        return super().predict(windows)


def test_the_model_reads_what_was_measured_and_commanded(orca, pilot, on_line):
    """The window ends with the present; its last column but for the present is what was sent, as increments."""
    model, (pose, state) = Remembering(4), on_line
    driver, car, feedback = pilot(Adaptive(model, orca)), make_plant(orca, "rk4", pose, state), Applied(0.0, 0.0)
    rows = []
    for k in range(6):
        decision = driver.step(0.02 * k, car.pose, car.measured, feedback)
        rows.append([*car.measured, *feedback, *np.subtract(decision.command, feedback)])
        car.advance(decision.command)
        feedback = decision.command
    assert len(model.windows) == 3  # the first three steps had too few rows
    np.testing.assert_allclose(model.windows[-1][:-1], rows[2:5], atol=1e-12)
    np.testing.assert_allclose(model.windows[-1][-1, :5], rows[5][:5], atol=1e-12)
    driver.forget()
    driver.step(0.12, car.pose, car.measured, feedback)
    assert len(model.windows) == 3


@pytest.mark.parametrize("bad", [math.nan, math.inf, -1e9])
def test_whatever_is_measured_the_command_may_be_sent(orca, pilot, on_line, bad):
    pose, state = on_line
    for k in range(8):
        values = [*pose, *state, 0.0, 0.0]
        values[k] = bad
        driver = pilot()
        for seen in (values, [*pose, *state, 0.0, 0.0], values):
            decision = driver.step(0.0, Pose(*seen[:3]), State(*seen[3:6]), Applied(*seen[6:]))
            before = Applied(*np.clip(np.nan_to_num(seen[6:], posinf=0.0), -0.35, 0.35))
            assert np.all(np.isfinite(decision.command))
            assert orca.inputs.throttle[0] <= decision.command.r <= orca.inputs.throttle[1]
            assert abs(decision.command.delta) <= orca.inputs.steering[1]
            if abs(seen[7]) < 1:
                assert allowed(decision.command, before, orca)


def test_a_lost_measurement_is_made_up_for(orca, pilot, on_line):
    """One row without a yaw rate: that step drives the plan before, the next one plans again, and the window is whole."""
    model, (pose, state) = Remembering(2), on_line
    driver, car, feedback = pilot(Adaptive(model, orca)), make_plant(orca, "rk4", pose, state), Applied(0.0, 0.0)
    status = []
    for k in range(6):
        seen = car.measured._replace(omega=math.nan) if k == 3 else car.measured
        decision = driver.step(0.02 * k, car.pose, seen, feedback)
        status.append(decision.plan.status)
        car.advance(decision.command)
        feedback = decision.command
    assert status == ["solved"] * 3 + ["infeasible"] + ["solved"] * 2
    assert driver.counts == {"solved": 5, "infeasible": 1, "late": 0}
    assert np.all(np.isfinite(model.windows[-2:]))


def test_the_deadline_counts_the_model_too(orca, pilot, on_line):
    """A clock that jumps when the model is read: from the second step on every plan is late, and the one before is driven."""
    now = itertools.count()

    class Slow(SingleTrack):
        def predict(self, windows):
            for _ in range(100):
                next(now)
            return super().predict(windows)

    driver = pilot(Adaptive(Slow(orca), orca), 0.5, clock=lambda: next(now) / 100)
    pose, state = on_line
    first = driver.step(0.0, pose, state, Applied(0.0, 0.0))
    second = driver.step(0.02, pose, state, first.command)
    assert (first.plan.status, second.plan.status) == ("solved", "late")
    assert second.seconds > 0.5
    np.testing.assert_allclose(second.plan.u[0], first.plan.u[1], atol=1e-12)


class Learning(Fixed):
    """Keeps what it is told."""

    def __init__(self, car, cost=lambda: None):
        super().__init__("learning", true_model(car, "rk4").car, car.nominal)
        self.H, self.told, self._cost = 3, [], cost

    def learn(self, rows):
        self._cost()
        self.told.append(rows.copy())

    def interrupt(self):
        self.told.append("interrupted")


def driven(orca, driver, pose, state, asked):
    """The commands of a short drive, whose driver is asked to learn in between or not."""
    car, feedback, commands = make_plant(orca, "rk4", pose, state), Applied(0.0, 0.0), []
    for k in range(12):
        feedback = driver.step(0.02 * k, car.pose, car.measured, feedback).command
        if asked:
            driver.learn()
        car.advance(feedback)
        commands.append(feedback)
    return commands


def test_what_is_learned_after_the_command_is_what_the_next_step_would_learn(orca, pilot, on_line):
    """Left to the next step, it changes no command; each row is learned from once, with the command that was sent."""
    left, asked = Learning(orca), Learning(orca)
    commands = driven(orca, pilot(left), *on_line, False)
    assert commands == driven(orca, pilot(asked), *on_line, True)
    told = asked.told[1:]  # the first: it begins
    assert (len(told), len(left.told)) == (12, 12)
    np.testing.assert_array_equal(left.told[-1], asked.told[-2])
    sent = np.diff([(0.0, 0.0), *commands], axis=0)
    np.testing.assert_allclose([rows[-1, 5:] for rows in told], sent, atol=1e-12)


def test_a_command_does_not_wait_for_what_is_learned(orca, pilot, on_line):
    """Learning that takes 10 s: a driver that is asked for it after the command has its command as soon as before."""
    now = itertools.count()

    def build():
        return pilot(Learning(orca, lambda: [next(now) for _ in range(1000)]), clock=lambda: next(now) / 100)

    pose, state = on_line
    asked, left = build(), build()
    for driver in (asked, left):
        driver.step(0.0, pose, state, Applied(0.0, 0.0))
    asked.learn()
    assert asked.step(0.02, pose, state, Applied(0.0, 0.0)).seconds < 1
    assert left.step(0.02, pose, state, Applied(0.0, 0.0)).seconds > 9


def test_a_model_is_told_of_gaps(orca, pilot, on_line):
    """What was sent before a gap is learned from; what was forgotten is not."""
    model, (pose, state) = Learning(orca), on_line
    driver = pilot(model)
    driver.step(0.0, pose, state, Applied(0.0, 0.0))
    driver.interrupt()
    driver.step(0.05, pose, state, Applied(0.0, 0.0))
    driver.forget()
    driver.learn()
    assert [rows if isinstance(rows, str) else len(rows) for rows in model.told] == [
        "interrupted", 1, "interrupted", "interrupted"
    ]  # fmt: skip


def test_a_model_that_needs_what_is_not_measured_is_refused(orca, pilot):
    banked = orca.with_effect("road_bank", {"roll_gain": 1.0})
    with pytest.raises(ConfigurationError, match="needs the signal roll"):
        pilot(true_model(banked, "rk4"))
