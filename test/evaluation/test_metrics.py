"""One-step measures against planted truths."""

from __future__ import annotations

import numpy as np
import pytest

from dynssm_ros.evaluation import metrics
from dynssm_ros.runtime.baselines import Persistence
from dynssm_ros.runtime.contract import WindowPrediction


@pytest.fixture
def rng():
    return np.random.default_rng(7)


class Average:
    """Predicts the mean state of its window; remembers the shapes it was called with."""

    H = 4
    online = None

    def __init__(self):
        self.shapes = []

    def predict(self, windows):
        self.shapes.append(windows.shape)
        return WindowPrediction(windows[:, :, :3].mean(axis=1), windows[:, -1, :1] * np.ones(17), None)


def test_batches_predict_the_same_as_one_go(rng, recorded, monkeypatch):
    matrix, rows = rng.normal(size=(101, 7)), np.arange(3, 100)
    (whole,) = metrics.predict_rows(Average(), recorded(matrix), rows)
    monkeypatch.setattr(metrics, "BATCH", 8)
    batched = list(metrics.predict_rows(Average(), recorded(matrix), rows))
    np.testing.assert_array_equal(whole.state, np.concatenate([each.state for each in batched]))
    np.testing.assert_array_equal(whole.theta, np.concatenate([each.theta for each in batched]))
    np.testing.assert_allclose(whole.state[10], matrix[10:14, :3].mean(axis=0))
    assert all(each.physics is None for each in batched)


def test_windows_exist_for_one_batch_only(rng, recorded, monkeypatch):
    model, done = Average(), []
    monkeypatch.setattr(metrics, "BATCH", 40)
    predictions = metrics.predict_rows(model, recorded(rng.normal(size=(101, 7))), np.arange(3, 100), tick=done.append)
    next(predictions)
    assert model.shapes == [(40, 4, 7)]
    assert [len(each.state) for each in predictions] == [40, 17]
    assert model.shapes == [(40, 4, 7), (40, 4, 7), (17, 4, 7)]
    assert done == [40, 40, 17]


def test_rmse_of_planted_errors():
    errors = np.array([[3.0, 0.0, -1.0], [-4.0, 0.0, 1.0]])
    np.testing.assert_allclose(metrics.rmse(errors), [np.sqrt(12.5), 0.0, 1.0])


def test_rmse_of_persistence_is_the_rms_of_the_increments(rng, recorded):
    matrix, rows = rng.normal(size=(50, 7)), np.arange(49)
    (predicted,) = metrics.predict_rows(Persistence(), recorded(matrix), rows)
    increments = np.diff(matrix[:, :3], axis=0)
    np.testing.assert_allclose(metrics.rmse(predicted.state - matrix[1:, :3]), np.sqrt(np.mean(increments**2, axis=0)))


def test_explained_is_one_for_truth_zero_for_persistence_and_nan_without_change(rng):
    increments = rng.normal(size=(100, 3)) * [1.0, 2.0, 0.0]
    np.testing.assert_array_equal(metrics.explained(increments, increments), [1.0, 1.0, np.nan])
    np.testing.assert_array_equal(metrics.explained(increments, 0 * increments)[:2], [0.0, 0.0])
    assert metrics.explained(increments, -increments)[0] == pytest.approx(-3.0)


def test_honest_gaussian_variances_cover_ninety_percent(rng):
    variances = np.array([0.04, 1e-4, 9.0])
    errors = rng.normal(size=(40_000, 3)) * np.sqrt(variances)
    three_sigma = 3 * np.sqrt(0.9 * 0.1 / len(errors))
    np.testing.assert_allclose(metrics.coverage(errors, variances), 0.9, atol=three_sigma)
    assert (metrics.coverage(errors, variances / 4) < 0.65).all()


def test_latency_times_single_windows_after_the_warm_up(rng):
    model = Average()
    samples = metrics.latency_us(model, rng.normal(size=(5, 4, 7)), calls=30)
    assert samples.shape == (30,)
    assert (samples > 0).all()
    assert model.shapes == [(1, 4, 7)] * 50
