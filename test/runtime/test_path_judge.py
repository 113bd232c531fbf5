"""Paths of the online layer are believed while they are better than the plain ones, and only then."""

import numpy as np
import pytest

from dynssm_ros.runtime.coefficients import SPREAD
from dynssm_ros.runtime.online import MEAN_ERROR, Learned, OnlineLayer, OnlineLayerCard, Seen
from dynssm_ros.runtime.path_judge import PathJudge
from dynssm_ros.vehicle import load_vehicle

H = 4
ONE = np.ones(3)
NAMES = ("physics", "increment, 1 steps ago", MEAN_ERROR, "one")


def layer():
    card = OnlineLayerCard(features=NAMES, memory=1000.0, prior_rows=40.0, spread=SPREAD)
    mean, covariance = np.zeros((3, 4)), np.tile(np.eye(4), (3, 1, 1))
    return OnlineLayer(card, mean, covariance, ONE, ONE, ONE, ONE, ONE, load_vehicle("orca"))


def see(windows):
    """A physics that says that nothing changes, with the mean error that it then makes."""
    increments = np.diff(windows[:, :, :3], axis=1)
    zero = np.zeros((len(windows), 3))
    features = np.stack([zero, increments[:, -1], increments.mean(axis=1), zero + 1.0], axis=-1)
    return Seen(features, zero)


def learned(again, limit=np.inf):
    """Weights that repeat the last increment ``again`` times."""
    weights = np.tile([1.0, again, 0.0, 0.0], (1, 3, 1))
    return Learned(weights, np.ones((1, 3)), np.full((1, 3), limit), np.zeros((1, 17)), np.ones(1))


def judged(rows, known):
    judge = PathJudge(layer(), see)
    for k in range(H, len(rows) + 1):
        window = rows[k - H : k]
        judge.step(window, see(window[None]), known)
    return judge


def drive(n=400, swing=0.0, noise=0.0, seed=0):
    t = np.arange(n) * 0.02
    rows = np.zeros((n, 7))
    rows[:, 0] = 2.0 + swing * np.sin(2.0 * t)
    rows[:, 2] = swing * np.cos(2.0 * t)
    rows[:, :3] += noise * np.random.default_rng(seed).standard_normal((n, 3))
    return rows


def test_a_layer_that_leads_astray_is_not_believed():
    judge = judged(drive(noise=0.01), learned(1.4))
    assert judge.comparison.paths == (400 - H) // judge.steps
    assert judge.comparison.advantage < -1.0
    assert not judge.trusted


def test_a_layer_that_knows_better_is_believed():
    judge = judged(drive(swing=1.0), learned(0.98))
    assert judge.comparison.advantage > 0.1
    assert judge.trusted


def test_without_evidence_it_is_believed_and_trust_comes_back():
    judge = PathJudge(layer(), see)
    assert judge.trusted
    known = (learned(1.4), learned(0.98))
    rows = np.concatenate([drive(200, noise=0.01), drive(3000, swing=1.0)])
    believed = []
    for k in range(H, len(rows) + 1):
        window = rows[k - H : k]
        judge.step(window, see(window[None]), known[k > 200])
        believed.append(judge.trusted)
    assert not all(believed[:200])
    assert believed[-1]


def test_what_diverges_counts_as_far_and_not_as_nan():
    with np.errstate(all="ignore"):
        judge = judged(drive(noise=0.01), learned(1e3))
    assert np.isfinite(judge.comparison.advantage)
    assert not judge.trusted


def test_a_gap_drops_the_paths_under_way():
    judge = judged(drive(H + 10, swing=1.0), learned(0.98))
    assert judge.comparison.paths == 0
    judge.interrupt()
    rows = drive(H + judge.steps - 1, swing=1.0)
    for k in range(H, len(rows) + 1):
        judge.step(rows[k - H : k], see(rows[None, k - H : k]), learned(0.98))
    assert judge.comparison.paths == 0
    judge.reset()
    assert judge.trusted


@pytest.mark.parametrize("gap", [False, True])
def test_along_a_recording_it_is_what_it_is_live(gap):
    rows, known = drive(noise=0.01), learned(1.4)
    ends = np.arange(H - 1, 400)
    if gap:
        ends = np.delete(ends, 100)
    windows = np.stack([rows[k - H + 1 : k + 1] for k in ends])
    whole = Learned(*(np.repeat(part, len(ends), axis=0) for part in known))
    along = PathJudge(layer(), see).along(windows, ends, whole, see(windows))
    assert along[0] == 1.0
    assert along[-1] == 0.0
    live, blocks, expected = PathJudge(layer(), see), PathJudge(layer(), see), []
    for end, window in zip(ends, windows, strict=True):
        if gap and end == 101:
            live.interrupt()
        live.step(window, see(window[None]), known)
        expected.append(live.trusted)
    np.testing.assert_array_equal(along, expected)
    for begin in range(0, len(ends), 71):
        block = slice(begin, begin + 71)
        found = blocks.along(windows[block], ends[block], whole.at(np.arange(len(ends))[block]), see(windows[block]))
        np.testing.assert_array_equal(found, along[block])
    assert blocks.comparison.advantage == pytest.approx(live.comparison.advantage, abs=1e-12)
    assert blocks.comparison.paths == live.comparison.paths
