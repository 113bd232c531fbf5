"""Figures over the track show what was planted where it was planted."""

from __future__ import annotations

import numpy as np
import pytest

from dynssm_ros.reporting import track_figures


def test_error_map_draws_the_largest_error_last(drawn):
    angle = np.linspace(0, 2 * np.pi, 200)
    errors = np.zeros((200, 3))
    errors[17] = [-2.0, 3.0, np.inf]
    axes = drawn(track_figures.error_map(100 * np.cos(angle), 60 * np.sin(angle), errors))
    dots = axes[0].collections[0]
    assert dots.get_array()[-1] == 2.0
    np.testing.assert_allclose(dots.get_offsets()[-1], [100 * np.cos(angle[17]), 60 * np.sin(angle[17])])


def test_error_map_of_fewer_rows_than_are_smoothed_over_draws_them(drawn):
    axes = drawn(track_figures.error_map(np.arange(3.0), np.zeros(3), np.ones((3, 3)), smooth=12))
    assert len(axes[0].collections[0].get_offsets()) == 3


def test_trajectories_show_how_far_to_the_left_and_ahead_the_predicted_paths_stray(drawn):
    measured = np.stack([np.zeros(9), np.arange(9.0) * 10], axis=1)  # driving along y
    leaving = np.stack([measured[:5], measured[4:]])
    stray = np.linspace(0.0, 0.4, 5)
    predicted = {
        "left": leaving - np.stack([stray, 0 * stray], axis=1),
        "ahead": leaving + np.stack([0 * stray, stray], axis=1),
        "diverged": leaving * np.nan,
    }
    figure = track_figures.trajectories(np.arange(9) * 0.04, measured, predicted)
    plan, sideways, along = drawn(figure)
    expected = np.tile(np.r_[stray, np.nan], 2)
    np.testing.assert_allclose(sideways.get_lines()[0].get_ydata(), expected, atol=1e-12)
    np.testing.assert_allclose(along.get_lines()[1].get_ydata(), expected, atol=1e-12)
    np.testing.assert_allclose(along.get_lines()[0].get_ydata()[:5], 0.0, atol=1e-12)
    factor = float(plan.get_title(loc="left").split("drawn ")[1].split()[0])
    drawn_x = plan.get_lines()[2].get_xdata()
    np.testing.assert_allclose(drawn_x[:5], -factor * stray, atol=1e-12)
    assert 0.05 * 80 < factor * 0.4 < 0.5 * 80


def test_errors_along_the_lap_are_drawn_where_they_happened(drawn):
    position = np.array([5.0, 15.0, 35.0])
    errors = {"m": np.array([[1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [np.inf, 0.0, 0.0]]), "n": np.ones((3, 3))}
    axes = drawn(track_figures.errors_along_lap(position, np.array([10.0, 20.0, 30.0]), errors, length=40.0, bins=4))
    speed, v_x = axes[0].get_lines()[0], axes[1].get_lines()[0]
    np.testing.assert_array_equal(speed.get_xdata(), [5.0, 15.0, 25.0, 35.0])
    np.testing.assert_allclose(speed.get_ydata(), [10.0, 20.0, np.nan, 30.0])
    np.testing.assert_allclose(v_x.get_ydata(), [1.0, 2.0, np.nan, np.nan])
    assert axes[-1].get_xlabel() == "position on the lap (m)"


@pytest.mark.parametrize(("value", "rounded"), [(0.3, 1), (1, 1), (4.9, 2), (5, 5), (99, 50), (240, 200), (0.0, 1)])
def test_enlargements_are_round_numbers(value, rounded):
    assert track_figures._round_number(value) == rounded
