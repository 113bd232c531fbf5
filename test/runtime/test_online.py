"""The online layer: equal to closed forms, finds planted weights, keeps its head, states honest intervals, is kept."""

import dataclasses

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from dynssm_ros.errors import ArtifactError
from dynssm_ros.runtime.along import Along
from dynssm_ros.runtime.coefficients import SPREAD
from dynssm_ros.runtime.online import OnlineLayer, OnlineLayerCard, Seen, load_layer, save_layer
from dynssm_ros.vehicle import load_vehicle

N = 4
SCALE = np.array([0.1, 0.02, 0.3])
ROWS = np.tile([1.5, 0.0, 0.0, 0.2, 0.0, 0.0, 0.0], (5000, 1))


def make_layer(memory=1e12, prior_rows=10.0, noise=1e-2, mean=None):
    card = OnlineLayerCard(features=("physics", "a", "b", "one"), memory=memory, prior_rows=prior_rows, spread=SPREAD)
    prior = np.tile([1.0, 0.0, 0.0, 0.0], (3, 1)) if mean is None else mean
    covariance = np.tile(np.eye(N) / prior_rows, (3, 1, 1))
    one = np.ones(3)
    return OnlineLayer(card, prior, covariance, np.full(3, noise), one, one, one, SCALE, load_vehicle("orca"))


def drive(layer, features, weights, noise, rng):
    targets = np.einsum("kci,ci->kc", features, weights) + noise * rng.standard_normal((len(features), 3))
    seen = Seen(features, features[:, :, 0] * SCALE)
    return Along(layer).over(seen, ROWS[: len(features)], targets * SCALE, np.arange(len(features))), targets


def learn(state, features, target):
    """One step with features ``(3, n)`` and a target in units of s_delta."""
    state.update(Seen(features, features[:, 0] * SCALE), ROWS[0], target * SCALE)


def test_without_forgetting_it_is_the_bayesian_regression_of_all_rows():
    rng = np.random.default_rng(0)
    layer, features = make_layer(noise=100.0), rng.standard_normal((60, 3, N))  # no error is an outlier
    targets = np.einsum("kci,i->kc", features, [0.5, 1.0, -1.0, 0.2]) + 0.1 * rng.standard_normal((60, 3))
    state = layer.start()
    state._forget = 0.0  # the noise stays as it is
    for row, target in zip(features, targets, strict=True):
        learn(state, row, target)
    for c in range(3):
        X = features[:, c]
        precision = X.T @ X / 100.0 + 10.0 * np.eye(N)
        mean = np.linalg.solve(precision, X.T @ targets[:, c] / 100.0 + 10.0 * layer.mean[c])
        np.testing.assert_allclose(state.mean[c], mean, rtol=1e-6)
        np.testing.assert_allclose(state.covariance[c], np.linalg.inv(precision), rtol=1e-6, atol=1e-12)


def test_it_finds_planted_weights_and_changed_ones():
    rng = np.random.default_rng(1)
    features = rng.standard_normal((4000, 3, N))
    before, after = np.full((3, N), 0.3), np.full((3, N), -0.2)
    layer = make_layer(memory=400.0)
    first, _ = drive(layer, features[:2000], before, 0.1, rng)
    np.testing.assert_allclose(first.weights[-1], before, atol=0.05)
    state = layer.start()
    for weights, part in ((before, features[:2000]), (after, features[2000:])):
        for row in part:
            target = (row * weights).sum(1) + 0.1 * rng.standard_normal(3)
            learn(state, row, target)
    np.testing.assert_allclose(state.mean, after, atol=0.06)


def test_the_stated_variance_knows_that_the_weights_move_until_the_next_step():
    layer = make_layer(memory=2.0, noise=1e-12)
    state, row = layer.start(), np.ones((3, N))
    for _ in range(5):
        learn(state, row, np.ones(3))
    moved = -np.expm1(-2 * layer.T_s / 2.0) * np.einsum("i,cij,j->c", row[0], layer.covariance, row[0])
    stated = state.variance(row) / (state.width**2 * state.recent)
    assert np.all(stated >= moved)


def test_without_excitation_it_returns_to_the_prior():
    rng = np.random.default_rng(2)
    layer = make_layer(memory=2.0)
    state = layer.start()
    for row in rng.standard_normal((200, 3, N)):
        learn(state, row, np.zeros(3))
    assert np.abs(state.mean - layer.mean).max() > 0.5
    for _ in range(2000):
        learn(state, np.zeros((3, N)), np.zeros(3))
    np.testing.assert_allclose(state.mean, layer.mean, atol=1e-6)
    np.testing.assert_allclose(state.covariance, layer.covariance, atol=1e-6)


def test_an_outlier_moves_the_weights_little_and_no_nan_gets_in():
    rng = np.random.default_rng(3)
    layer = make_layer()
    state = layer.start()
    for row in rng.standard_normal((300, 3, N)):
        learn(state, row, row[:, 0] + 0.1 * rng.standard_normal(3))
    kept = state.mean.copy()
    row = rng.standard_normal((3, N))
    learn(state, row, np.full(3, 100.0) / SCALE)
    assert np.abs(state.mean - kept).max() < 0.02
    for bad in (np.nan, np.inf):
        kept, steps = state.mean.copy(), state.steps
        learn(state, row, np.array([0.0, bad, 0.0]))
        assert (state.steps, np.array_equal(kept, state.mean)) == (steps, True)


@pytest.mark.parametrize("kind", ["gaussian", "heavy", "smooth"])
@pytest.mark.parametrize("size", [1.0, 1e-5])
def test_its_90_percent_intervals_cover_90_percent(kind, size):
    rng = np.random.default_rng(4)
    layer = make_layer(noise=1.0)
    features = rng.standard_normal((5000, 3, N))
    errors = {
        "gaussian": rng.standard_normal((5000, 3)),
        "heavy": rng.standard_t(2.5, (5000, 3)),
        "smooth": np.sin(np.arange(5000)[:, None] / [17.0, 31.0, 59.0]),
    }[kind]
    growing = size * np.linspace(0.02, 0.2, 5000)[:, None]
    targets = features[:, :, 0] + errors * growing  # the prior's noise is wrong
    learned = Along(layer).over(Seen(features, features[:, :, 0] * SCALE), ROWS, targets * SCALE, np.arange(5000))
    missed = targets - np.einsum("kci,kci->kc", features, learned.weights)
    covered = np.mean(np.abs(missed) <= 1.6448536 * np.sqrt(learned.variance), axis=0)
    assert np.all(np.abs(covered - 0.9) < 0.02)


def test_what_was_known_at_a_row_does_not_depend_on_what_came_after():
    rng = np.random.default_rng(5)
    layer, features = make_layer(), rng.standard_normal((50, 3, N))
    increments = rng.standard_normal((50, 3))
    whole = Along(layer).over(Seen(features, increments), ROWS[:50], increments, np.arange(50))
    half = Along(layer).over(Seen(features[:25], increments[:25]), ROWS[:25], increments[:25], np.arange(25))
    np.testing.assert_array_equal(whole.weights[:25], half.weights)
    np.testing.assert_array_equal(whole.variance[:25], half.variance)
    along = Along(layer)
    parts = [
        along.over(Seen(features[part], increments[part]), ROWS[:50][part], increments[part], np.arange(50)[part])
        for part in (slice(0, 20), slice(20, 50))
    ]
    np.testing.assert_array_equal(whole.weights, np.concatenate([part.weights for part in parts]))


def test_a_step_across_a_gap_is_not_learned():
    rng = np.random.default_rng(6)
    layer, features = make_layer(), rng.standard_normal((3, 3, N))
    learned = Along(layer).over(Seen(features, np.ones((3, 3))), ROWS[:3], np.ones((3, 3)), np.array([4, 7, 8]))
    np.testing.assert_array_equal(learned.weights[1], layer.mean)
    assert not np.array_equal(learned.weights[2], layer.mean)


def test_in_rollouts_it_adds_no_more_than_the_physics_erred_lately():
    layer = make_layer()
    state = layer.start()
    for _ in range(8000):
        learn(state, np.zeros((3, N)), np.full(3, 0.01))
    np.testing.assert_allclose(state.limit, 0.03, rtol=0.01)
    bounded = layer.bounded(np.array([[9.0, -9.0, 0.001]]), np.zeros((1, 3)), state.limit)
    np.testing.assert_allclose(bounded, [[0.03 * 0.1, -0.03 * 0.02, 0.001]], rtol=0.01)


def test_what_was_learned_is_kept_and_belongs_to_its_prior(tmp_path):
    rng = np.random.default_rng(7)
    layer, file = make_layer(), tmp_path / "state"
    state = layer.start()
    for row in rng.standard_normal((30, 3, N)):
        learn(state, row, row[:, 1])
    write, names = state.writer(file, "mine"), ("mean", "covariance", "noise", "physics", "recent", "width")
    expected = [getattr(state, name).copy() for name in names]
    learn(state, np.ones((3, N)), np.ones(3))  # before another thread has come to it
    write()
    other = layer.start()
    other.load(file, "mine")
    assert other.steps == 30
    for name, value in zip(names, expected, strict=True):
        np.testing.assert_array_equal(getattr(other, name), value)
    with pytest.raises(ArtifactError, match="learned by another model"):
        other.load(file, "yours")
    save_file({name: value for name, value in load_file(file).items() if name != "recent"}, file, {"prior": "mine"})
    other.load(file, "mine")
    np.testing.assert_array_equal(other.recent, np.ones(3))
    file.write_bytes(b"rubbish")
    with pytest.raises(ArtifactError, match="not a readable online state"):
        other.load(file, "mine")
    wider = dataclasses.replace(layer, mean=np.zeros((3, 5)), covariance=np.zeros((3, 5, 5))).start()
    state.writer(file, "mine")()
    with pytest.raises(ArtifactError, match="of another shape"):
        wider.load(file, "mine")


@pytest.mark.parametrize(
    ("name", "change", "expected"),
    [
        ("mean", lambda prior: prior * 1e30, "mean is as large as 1e+30; expected at most 1e+06"),
        ("covariance", lambda prior: -prior, "covariance has the eigenvalue -0.1; expected none below zero"),
        ("noise", lambda prior: 0.0 * prior, "noise = 0; expected variances above zero"),
        ("mean", lambda prior: prior[:2], "mean is missing, not finite or of another shape"),
    ],
)
def test_an_absurd_prior_is_refused(tmp_path, name, change, expected):
    layer, path = make_layer(), tmp_path / "online.safetensors"
    how = {"scale": SCALE, "vehicle": layer.vehicle, "integrator": "euler", "substeps": 1}
    save_layer(layer, path)
    np.testing.assert_array_equal(load_layer(path.read_bytes(), path, layer.card, **how).mean, layer.mean)
    save_layer(dataclasses.replace(layer, **{name: change(getattr(layer, name))}), path)
    with pytest.raises(ArtifactError) as refused:
        load_layer(path.read_bytes(), path, layer.card, **how)
    assert expected in str(refused.value)
