"""The Gaussian process on the physics' errors: planted processes are found, a car that has changed is learned."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.rivals import gp
from dynssm_ros.evaluation.open_loop import evaluate
from dynssm_ros.learning.export import save_artifact
from dynssm_ros.learning.models.base import ModelConfig
from dynssm_ros.learning.stages import train
from dynssm_ros.runtime.baselines import SingleTrack
from dynssm_ros.runtime.onnx_model import OnnxModel
from dynssm_ros.signals.recording import Recording
from dynssm_ros.vehicle import Vehicle

MakeConfig = Callable[..., ModelConfig]
GP = {"kind": "gp", "history": 0.2, "physics": {"nominal": "vehicle"}}


@pytest.mark.slow
def test_a_changed_car_is_learned_to_a_fraction_of_the_physics_errors(
    make_fitted: MakeConfig, drive: Callable[..., Recording], orca: Vehicle, tmp_path: Path
) -> None:
    changed = drive(orca.with_effect("front_grip", {"factor": 0.9}), 3000)
    laps, held = changed.split_last(0.3)
    trained = train(laps, make_fitted(**GP), orca, tmp_path / "c.pt")
    model = OnnxModel(save_artifact(trained, tmp_path / "model"))  # which compares the graph with torch
    scores = evaluate(held, {"gp": model, "physics": SingleTrack(orca, "euler")}, calls=1).scores
    assert np.all(scores["gp"].rmse[1:] < 0.3 * scores["physics"].rmse[1:])
    assert scores["gp"].rollout.ade < 0.3 * scores["physics"].rollout.ade


@pytest.mark.slow
def test_where_the_physics_is_exact_nothing_is_added(
    make_fitted: MakeConfig, laps: Recording, orca: Vehicle, tmp_path: Path
) -> None:
    trained = train(laps.select(slice(0, len(laps) // 2)), make_fitted(**GP), orca, tmp_path / "c.pt")
    assert np.all(np.array(trained.validation_rmse) < 1e-4)


@pytest.mark.slow
def test_inputs_without_a_say_get_long_scales() -> None:
    draw = torch.Generator().manual_seed(0)
    x = torch.randn(300, gp.INPUTS, generator=draw).double()
    error = torch.sin(2.0 * x[:, 1]) + 0.1 * torch.randn(300, generator=draw)
    lengths, _, noise = gp._over_states_fitted(x, error)
    assert lengths[1] < 2.0
    assert lengths[[0, 2, 3, 4]].min() > 3.0 * lengths[1]
    assert noise.sqrt() == pytest.approx(0.1, rel=0.3)


def test_the_filter_over_time_is_the_best_one_of_the_planted_process() -> None:
    rng = np.random.default_rng(0)
    L, memory, slow, noise = 15, 8.0, 0.6, 0.5
    lag = np.abs(np.subtract.outer(np.arange(L), np.arange(L)))
    K = slow**2 * np.exp(-lag / memory) + noise**2 * np.eye(L)
    errors = rng.multivariate_normal(np.zeros(L), K, 2000)
    found = gp._filter_fitted(torch.tensor(errors)).numpy()
    best = np.linalg.solve(K, slow**2 * np.exp(-np.arange(L, 0, -1) / memory))
    np.testing.assert_allclose(found, best, atol=0.02)


def test_inducing_points_lie_apart() -> None:
    x = torch.cat([torch.zeros(50, 5), torch.ones(1, 5), -torch.ones(1, 5)]).double()
    assert {tuple(row) for row in gp._spread_out(x, 3).tolist()} == {(0.0,) * 5, (1.0,) * 5, (-1.0,) * 5}
    assert gp._spread_out(x[:2], 4).shape == (4, 5)
