"""Statistics of adapted coefficients against planted ones."""

from __future__ import annotations

import numpy as np
import pytest

from dynssm_ros.evaluation.coefficients import CoefficientStatistics, CoefficientTally, coefficient_unit, range_used
from dynssm_ros.vehicle import COEFFICIENTS, load_vehicle

CAR = load_vehicle("orca")
MIDDLE = (CAR.lower + CAR.upper) / 2
D_F = COEFFICIENTS.index("D_f")


def statistics(*blocks, vehicle=CAR) -> CoefficientStatistics | None:
    tally = CoefficientTally(vehicle)
    for block in blocks:
        tally.add(block)
    return tally.statistics


def test_statistics_are_those_of_the_rows():
    theta = np.tile(MIDDLE, (4, 1))
    theta[:, D_F] = [0.2, 0.3, 0.4, 0.7]
    found = statistics(theta)
    assert found.mean[D_F] == pytest.approx(0.4)
    assert found.std[D_F] == pytest.approx(np.std([0.2, 0.3, 0.4, 0.7]))
    assert (found.low[D_F], found.high[D_F]) == (0.2, 0.7)
    assert found.std[0] == 0.0
    assert found.at_bound.max() == 0.0


def test_resting_on_a_bound_is_within_one_percent_of_the_range():
    theta = np.tile(MIDDLE, (8, 1))
    span = CAR.upper - CAR.lower
    theta[:2] = CAR.lower
    theta[2] = CAR.upper - 0.009 * span
    theta[3] = CAR.upper - 0.011 * span
    np.testing.assert_allclose(statistics(theta).at_bound, 3 / 8)
    np.testing.assert_allclose(range_used(theta, CAR)[:4, 0], [0.0, 0.0, 0.991, 0.989])


def test_models_that_adapt_nothing_have_no_statistics():
    assert statistics() is None
    assert statistics(np.tile(MIDDLE, (5, 1)), np.tile(MIDDLE, (2, 1))) is None
    assert statistics(np.random.default_rng(0).normal(size=(5, 17)), vehicle=None) is None


def test_blocks_have_the_statistics_of_all_rows():
    theta = np.random.default_rng(1).uniform(CAR.lower, CAR.upper, size=(100, 17))
    theta[:40, D_F] = 0.3
    blocks = statistics(theta[:1], theta[1:40], theta[40:])
    np.testing.assert_allclose(blocks.mean, theta.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(blocks.std, theta.std(axis=0), rtol=1e-12)
    np.testing.assert_array_equal(blocks.low, theta.min(axis=0))
    np.testing.assert_array_equal(blocks.high, theta.max(axis=0))
    np.testing.assert_allclose(blocks.at_bound, statistics(theta).at_bound, rtol=1e-12)


def test_coefficients_that_change_from_block_to_block_alone_are_adapted():
    assert statistics(np.tile(MIDDLE, (5, 1)), np.tile(CAR.lower, (5, 1))).std[D_F] > 0


def test_json_names_coefficients_with_bounds_and_units():
    theta = np.linspace(CAR.lower, CAR.upper, 11)
    entry = statistics(theta).to_json()
    assert list(entry) == list(COEFFICIENTS)
    lower, upper = CAR.coefficients["I_z"].bounds
    inertia = entry["I_z"]
    assert (inertia.pop("bounds"), inertia.pop("unit")) == ([lower, upper], "kg m^2")
    std = (upper - lower) * np.sqrt(0.1)  # of eleven equally spaced values
    assert inertia == pytest.approx(
        {"mean": (lower + upper) / 2, "std": std, "min": lower, "max": upper, "at_bound": 2 / 11}
    )


def test_units_are_written_as_people_do():
    assert [coefficient_unit(name) for name in ("C_f", "C_r2", "S_hf")] == ["", "N s²/m²", "rad"]
