"""The line to follow and its time."""

import numpy as np
import pytest

from dynssm_ros.control.reference import load_reference
from dynssm_ros.simulation.tracks import TrackError


def test_at_constant_speed_arc_length_is_speed_times_time(circle):
    _, reference = circle(radius=2.0, speed=1.6)
    times = np.array([0.0, 0.5, 3.0, 100.0])
    assert reference.lap_time == pytest.approx(4 * np.pi / 1.6, rel=1e-6)
    expected = (0.7 + 1.6 * times) % reference.line.length
    np.testing.assert_allclose(reference.ahead(0.7, times), expected, rtol=1e-9)


def test_a_standing_start_takes_the_time_of_constant_acceleration(tmp_path):
    """From standstill at 2 m/s^2 around a circle of 12 points, v^2 = 2 a s, as the file says it."""
    angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    s = 3.0 * angle
    table = np.stack([s, 3 * np.cos(angle), 3 * np.sin(angle), np.sqrt(4 * s)], axis=1)
    path = tmp_path / "line.csv"
    np.savetxt(path, table, delimiter=",", header="s_m,x_m,y_m,v_mps")
    reference = load_reference(str(path), None, None)
    assert reference.name == "line"
    reached = reference.ahead(0.0, np.sqrt(s[1:]))  # s = a t^2 / 2 with a = 2
    np.testing.assert_allclose(reached, s[1:], rtol=2e-3)


def test_the_file_may_close_the_loop(tmp_path, circle):
    _, reference = circle()
    points = np.concatenate([reference.line.points, reference.line.points[:1]])
    path = tmp_path / "closed.csv"
    np.savetxt(path, np.column_stack([np.zeros(201), points, np.full(201, 1.5)]), delimiter=",")
    assert load_reference(str(path), None, None).lap_time == pytest.approx(reference.lap_time, rel=1e-9)


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
def test_a_file_that_is_no_line_is_refused(tmp_path, content, complaint):
    path = tmp_path / "line.csv"
    path.write_text(content)
    with pytest.raises(TrackError, match=complaint):
        load_reference(str(path), None, None)


def test_an_unknown_line_is_refused(orca, club):
    with pytest.raises(TrackError, match="neither centre, racing nor a file"):
        load_reference("scenic", orca, club)
