"""A car that obeys: the watchdog, the actuator limits, standing still and setting off."""

import itertools

import numpy as np
import pytest

from dynssm_ros.simulation.external import CommandHolder, Pace, drive_by_commands
from dynssm_ros.simulation.laps import SimulationError
from dynssm_ros.simulation.laps import drive as drive_laps
from dynssm_ros.simulation.plant import RK4_STEP, make_plant, plant_type
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import Applied, CarModel, Coefficients, State, load_vehicle
from dynssm_ros.vehicle.low_speed import LowSpeedRolling

ORCA, AV21, CLUB = load_vehicle("orca"), load_vehicle("av21"), load_track("club")


class Watch:
    """A clock that is set by hand."""

    now = 100.0

    def __call__(self):
        return self.now


def drive(vehicle, command, count, plant="euler", track=CLUB):
    chosen = command if callable(command) else lambda previous: command
    return list(itertools.islice(drive_by_commands(vehicle, track, plant, chosen), count))


def test_fresh_commands_are_obeyed_within_the_actuators():
    watch = Watch()
    holder = CommandHolder(ORCA, 0.2, watch)
    assert holder.receive(Applied(0.4, 0.05))
    watch.now += 0.19
    assert holder.command(Applied(0.0, 0.0)) == (0.4, 0.05)
    holder.receive(Applied(7.0, 0.3))
    assert holder.command(Applied(0.0, 0.0)) == (1.0, 5.0 * 0.02), "throttle range, steering rate"
    assert holder.command(Applied(0.0, 0.34)) == (1.0, 0.3)
    holder.receive(Applied(-7.0, -9.0))
    assert holder.command(Applied(0.0, -0.34)) == (-0.1, -0.35), "throttle and steering range"


def test_a_command_waits_until_it_acts_and_a_newer_one_takes_the_place_of_later_ones():
    watch = Watch()
    holder = CommandHolder(ORCA, 0.2, watch)
    holder.receive(Applied(0.4, 0.0))
    holder.receive(Applied(-0.1, 0.0), after=0.1)
    assert holder.command(Applied(0.4, 0.0)).r == 0.4
    watch.now += 0.1
    assert holder.command(Applied(0.4, 0.0)).r == -0.1
    watch.now += 0.19
    assert holder.fresh, "since it acts"
    holder.receive(Applied(0.3, 0.0), after=0.1)
    holder.receive(Applied(0.2, 0.0), after=0.04)
    watch.now += 0.04
    assert holder.command(Applied(0.4, 0.0)).r == 0.2
    watch.now += 0.06
    assert holder.command(Applied(0.4, 0.0)).r == 0.2
    holder.receive(Applied(0.1, 0.0), after=1e3)
    assert holder.command(Applied(0.4, 0.0)).r == 0.1, "of another clock"


def test_old_commands_make_it_brake_with_the_steering_held():
    watch = Watch()
    holder = CommandHolder(ORCA, 0.2, watch)
    assert holder.command(Applied(0.5, 0.1)) == (-0.1, 0.1), "none yet"
    holder.receive(Applied(0.4, 0.05))
    assert holder.fresh
    watch.now += 0.21
    assert not holder.fresh
    assert holder.command(Applied(0.4, 0.05)) == (-0.1, 0.05)
    holder.receive(Applied(0.4, 0.05))
    assert holder.fresh


@pytest.mark.parametrize("bad", [Applied(float("nan"), 0.0), Applied(0.1, float("inf"))])
def test_commands_that_are_not_finite_change_nothing(bad):
    holder = CommandHolder(ORCA, 0.2, Watch())
    assert not holder.receive(bad)
    assert not holder.fresh


@pytest.mark.parametrize("plant", ["euler", "rk4", "double_track"])
@pytest.mark.parametrize("vehicle", [ORCA, AV21], ids=["orca", "av21"])
def test_it_stands_until_it_is_driven_and_comes_to_rest_again_under_the_brakes(vehicle, plant):
    standing = drive(vehicle, Applied(0.0, 0.1), 30, plant)
    assert {sample.state for sample in standing} == {State(0.0, 0.0, 0.0)}
    assert {sample.pose for sample in standing} == {standing[0].pose}

    commands = itertools.chain([Applied(0.4, 0.02)] * 40, itertools.repeat(Applied(vehicle.inputs.throttle[0], 0.02)))
    states = [sample.state for sample in drive(vehicle, lambda previous: next(commands), 150, plant)]
    assert states[40].v_x > 0.5
    assert min(state.v_x for state in states) >= 0.0
    np.testing.assert_allclose(states[-1], 0.0, atol=1e-9)
    assert max(abs(state.v_y) for state in states) < 0.2 * states[40].v_x, "no ringing on the way"


def test_above_creeping_speed_each_step_is_the_vehicle_model():
    samples = drive(ORCA, Applied(0.6, 0.03), 120)
    fast = [
        pair
        for pair in itertools.pairwise(samples)
        if pair[0].state.v_x > LowSpeedRolling(ORCA, ORCA.sampling_time).speed
    ]
    assert len(fast) > 30
    for before, after in fast:
        reached = CarModel(ORCA.constants, 0.02).step(before.state, before.command, Coefficients(*ORCA.nominal))[0]
        np.testing.assert_allclose(after.state, reached, rtol=1e-9)
        assert after.feedback == before.command


def test_creeping_wheels_roll_without_slip():
    car, limit = ORCA.constants, LowSpeedRolling(ORCA, ORCA.sampling_time).speed
    creeping = [s.state for s in drive(ORCA, Applied(0.4, 0.2), 60) if 0.1 < s.state.v_x < limit]
    assert len(creeping) > 3
    for before, after in itertools.pairwise(creeping):
        assert after.omega == pytest.approx(before.v_x * np.tan(0.2) / (car.l_f + car.l_r))
        assert after.v_y == pytest.approx(car.l_r * after.omega)


def test_creeping_speed_is_where_forward_euler_starts_to_ring():
    limit = LowSpeedRolling(ORCA, ORCA.sampling_time).speed

    def settles(v_x):
        state = State(v_x, 0.0, 0.5)
        for _ in range(200):
            moved = CarModel(ORCA.constants, 0.02).step(state, Applied(0.2, 0.0), Coefficients(*ORCA.nominal))[0]
            state = State(v_x, moved.v_y, moved.omega)
        return abs(state.omega - moved.omega) < 1e-9 and abs(state.omega) < 0.3

    assert settles(1.3 * limit)
    assert not settles(0.6 * limit)
    assert LowSpeedRolling(ORCA, RK4_STEP).speed == pytest.approx(limit / 20)


def test_it_goes_on_beside_the_road():
    lateral = [sample.lateral for sample in drive(ORCA, Applied(0.5, 0.0), 150)]
    assert max(map(abs, lateral)) > 0.5


def test_motion_that_is_not_finite_is_one_clear_line():
    with pytest.raises(SimulationError, match="orca: its motion is not finite after"):
        drive(ORCA, Applied(float("nan"), 0.0), 5)


def paced(held_up: float, *, waits: bool = False) -> tuple[Pace, float]:
    """After ten samples on time, and so long a pause (s); the time then."""
    pace = Pace(0.02, 2.0, 100.0, 5_000_000_000, waits=waits)
    assert pace.period == 0.01
    now = 100.011
    for _ in range(10):
        assert pace.behind(now) == 0
        pace.count += 1
        now += pace.period
    return pace, now + held_up


def test_a_car_that_was_held_up_shortly_catches_up():
    pace, now = paced(0.5)
    assert pace.behind(now) == 50
    pace.count += 50
    assert pace.behind(now) == 0
    assert pace.held_up == 0.0
    assert pace.stamp == 5_000_000_000 + 60 * 20_000_000


def test_stamps_of_a_car_that_was_held_up_for_long_leave_the_time_out():
    pace, now = paced(3.0)
    assert pace.behind(now) == 0
    assert pace.held_up == pytest.approx(3.001)
    assert pace.stamp == pytest.approx(5e9 + 2e9 * (now - 100.01), abs=1e3), "as late as if it had never been held up"


def test_a_car_whose_time_waits_for_its_driver_drives_every_sample():
    pace, now = paced(3.0, waits=True)
    assert pace.behind(now) == 0
    assert pace.stamp == 5_000_000_000 + 10 * 20_000_000


def room_left(vehicle, track, sample, watchdog):
    """The least until the car stands (m), when its driver falls silent at a sample of a lap."""
    low = LowSpeedRolling(vehicle, plant_type("euler").step(vehicle))
    car = make_plant(vehicle, "euler", sample.pose, sample.state, last=(low,), line=track.centre)
    T_s = vehicle.sampling_time
    watch = Watch()
    holder, feedback, s, least = CommandHolder(vehicle, watchdog, watch), sample.feedback, sample.s, np.inf
    holder.receive(sample.command)
    while car.state.v_x > 0.05:
        feedback = holder.command(feedback)
        car.advance(feedback, s)
        watch.now += T_s
        s, lateral = (float(value) for value in track.project(car.pose[:2], near=s))
        least = min(least, float(track.room(s, lateral)))
    return least


def test_a_car_whose_driver_falls_silent_in_a_bend_leaves_a_narrow_road():
    laps = list(itertools.islice(drive_laps(ORCA, CLUB, seed=1), 600))[150::15]
    rooms = np.array([room_left(ORCA, CLUB, sample, 0.2) for sample in laps])
    assert 0.6 < np.mean(rooms < 0) < 0.9
    assert -1.0 < rooms.min() < -0.6
