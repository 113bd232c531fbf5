"""Closed lines: arc length, heading, curvature and projection."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dynssm_ros.track.lines import Line
from dynssm_ros.track.tracks import load_track


def circle(radius: float, count: int = 200, direction: int = 1) -> Line:
    angle = direction * np.linspace(0, 2 * np.pi, count, endpoint=False)
    return Line(radius * np.stack([np.cos(angle), np.sin(angle)], axis=1))


@pytest.mark.parametrize("direction", [1, -1])
def test_circle_has_its_length_curvature_and_heading(direction):
    line = circle(40.0, direction=direction)
    assert line.length == pytest.approx(2 * np.pi * 40, rel=1e-7)
    np.testing.assert_allclose(line.curvature(line.s), direction / 40, rtol=1e-4)
    assert line.heading(0.0) == pytest.approx(direction * np.pi / 2, abs=1e-6)
    np.testing.assert_allclose(line.s, np.arange(200) * line.length / 200, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("size", [1.0, 250.0])
def test_the_bend_goes_with_the_curvature_up_to_the_sharpest_places_whatever_the_size_of_the_track(size):
    line = load_track("oval").centre.scaled(size)
    s = np.linspace(0.0, line.length, 300)
    bend, curvature = line.bend(s), line.curvature(s)
    assert bend.max() == 1.0
    assert bend.min() >= -0.05, "all its bends go to one side"
    straight = np.abs(curvature) < 0.01 * np.abs(curvature).max()
    assert np.abs(bend[straight]).mean() < 0.1
    np.testing.assert_allclose(line.bend(s + 2 * line.length), bend, atol=1e-9)
    place = line.place(float(s[7]) + line.length)
    assert place == {"s": s[7] + line.length, "lap_length": line.length, "bend": pytest.approx(bend[7])}


def test_unevenly_spaced_points_still_give_arc_length():
    angle = np.sort(np.random.default_rng(0).uniform(0, 2 * np.pi, 600))
    line = Line(np.stack([3 * np.cos(angle), 3 * np.sin(angle)], axis=1))
    fine = np.linspace(0, line.length, 20001)
    steps = np.hypot(*np.diff(line.position(fine), axis=0).T)
    np.testing.assert_allclose(steps, line.length / 20000, rtol=1e-3)


def test_position_is_periodic_and_left_is_positive():
    line = circle(10.0)  # counter-clockwise: left is inside
    np.testing.assert_allclose(line.position(3.0), line.position(3.0 - 2 * line.length), atol=1e-9)
    assert np.hypot(*line.position(5.0, 2.0)) == pytest.approx(8.0, abs=1e-5)


def test_the_frame_is_the_position_and_the_heading_and_left_of_it():
    line = circle(10.0, direction=-1)
    s = np.array([[1.0, 7.0], [line.length + 1.0, -3.0]])
    position, along, left = line.frame(s)
    heading = line.heading(s)
    np.testing.assert_array_equal(position, line.position(s))
    np.testing.assert_allclose(along, np.stack([np.cos(heading), np.sin(heading)], axis=-1), atol=1e-12)
    np.testing.assert_allclose(position + 2 * left, line.position(s, 2.0), atol=1e-12)


@settings(max_examples=60, deadline=None)
@given(share=st.floats(0, 0.999999), lateral=st.floats(-0.19, 0.19))
def test_projection_inverts_position(share, lateral):
    line = load_track("club").centre
    s, d = line.project(line.position(share * line.length, lateral))
    assert (s - share * line.length + line.length / 2) % line.length - line.length / 2 == pytest.approx(0, abs=1e-8)
    assert d == pytest.approx(lateral, abs=1e-8)


def test_many_points_project_like_one_by_one():
    line = load_track("club_b").centre
    points = line.position(np.linspace(0, line.length, 50), 0.1)
    s, lateral = line.project(points)
    assert s.shape == lateral.shape == (50,)
    one = [line.project(point, near=at) for point, at in zip(points, s + 0.05, strict=True)]
    apart = np.array([value for value, _ in one]) - s
    np.testing.assert_allclose(np.remainder(apart + 1, line.length) - 1, 0.0, atol=1e-8)  # the seam is one place


def test_near_keeps_the_projection_on_its_own_branch():
    x = np.linspace(0, 10, 101)
    out, back = np.stack([x, 0 * x], axis=1), np.stack([x[::-1], 0 * x + 0.5], axis=1)
    line = Line(np.concatenate([out, back]))  # there and back, half a metre apart
    point = [5.0, 0.3]  # nearer to the way back
    assert line.project(point)[0] > 10
    s, lateral = line.project(point, near=5.0)
    assert s == pytest.approx(5.0, abs=1e-3)
    assert lateral == pytest.approx(0.3, abs=1e-3)


def test_lines_cannot_be_changed():
    line = circle(1.0)
    with pytest.raises(ValueError, match="read-only"):
        line.points[0] = 0.0


def test_an_open_line_ends_at_its_points_and_goes_straight_on_behind_them() -> None:
    angle = np.linspace(0.0, np.pi / 2, 600)
    quarter = Line(10.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1), closed=False)
    assert quarter.length == pytest.approx(5.0 * np.pi, rel=1e-5)
    assert quarter.s[-1] == quarter.length
    middle = quarter.s[20:-20]
    np.testing.assert_allclose(quarter.curvature(middle), 0.1, rtol=1e-3)
    np.testing.assert_allclose(quarter.position(quarter.length + 3.0), [-3.0, 10.0], atol=0.01)
    np.testing.assert_allclose(quarter.position(-2.0), [10.0, -2.0], atol=0.01)
    assert quarter.curvature(quarter.length + 1.0) == 0.0
    s, lateral = quarter.project([[-1.0, 9.5], [10.5, -1.0], [7.0, 7.0]])
    np.testing.assert_allclose(s, [quarter.length + 1.0, -1.0, 2.5 * np.pi], atol=0.02)
    np.testing.assert_allclose(lateral, [0.5, -0.5, 10.0 - np.hypot(7.0, 7.0)], atol=0.02)
    assert quarter.counted_on(0.5, 15.0) == 0.5
    assert quarter.bend(quarter.length + 1.0) == pytest.approx(quarter.bend(quarter.length))
