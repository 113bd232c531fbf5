"""What a network beside the online layer could earn: the learners find a planted bend, and the ratios are what they say."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from benchmarks import network
from benchmarks.fold_tables import by_group, mean_over, tables
from benchmarks.network import Scored, Study, ratios
from dynssm_ros.runtime.features import throttle_steps
from dynssm_ros.signals.recording import Recording
from dynssm_ros.vehicle import Vehicle


@pytest.mark.parametrize("fit", [network.ridge, network.trees, network.network])
def test_learners_find_a_planted_bend(fit: Any) -> None:
    torch.set_num_threads(1)
    rng = np.random.default_rng(0)
    windows = np.zeros((1600, 1, 7))
    windows[:, 0, 3] = rng.uniform(-0.3, 0.3, 1600)
    windows[:, 0, 5] = rng.uniform(-0.1, 0.1, 1600)  # what is applied is the sum
    applied = windows[:, 0, 3] + windows[:, 0, 5]
    bend = np.stack([np.maximum(applied, 0.0) / 0.1, np.where(np.abs(applied) < 0.05, 1.0, 0.0), 0.0 * applied], axis=1)
    wanted = bend - bend.mean(axis=0) + 0.3 * rng.standard_normal(bend.shape)
    X = throttle_steps(windows)
    predict = fit(X[:1200], wanted[:1200])
    left = wanted[1200:] - predict(X[1200:])
    assert (left.std(axis=0)[:2] < 0.4).all()
    assert left.std(axis=0)[2] < 0.33, "nothing is found in noise"


def test_ratios_are_of_one_step_and_of_paths() -> None:
    alone = Scored(np.array([1.0, 2.0, 3.0]), np.ones(3), np.array([[1.0, 2.0, 4.0], [3.0, 2.0, 4.0]]))
    ours = Scored(np.array([0.5, 2.0, 6.0]), np.full(3, 0.6), np.array([[1.0, 1.0, 4.0], [1.0, 1.0, 8.0]]))
    np.testing.assert_allclose(ratios(ours, alone), [1.0, 0.5, 0.5, 1.5, 0.6])
    text = tables({"putnam_1": {"ridge": [1.0, 0.9, 0.8, 0.7, 0.6]}, "putnam_2": {"ridge": [1.0, 0.9, 0.2, 0.7, 0.6]}})
    assert "| ridge | 1.000 | 0.900 | 0.400 | 0.700 | 0.600 | 0.800 | 0.200 |" in text


def test_the_mean_its_interval_and_the_largest_ratio_are_told_of_each_group() -> None:
    values = {"same_a": 0.5, "same_b": 2.0, "same_c": 1.0, "season_d": 3.0}
    text = by_group({name: {"steps": [value, *[1.0] * 4]} for name, value in values.items()})
    ones = " | ".join(["1.000 (1.000-1.000)"] * 4)
    assert f"| same | 3 | steps | 1.000 (0.500-2.000) | {ones} | 2.000 (b, one step) |" in text
    assert "| season | 1 | steps | 3.000 (3.000-3.000) |" in text


def test_the_interval_of_a_mean_narrows_with_the_folds() -> None:
    few, many = (mean_over(np.exp(np.random.default_rng(0).normal(0.1, 0.1, size))) for size in (8, 200))
    assert many[1] < np.exp(0.1) < many[2]
    assert many[2] - many[1] < 0.5 * (few[2] - few[1])


def test_development_and_test_folds_are_apart(data: Path) -> None:
    develop, test = (set(network.further_folds(data, marked)) for marked in (False, True))
    assert not develop & test
    assert {"season_circles_0904_1237", "season_steering_identification_0925_0957"} <= test, "as the data's README says"
    assert "season_circles_0904_1100" in develop


def test_a_learner_that_adds_nothing_changes_nothing_and_the_truth_leaves_less(
    drive: Any, orca: Vehicle, study_of: Callable[..., Study], pushed: Callable[..., Recording]
) -> None:
    noise = (0.003, 0.003, 0.02)
    training, left_out = (drive(orca, 800, seed=seed, noise=noise) for seed in (0, 1))
    steady = np.where(np.arange(len(left_out)) % 20 < 10, 0.01, -0.01)  # pushes of v_x that no layer follows at once
    left_out = pushed(left_out, steady)
    study = study_of(training, left_out)
    features = study.base.features(False)
    layer, stretches = study.fitted(features)
    assert len(stretches) == study.base.config.folds
    trusted = network.judged(study, features, layer)
    alone = network.score(study, features, layer, trusted)
    nothing = network.score(study, features, layer, trusted, lambda windows, seen: np.zeros((len(windows), 3)))
    np.testing.assert_array_equal(alone.rmse, nothing.rmse)
    np.testing.assert_array_equal(alone.distances, nothing.distances)
    ends = left_out.window_ends(study.base.H, min_speed=orca.minimum_speed)
    at = {row.tobytes(): steady[end + 1] for row, end in zip(left_out.matrix[ends], ends, strict=True)}

    def truth(windows: np.ndarray, seen: object) -> np.ndarray:
        return np.stack([[at.get(window[-1].tobytes(), 0.0), 0.0, 0.0] for window in windows])

    assert network.score(study, features, layer, trusted, truth).rmse[0] < 0.7 * alone.rmse[0]
