"""Features that are learned for being learned with: the filter is that of a regression, and what changes is followed."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from benchmarks import meta_features
from benchmarks.meta_features import Meta, features_of, trained


def test_the_filter_ends_where_a_regression_with_its_prior_does() -> None:
    torch.manual_seed(1)
    model = Meta(2, adapts=True)
    with torch.no_grad():
        model.walk.fill_(-50.0)
    seen, left = torch.rand(1, 40, meta_features.FEATURES), 0.5 * torch.rand(1, 41, 3)
    with torch.no_grad():
        known, errors = model.follow(torch.cat([seen, seen[:, :1]], 1), left)
    X, Y = seen[0].numpy(), left[0, :40].numpy()
    expected = np.linalg.solve(X.T @ X + np.exp(2.0) * np.eye(X.shape[1]), X.T @ Y)
    np.testing.assert_allclose(known[0, -1].numpy(), expected, atol=1e-3)
    np.testing.assert_allclose(errors[0, -1].numpy(), left[0, -1].numpy() - X[0] @ expected, atol=1e-3)


def test_what_differs_from_drive_to_drive_is_learned_on_the_drive(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(meta_features, "_ROUNDS", 60)
    rng = np.random.default_rng(0)
    inputs = [rng.uniform(-1.0, 1.0, (300, 2)) for _ in range(8)]
    signs = np.array([1, -1] * 4)
    left = [
        sign * np.tile(np.sign(x[:, :1]), 3) + 0.1 * rng.standard_normal((300, 3))
        for sign, x in zip(signs, inputs, strict=True)
    ]

    def rest(adapts: bool) -> float:
        model = trained(inputs[:6], left[:6], 60, adapts=adapts)
        seen = torch.tensor(features_of(model, inputs[7]), dtype=torch.float32)[None]
        with torch.no_grad():
            _, errors = model.follow(seen, torch.tensor(left[7], dtype=torch.float32)[None])
        return float(errors[0, 60:].std())

    assert rest(adapts=True) < 0.5
    assert rest(adapts=False) > 0.9
