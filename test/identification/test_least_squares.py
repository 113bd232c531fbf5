"""The bounded robust fit, and what it says of the loss."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest
from scipy import optimize

from dynssm_ros.learning.least_squares import Loss, influence, least_squares

Vector = np.ndarray
LOSSES = get_args(Loss)
TRUTH = np.array([0.7, 0.4, 0.3, 0.6])


def curve(p: Vector) -> Vector:
    t = np.linspace(0, 1, 200)
    return p[0] * np.exp(-5 * p[1] * t) + p[2] * np.sin(8 * p[3] * t)


def noisy(p: Vector) -> Vector:
    """Residuals of a curve of four parameters, with noise and three outliers."""
    noise = np.random.default_rng(3).standard_normal(200)
    noise[[10, 50, 120]] += 30.0
    return 20 * (curve(p) - curve(TRUTH)) - noise


def test_outliers_do_not_move_a_robust_fit() -> None:
    plain, robust = (least_squares(noisy, TRUTH, loss, 1e-12, 100).p for loss in ("linear", "cauchy"))
    assert np.abs(robust - TRUTH).max() < 0.5 * np.abs(plain - TRUTH).max()


def test_a_minimum_outside_is_met_at_the_bound_and_the_others_adjust() -> None:
    A = np.array([[1.0, 1.0], [0.0, 0.1]])
    found = least_squares(lambda p: A @ (p - [2.0, 0.1]), np.array([0.5, 0.5]), "linear", 1e-14, 100)
    # with p_0 = 1 the rest is min (p_1 - 1.1)^2 + (0.1 (p_1 - 0.1))^2
    np.testing.assert_allclose(found.p, [1.0, min(1.0, (1.1 + 0.01 * 0.1) / 1.01)], atol=1e-6)


def test_exact_data_are_fitted_to_the_last_digits() -> None:
    found = least_squares(lambda p: 1e6 * (curve(p) - curve(TRUTH)), np.full(4, 0.5), "soft_l1", 1e-14, 200)
    np.testing.assert_allclose(found.p, TRUTH, atol=1e-12)


@pytest.mark.parametrize("loss", LOSSES)
def test_psi_and_its_slope_are_the_derivatives_of_scipys_cost(loss: Loss) -> None:
    at = np.array([0.1, 0.9, 0.6, 0.2])
    here, h = influence(noisy, at, loss), 1e-6

    def cost(p: Vector) -> float:
        bounds = (p - 1e-12, p + 1e-12)  # scipy's cost of the point itself
        return optimize.least_squares(noisy, p, bounds=bounds, loss=loss, max_nfev=1).cost

    for k in range(4):
        moved = np.eye(4)[k] * h
        expected = (cost(at + moved) - cost(at - moved)) / (2 * h)
        assert here.jacobian[k] @ here.psi == pytest.approx(expected, rel=1e-3)
    if loss not in ("huber", "cauchy"):  # whose slopes have a kink or are cut off at 0
        ahead = influence(lambda p: noisy(p) + h, at, loss).psi
        behind = influence(lambda p: noisy(p) - h, at, loss).psi
        np.testing.assert_allclose(here.slope, (ahead - behind) / (2 * h), rtol=1e-4, atol=1e-7)
    assert (here.slope >= 0).all()
