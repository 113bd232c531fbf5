"""Figures draw whatever a model may have done, name their units, and show what was planted."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.text import Text

from dynssm_ros.reporting import evaluation_figures as figures
from dynssm_ros.vehicle import COEFFICIENTS, load_vehicle


@pytest.fixture
def run():
    """Time and states of a run with a gap, and three models of it; one is not finite anywhere."""
    rng = np.random.default_rng(1)
    time = 0.04 * np.r_[0:300, 400:700]
    states = np.cumsum(rng.normal(size=(600, 3)) * [0.05, 0.01, 0.002], axis=0)
    predicted = {
        "dynssm": states + rng.normal(size=states.shape) * 0.001,
        "diverged": np.full_like(states, np.nan),
        "persistence": np.vstack([states[:1], states[:-1]]),
    }
    return time, states, predicted


def test_predicted_and_measured_shows_three_channels_with_units(drawn, run):
    time, states, predicted = run
    axes = drawn(figures.predicted_and_measured(time, states, predicted))
    assert [a.get_ylabel() for a in axes[::2]] == ["$v_x$ (m/s)", "$v_y$ (m/s)", r"$\omega$ (rad/s)"]
    assert all(len(a.get_lines()) == 4 for a in axes)


@pytest.mark.parametrize("name", [r"a$\frac{$b", "$x$", "$v_x$", "$", r"\$", "a^_{b", r"$\mathdefault{$"])
def test_a_name_is_drawn_as_it_is(drawn, run, name):
    time, states, predicted = run
    figure = figures.predicted_and_measured(time, states, {name: predicted["dynssm"]})
    assert drawn(figure)
    rmse = {name: np.ones(3)}
    std = {name: np.zeros(3)}
    assert drawn(figures.relative_errors(rmse, std, np.ones(3)))
    formulas = {each.get_text() for each in figure.findobj(Text) if "$" in each.get_text() and each.get_parse_math()}
    ours = {("$v_x$", "m/s"), ("$v_y$", "m/s"), (r"$\omega$", "rad/s")}
    labels = {f"{symbol}{what} ({unit})" for symbol, unit in ours for what in ("", " error")}
    assert formulas == labels | ({name} & {"$v_x$"})


def test_increments_leave_out_persistence_and_say_how_much_is_explained(drawn, run):
    _, states, predicted = run
    axes = drawn(figures.increments(predicted["persistence"], states, predicted))
    assert len(axes) == 6
    assert axes[0].get_title(loc="left").endswith("100 % explained")
    assert axes[3].get_title(loc="left").endswith("none explained")
    assert [axes[k].get_ylabel().splitlines()[0] for k in (0, 3)] == ["dynssm", "diverged"]


def test_relative_errors_cut_long_bars_but_write_the_true_number(drawn):
    rmse = {"m": np.array([0.5, 100.0, np.nan]), "persistence": np.array([1.0, 10.0, 1.0])}
    std = dict.fromkeys(rmse, np.zeros(3))
    (panel,) = drawn(figures.relative_errors(rmse, std, np.array([1.0, 10.0, 1.0])))
    assert [bar.get_width() for bar in panel.patches] == [0.5, figures.MAX_BAR, 0.0]
    written = [t.get_text() for t in panel.texts]
    assert written == ["50 %", "1000 % (cut)", "not finite", "persistence"]


def test_relative_errors_draw_the_spread_over_seeds_as_whiskers(drawn):
    rmse, std = {"m": np.array([0.5, 1.0, 1.0])}, {"m": np.array([0.1, 0.0, 0.0])}
    (panel,) = drawn(figures.relative_errors(rmse, std, np.array([1.0, 1.0, 1.0])))
    (whisker,) = panel.collections
    np.testing.assert_allclose(whisker.get_segments()[0][:, 0], [0.4, 0.6])


def test_rollout_growth_draws_states_displacement_and_the_band_of_several_seeds(drawn):
    grow = np.arange(1.0, 16)
    errors = {"m": np.stack([grow, grow, grow, grow**2], axis=1), "diverged": np.full((15, 4), np.inf)}
    std = {"m": np.full((15, 4), 0.5), "diverged": np.zeros((15, 4))}
    axes = drawn(figures.rollout_growth(0.04 * grow, errors, std))
    np.testing.assert_array_equal(axes[3].get_lines()[0].get_ydata(), grow**2)
    assert [len(a.collections) for a in axes] == [1] * 4
    assert [a.get_xlabel() for a in axes] == ["", "", "time ahead (s)", "time ahead (s)"]


def test_adapted_parameters_shade_what_is_outside_the_bounds(drawn):
    car = load_vehicle("orca")
    time = np.arange(100) * 0.02
    theta = car.nominal + 0.1 * (car.upper - car.lower) * np.sin(time)[:, None]
    axes = drawn(figures.adapted_parameters(time, theta, car))
    assert len(axes) == len(COEFFICIENTS)
    for k, panel in enumerate(axes):
        edges = sorted(patch.get_y() + offset for patch in panel.patches for offset in (0.0, patch.get_height()))
        assert edges[1] == pytest.approx(car.lower[k])
        assert edges[2] == pytest.approx(car.upper[k])
    assert axes[-1].get_title(loc="left") == "$I_{z}$ (kg m²)"


def test_lines_of_adapted_parameters_are_cut_at_gaps(drawn):
    time = 0.02 * np.r_[0:50, 100:150]
    axes = drawn(figures.adapted_parameters(time, np.ones((100, 17)), load_vehicle("orca")))
    assert np.isnan(axes[0].get_lines()[-1].get_ydata()).sum() == 1


def test_parameter_usage_names_coefficients_that_rest_on_a_bound(drawn):
    car = load_vehicle("orca")
    theta = np.tile(0.5 * (car.lower + car.upper), (100, 1))
    theta[:25, 3] = car.upper[3]
    (panel,) = drawn(figures.parameter_usage(theta, car))
    assert [t.get_text() for t in panel.texts] == ["25 % of the time on a bound"]
    assert [t.get_text() for t in panel.get_yticklabels()][3] == "$E_{f}$"


def test_latency_histogram_counts_every_call(drawn):
    samples = {"a": np.geomspace(10, 20, 200), "b": np.full(50, 700.0)}
    figure = figures.latency_histogram(samples)
    (panel,) = drawn(figure)
    assert sum(bar.get_height() for bar in panel.patches) == 250
    assert panel.get_xlabel() == "time per prediction (µs)"
    assert "b: p50 700 µs, p99 700 µs" in [t.get_text() for t in figure.legends[0].get_texts()]


def test_regime_errors_name_the_regimes_and_let_only_outliers_leave(drawn):
    labels = ["0–20", "20–40"]
    rmse = {"m": np.full((2, 3), 1.0), "n": np.full((2, 3), 2.0), "far": np.full((2, 3), 50.0)}
    std = {"m": np.full((2, 3), 0.5), "n": np.zeros((2, 3)), "far": np.zeros((2, 3))}
    axes = drawn(figures.regime_errors(labels, "speed (m/s)", rmse, std))
    assert [t.get_text() for t in axes[0].get_xticklabels()] == labels
    assert [a.get_xlabel() for a in axes] == ["speed (m/s)"] * 3
    assert all(2.0 < a.get_ylim()[1] < 3.0 for a in axes)


def test_persistence_never_leaves_a_panel_not_even_beside_perfect_models(drawn):
    rmse = {"a": np.full((1, 3), 1e-16), "b": np.full((1, 3), 1e-16), "persistence": np.full((1, 3), 0.5)}
    axes = drawn(figures.regime_errors(["braking"], "throttle", rmse, dict.fromkeys(rmse, np.zeros((1, 3)))))
    assert all(0.5 < a.get_ylim()[1] < 0.6 for a in axes)
