"""Driving laps and writing them as bags."""

import itertools

import numpy as np
import pytest

from dynssm_ros.signals.bags import open_bag
from dynssm_ros.signals.extraction import extract
from dynssm_ros.signals.messages import COMMAND_TOPIC, FEEDBACK_TOPIC, ODOMETRY_TOPIC
from dynssm_ros.signals.signal_map import load_signal_map
from dynssm_ros.simulation.laps import SimulationError, drive, simulate, write_run
from dynssm_ros.track.driver import Style
from dynssm_ros.track.lines import Line
from dynssm_ros.track.racing_line import line_of
from dynssm_ros.track.tracks import Track, load_track
from dynssm_ros.vehicle import Applied, CarModel, Coefficients, State, load_vehicle

ORCA, CLUB = load_vehicle("orca"), load_track("club")


@pytest.fixture(scope="module")
def lap():
    """Two laps of the 1:43 car."""
    return simulate(ORCA, CLUB, laps=2, seed=3)


@pytest.fixture(scope="module")
def indy():
    """Half a minute of the full-size car, finely integrated."""
    return simulate(load_vehicle("av21"), load_track("road_course"), duration=30, plant="rk4", seed=1)


def messages(path):
    with open_bag(path) as bag:
        return list(bag.messages([FEEDBACK_TOPIC, COMMAND_TOPIC, ODOMETRY_TOPIC]))


@pytest.mark.parametrize("name", ["lap", "indy"])
def test_car_stays_on_the_road_within_its_actuators(name, request):
    run = request.getfixturevalue(name)
    right, left = run.track.widths(run.s)
    assert np.all((run.lateral < 0.6 * left) & (run.lateral > -0.6 * right))
    limits = run.vehicle.inputs
    throttle, steering = run.command.T
    assert limits.throttle[0] <= throttle.min() < 0 < 0.8 < throttle.max() <= limits.throttle[1]
    assert np.all((steering >= limits.steering[0]) & (steering <= limits.steering[1]))
    reach = limits.steering_rate * run.vehicle.sampling_time
    assert np.max(np.abs(run.command[:, 1] - run.feedback[:, 1])) <= reach + 1e-12


@pytest.mark.parametrize("name", ["lap", "indy"])
def test_feedback_is_the_command_of_the_step_before(name, request):
    run = request.getfixturevalue(name)
    np.testing.assert_array_equal(run.feedback[1:], run.command[:-1])
    np.testing.assert_array_equal(run.feedback[0], 0.0)
    assert np.all(np.diff(run.time) == round(1e9 * run.vehicle.sampling_time))


def test_tyres_are_worked_hard(lap):
    car, (v_x, v_y, omega) = ORCA.constants, lap.state.T
    front = lap.command[:, 1] - np.arctan2(car.l_f * omega + v_y, v_x)
    rear = np.arctan2(car.l_r * omega - v_y, v_x)
    assert np.max(np.abs(front)) > 0.18
    assert np.max(np.abs(rear)) > 0.16
    assert np.max(np.abs(v_x * omega)) > 7.5  # m/s^2, of 8.9 that the tyres have


def test_laps_are_counted_and_timed(lap):
    assert lap.laps == pytest.approx(2, abs=0.02)
    assert len(lap.lap_times) == 2
    assert np.sum(lap.lap_times) == pytest.approx(lap.duration, abs=2 * ORCA.sampling_time)
    s, lateral = CLUB.project(lap.pose[:, :2])
    np.testing.assert_allclose((lap.s - s) / CLUB.length, np.round((lap.s - s) / CLUB.length), atol=1e-6)
    np.testing.assert_allclose(lateral, lap.lateral, atol=1e-8)


def test_bag_holds_the_steps_that_the_plant_made(lap, tmp_path):
    write_run(lap, tmp_path / "bag")
    recording = extract([tmp_path / "bag"], load_signal_map("default"), rate=50.0)
    assert len(recording) == len(lap.time)
    np.testing.assert_array_equal(recording.time, lap.time)
    state = State(*(recording[name] for name in ("v_x", "v_y", "omega")))
    applied = Applied(recording["r_fb"] + recording["r_cmd"], recording["delta_fb"] + recording["delta_cmd"])
    reached = CarModel(ORCA.constants, ORCA.sampling_time).step(state, applied, Coefficients(*ORCA.nominal))[0]
    for name, values in reached._asdict().items():
        np.testing.assert_allclose(values[:-1], recording[name][1:], rtol=0, atol=1e-9)
    for name, values in zip(("x", "y", "theta"), lap.pose.T, strict=True):
        np.testing.assert_allclose(recording[name], values, atol=1e-9)


def test_actuators_are_logged_before_the_odometry_of_their_step(lap, tmp_path):
    write_run(lap, tmp_path / "bag")
    logged = messages(tmp_path / "bag")
    order = [FEEDBACK_TOPIC, COMMAND_TOPIC, ODOMETRY_TOPIC]
    assert [message.topic for message in logged] == order * len(lap.time)
    assert all(later.log_time > sooner.log_time for sooner, later in itertools.pairwise(logged))
    assert [message.log_time // 1_000_000 * 1_000_000 for message in logged[2::3]] == lap.time.tolist()


def test_same_seed_gives_the_same_bag_and_another_seed_another(tmp_path):
    runs = [simulate(ORCA, CLUB, duration=2, seed=seed, noise=(0.01, 0.01, 0.1)) for seed in (5, 5, 6)]
    bags = []
    for k, run in enumerate(runs):
        write_run(run, tmp_path / str(k))
        bags.append(messages(tmp_path / str(k)))
    assert bags[0] == bags[1]
    assert bags[0] != bags[2]


def test_noise_is_on_the_measurement_and_not_on_the_motion():
    clean = simulate(ORCA, CLUB, duration=10, seed=2)
    noisy = simulate(ORCA, CLUB, duration=10, seed=2, noise=(0.02, 0.01, 0.3))
    np.testing.assert_array_equal(clean.measured, clean.state)
    np.testing.assert_array_equal(noisy.state, clean.state)
    np.testing.assert_allclose(np.std(noisy.measured - noisy.state, axis=0), [0.02, 0.01, 0.3], rtol=0.1)


def test_steering_offset_shows_in_the_commands():
    straight = simulate(ORCA, CLUB, laps=2, style=Style(0.7, 0.0))
    shifted = simulate(ORCA.with_effect("steering_offset", {"offset": 0.03}), CLUB, laps=2, style=Style(0.7, 0.0))
    found = np.mean(straight.command[:, 1]) - np.mean(shifted.command[:, 1])
    assert found == pytest.approx(0.03, abs=0.005)  # the driver steers against it
    assert shifted.vehicle.effects[0].parameters == {"offset": 0.03}


def test_drag_asks_for_more_throttle():
    style = Style(0.7, 0.0)
    plain = simulate(ORCA, CLUB, laps=1, style=style)
    draggy = simulate(ORCA.with_effect("drag", {"coefficient": 0.01}), CLUB, laps=1, style=style)
    assert np.mean(draggy.command[:, 0]) > np.mean(plain.command[:, 0]) + 0.05


def test_laps_without_variation_repeat_and_with_it_differ():
    def spread(variation):
        run = simulate(ORCA, CLUB, laps=3, seed=1, style=Style(0.9, variation))
        places = np.linspace(0.5, CLUB.length - 0.5, 50)
        second, third = (np.interp(places + k * CLUB.length, run.s, run.lateral) for k in (1, 2))
        return np.max(np.abs(second - third))

    assert spread(0.0) < 0.005
    assert spread(1.0) > 0.02


def test_racing_line_is_followed_where_one_is_given():
    inside = CLUB.centre.position(CLUB.centre.s, 0.06)
    line = type(CLUB.centre)(inside)
    run = simulate(ORCA, CLUB, laps=1.0, line=line, style=Style(0.7, 0.0))
    assert np.median(run.lateral) == pytest.approx(0.06, abs=0.015)


def test_drive_goes_on_as_long_as_it_is_asked():
    samples = list(itertools.islice(drive(ORCA, CLUB), 100))
    assert samples[-1].time == pytest.approx(99 * ORCA.sampling_time)
    assert samples[-1].s > samples[0].s


def test_car_that_leaves_the_track_is_an_error_that_says_where():
    slow_wheels = ORCA.with_effect("steering_lag", {"time_constant": 0.2})
    with pytest.raises(
        SimulationError, match=r"orca (leaves track club|spins or stops on track club) after .* s"
    ) as caught:
        simulate(slow_wheels, CLUB, duration=20)
    assert "\n" not in str(caught.value)


def test_car_on_a_track_too_small_for_it_is_an_error():
    with pytest.raises(SimulationError, match=r"leaves track club after .*take a wider track"):
        simulate(ORCA, CLUB.scaled(0.3), duration=20)


@pytest.mark.parametrize("asked", [{}, {"duration": 1, "laps": 1}, {"duration": 0.0}, {"laps": -1}, {"laps": np.nan}])
def test_neither_both_or_nothing_to_drive_is_an_error(asked):
    with pytest.raises(SimulationError, match="expected one of them, positive"):
        simulate(ORCA, CLUB, **asked)


def test_progress_reaches_the_end():
    told = []
    simulate(ORCA, CLUB, duration=1, progress=lambda done, total: told.append((done, total)))
    assert told[-1] == (1000, 1000)
    assert len(told) == 51


def open_road() -> Track:
    """Two thirds of a lap."""
    last = 2 * len(CLUB.centre.points) // 3
    return Track("road", Line(CLUB.centre.points[:last], closed=False), CLUB.width_right[:last], CLUB.width_left[:last])


@pytest.mark.parametrize(("line", "until"), [("centre", {"laps": 1}), ("racing", {"duration": 60.0})])
def test_an_open_road_is_driven_once_from_start_to_end(line, until):
    road = open_road()
    run = simulate(ORCA, road, line=line_of(line, ORCA, road), **until)
    assert run.s[0] == pytest.approx(0.0, abs=0.05)
    assert road.length <= run.s[-1] < road.length + 3.0 * 0.02
    assert np.all(np.diff(run.s) > 0)
    assert run.state[-1, 0] > 1.0  # it does not stop for the end
    with pytest.raises(SimulationError, match=r"2 laps of track road, an open road; expected 1 at most"):
        simulate(ORCA, road, laps=2)
