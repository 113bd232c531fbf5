"""The line to follow and its time."""

from dataclasses import replace

import numpy as np
import pytest

from dynssm_ros.control.reference import load_reference
from dynssm_ros.track.tracks import TrackError
from dynssm_ros.vehicle.limits import Limits


def test_at_constant_speed_arc_length_is_speed_times_time(circle):
    _, reference = circle(radius=2.0, speed=1.6)
    times = np.array([0.0, 0.5, 3.0, 100.0])
    assert reference.lap_time == pytest.approx(4 * np.pi / 1.6, rel=1e-6)
    for laps in (0.0, 3.0):  # places count on
        s = 0.7 + laps * reference.line.length
        np.testing.assert_allclose(reference.ahead(s, times), s + 1.6 * times, rtol=1e-9)


@pytest.fixture
def standing(orca, club, tmp_path):
    """From standstill at 2 m/s^2 around a circle of 12 points, v^2 = 2 a s, as the file says it."""
    angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    s = 3.0 * angle
    table = np.stack([s, 3 * np.cos(angle), 3 * np.sin(angle), np.sqrt(4 * s)], axis=1)
    path = tmp_path / "line.csv"
    np.savetxt(path, table, delimiter=",", header="s_m,x_m,y_m,v_mps")
    return load_reference(str(path), orca, club)


def test_a_standing_start_takes_the_time_of_constant_acceleration(standing):
    s = standing.line.s
    assert (standing.name, standing.standing) == ("line", True)
    reached = standing.ahead(0.0, np.sqrt(s[1:]))  # s = a t^2 / 2 with a = 2
    np.testing.assert_allclose(reached, s[1:], rtol=2e-3)


def test_a_line_for_one_lap_ends_at_its_last_speed(standing):
    """Neither does it stop at its end to start anew, nor is its end where a car stands that is just before its start."""
    length, last = standing.line.length, standing.speed[-1]
    np.testing.assert_allclose(standing.ahead(length, np.array([0.1, 0.2])), length + last * np.array([0.1, 0.2]))
    assert standing.speed_at(length + 0.3) == last
    just_before = standing.line.position(length - 0.01)
    assert standing.project(just_before) == pytest.approx(-0.01, abs=1e-6)
    assert standing.project(just_before, near=length - 0.5) == pytest.approx(length - 0.01, abs=1e-6)
    assert standing.speed_at(-0.01) == 0.0


def test_the_file_may_close_the_loop(orca, club, tmp_path, circle):
    _, reference = circle()
    points = np.concatenate([reference.line.points, reference.line.points[:1]])
    path = tmp_path / "closed.csv"
    np.savetxt(path, np.column_stack([np.zeros(201), points, np.full(201, 1.5)]), delimiter=",")
    assert load_reference(str(path), orca, club).lap_time == pytest.approx(reference.lap_time, rel=1e-9)


def test_the_car_may_go_on_from_a_higher_speed_than_it_reaches(orca, club, standing):
    racing = load_reference("racing", orca, club)
    s = np.linspace(-1.0, 2 * racing.line.length, 300)
    above = racing.terminal_speed_at(s) - racing.speed_at(s)
    assert np.min(above) == pytest.approx(0.0, abs=1e-12)
    assert np.max(above) > 0.5
    # of a file nothing else is known
    np.testing.assert_array_equal(standing.terminal_speed_at(s), standing.speed_at(s))


def test_pace_slows_the_line(orca, club):
    assert load_reference("centre", orca, club, 0.8).lap_time > 1.05 * load_reference("centre", orca, club).lap_time


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        ("1,2,3\n" * 20, "rows of 3 values"),
        ("a,b,c,d\n", "cannot be read"),
        ("1,2,3,4\n", "at least 10 rows"),
        ("0,1,1,1\n" * 20, "stand still"),
    ],
)
def test_a_file_that_is_no_line_is_refused(orca, club, tmp_path, content, complaint):
    path = tmp_path / "line.csv"
    path.write_text(content)
    with pytest.raises(TrackError, match=complaint):
        load_reference(str(path), orca, club)


def test_an_unknown_line_is_refused(orca, club):
    with pytest.raises(TrackError, match="neither centre, racing nor a file"):
        load_reference("scenic", orca, club)


def test_a_car_is_not_asked_for_more_than_full_throttle_reaches(orca, club_line):
    """At rest on a fast stretch: half the car's acceleration at standstill times the square of the time."""
    s, times = float(club_line.line.s[np.argmax(club_line.speed)]), np.array([0.1, 0.2])
    gain = (0.287 - 0.0518) / 0.041 - 0.0545 * 0.24 / 0.041  # at the lowest speed of the table, 0.24 m/s
    np.testing.assert_allclose(club_line.within_reach(s, times, 0.0), s + gain * times**2 / 2, rtol=1e-3)
    fast = 1.2 * float(np.max(club_line.speed))
    np.testing.assert_array_equal(club_line.within_reach(s, times, fast), club_line.ahead(s, times))


def test_a_car_behind_its_time_is_asked_to_catch_up(club_line):
    s, times = float(club_line.line.s[np.argmax(club_line.speed)]), np.array([0.1, 0.2])
    v, late = 1.2 * float(np.max(club_line.speed)), 0.05
    asked = club_line.within_reach(s, times, v, scheduled=s + late)
    np.testing.assert_array_equal(asked, club_line.ahead(s + late, times))
    slow = club_line.within_reach(s, times, 0.0, scheduled=s + late)
    np.testing.assert_array_equal(slow, club_line.within_reach(s, times, 0.0))


def test_full_throttle_bounds_the_time_of_a_line(standing):
    """From standstill around 6 pi m at 2 m/s^2, as the line asks, or at 1 m/s^2, as the car can: t^2 = 2 s / a."""
    ones, length = np.ones(2), standing.line.length
    strong, weak = (Limits(np.array([0.1, 100.0]), ones, gain * ones, ones) for gain in (3.0, 1.0))
    assert replace(standing, limits=strong).full_throttle_time == pytest.approx(standing.lap_time, rel=1e-12)
    assert replace(standing, limits=weak).full_throttle_time == pytest.approx(np.sqrt(2 * length), rel=1e-3)


def test_what_the_car_can_do_takes_no_longer(club_line):
    assert club_line.full_throttle_time == pytest.approx(club_line.lap_time, rel=1e-3)
