"""The noise model on synthetic errors: variances come back, whitened errors are white, outliers are capped."""

from __future__ import annotations

import numpy as np
import pytest

from dynssm_ros.identification.problem.noise import Noise, NoiseResponse, fit_noise, weights

R, Q, P = np.array([4e-4, 1e-4, 9e-4]), np.array([1e-4, 4e-4, 1e-4]), np.array([9e-4, 1e-4, 4e-4])
TRUE = np.concatenate([R, Q, P])


@pytest.fixture(scope="module")
def response() -> NoiseResponse:
    """400 windows of 6 compared rows whose states decay by a tenth a step."""
    transitions = np.broadcast_to(0.9 * np.eye(3), (400, 6, 3, 3))
    return NoiseResponse.of(transitions, np.linspace(5.0, 30.0, 400))


@pytest.fixture(scope="module")
def errors(response: NoiseResponse) -> np.ndarray:
    """Errors drawn from the model itself."""
    roots = Noise(response, TRUE).roots
    drawn = np.random.default_rng(0).standard_normal((400, 18))
    return np.einsum("wij,wj->wi", roots[response.group], drawn)


def test_windows_of_like_speed_share_their_response(response: NoiseResponse) -> None:
    assert response.G.shape == (10, 18, 21)
    assert np.bincount(response.group).tolist() == [40] * 10
    np.testing.assert_allclose(response.G[0][:3, :3], 0.9 * np.eye(3))
    np.testing.assert_allclose(response.G[0][3:6, 3:6], 0.9 * np.eye(3))


def test_planted_variances_are_the_most_likely_ones(response: NoiseResponse, errors: np.ndarray) -> None:
    found = fit_noise(response, errors, np.full(9, 1e-2), np.full(9, 1e-12))
    np.testing.assert_allclose(found.v, TRUE, rtol=0.35)
    white = found.whiten(errors)
    assert white.var() == pytest.approx(1.0, abs=0.03)
    correlation = np.corrcoef(white.T) - np.eye(18)
    assert np.abs(correlation).max() < 0.2


def test_derivatives_are_whitened_like_errors(response: NoiseResponse, errors: np.ndarray) -> None:
    noise = Noise(response, TRUE)
    stacked = np.stack([errors, 2 * errors], axis=2)
    np.testing.assert_allclose(noise.whiten(stacked)[..., 1], 2 * noise.whiten(errors))


def test_a_far_window_counts_no_more_than_four_times_its_share(response: NoiseResponse, errors: np.ndarray) -> None:
    white = Noise(response, TRUE).whiten(errors)
    assert (weights(white) > 0.99).mean() > 0.98
    white[7] *= 100
    capped = weights(white)[7] * (white[7] ** 2).sum()
    assert capped == pytest.approx(4.0 * 18)
    spoilt = errors.copy()
    spoilt[::50] *= 30.0
    found = fit_noise(response, spoilt, np.full(9, 1e-2), np.full(9, 1e-12))
    assert (found.v / TRUE).max() < 2.5
