"""Rollouts and displacement against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from dynssm_ros.evaluation.rollout import branches, score_rollouts
from dynssm_ros.runtime.baselines import Persistence
from dynssm_ros.runtime.contract import WindowPrediction
from dynssm_ros.runtime.predictor import propagate_pose
from dynssm_ros.runtime.rollout import roll_out, step_of
from dynssm_ros.vehicle.kinematics import path

T_s = 0.04


def next_state(row):
    """A stable planted map ``s_{t+1} = f(s_t, fb_t, u_t)``; ``row`` has shape (..., 7)."""
    s, u = row[..., :3], row[..., 3:5] + row[..., 5:7]
    mixed = 0.9 * s + 0.05 * np.roll(s, 1, axis=-1)
    return mixed + np.stack([u[..., 0], u[..., 1], u[..., 0] * u[..., 1]], axis=-1)


@pytest.fixture
def planted():
    """A run that follows ``next_state`` exactly, shape (120, 7)."""
    rng = np.random.default_rng(3)
    matrix = np.concatenate([np.zeros((120, 3)), rng.normal(scale=0.3, size=(120, 4))], axis=1)
    matrix[0, :3] = [20.0, 0.1, 0.2]
    for k in range(119):
        matrix[k + 1, :3] = next_state(matrix[k])
    return matrix


class Truth:
    """Knows the planted map, from a window of ``H`` rows; remembers its windows."""

    online = None

    def __init__(self, H=3, bias=0.0):
        self.H, self.bias, self.seen = H, bias, []

    def predict(self, windows):
        self.seen.append(windows.copy())
        return WindowPrediction(next_state(windows[:, -1]) + self.bias, None, None)


def test_perfect_model_has_no_error_at_any_step(planted, recorded):
    scored = score_rollouts(Truth(), recorded(planted), np.arange(2, 100), 15)
    np.testing.assert_array_equal(scored.rmse, 0.0)
    assert scored.ade == scored.fde == 0.0
    assert scored.time[-1] == pytest.approx(0.6)


def test_states_are_fed_back_and_feedback_and_commands_are_the_measured_ones(planted):
    model = Truth(H=3, bias=0.5)
    stretch = planted[10:18]  # start in row 12, five steps ahead
    predicted = roll_out(step_of(model), stretch[None], 3)[0]
    for k, window in enumerate(model.seen):
        np.testing.assert_array_equal(window[0, :, 3:], planted[10 + k : 13 + k, 3:])
    np.testing.assert_array_equal(model.seen[0][0, :, :3], planted[10:13, :3])
    np.testing.assert_array_equal(model.seen[4][0, :, :3], predicted[1:4])
    np.testing.assert_array_equal(stretch, planted[10:18])  # what was measured stays


def test_longer_stretches_serve_models_with_shorter_windows(planted):
    stretches = planted[None, 10:30]
    long, short = roll_out(step_of(Truth(H=15)), stretches, 15), roll_out(step_of(Truth(H=1)), stretches[:, 14:], 1)
    np.testing.assert_array_equal(long, short)


def test_batches_score_the_same_as_one_go(planted, recorded, monkeypatch):
    starts = np.arange(2, 100)
    whole = score_rollouts(Truth(bias=0.1), recorded(planted), starts, 10)
    monkeypatch.setattr("dynssm_ros.evaluation.metrics.BATCH", 7)
    batched = score_rollouts(Truth(bias=0.1), recorded(planted), starts, 10)
    np.testing.assert_allclose(whole.rmse, batched.rmse, rtol=1e-12)
    np.testing.assert_allclose(whole.displacement, batched.displacement, rtol=1e-12)
    assert whole.starts == batched.starts == len(starts)


def test_persistence_under_constant_acceleration_errs_by_half_a_t_squared(recorded):
    a, n = 4.0, 15
    matrix = np.zeros((60, 7))
    matrix[:, 0] = 10.0 + a * T_s * np.arange(60)
    scored = score_rollouts(Persistence(), recorded(matrix), np.arange(40), n)
    np.testing.assert_allclose(scored.rmse[:, 0], a * scored.time, rtol=1e-12)
    np.testing.assert_allclose(scored.displacement, a * scored.time**2 / 2, rtol=1e-12)
    assert scored.fde == pytest.approx(a * 0.6**2 / 2)
    assert scored.ade == pytest.approx(np.mean(a * scored.time**2 / 2))


def test_branches_of_a_perfect_model_lie_on_the_measured_path(planted, recorded):
    starts, steps = np.array([20, 30, 45]), 10
    driven = np.concatenate([np.zeros((1, 2)), path(planted[20:56, :3], T_s)])
    for start, branch in zip(starts, branches(Truth(), recorded(planted), starts, steps), strict=True):
        np.testing.assert_allclose(branch, driven[start - 20 : start - 20 + steps + 1], atol=1e-12)


def test_branches_leave_the_measured_path_by_the_error_of_the_rollout(planted, recorded):
    starts, steps = np.arange(5, 65, 10), 10
    model = Truth(bias=0.1)
    driven = np.concatenate([np.zeros((1, 2)), path(planted[5:66, :3], T_s)])
    apart = branches(model, recorded(planted), starts, steps) - driven[(starts - 5)[:, None] + np.arange(steps + 1)]
    np.testing.assert_allclose(apart[:, 0], 0.0, atol=1e-12)
    scored = score_rollouts(model, recorded(planted), starts, steps)
    np.testing.assert_allclose(np.linalg.norm(apart[:, 1:], axis=2).mean(axis=0), scored.displacement, rtol=1e-9)


def test_path_of_constant_velocity_is_the_polygon_inside_a_circle():
    v, omega, n = 20.0, 0.5, 200
    driven = path(np.tile([v, 0.0, omega], (n + 1, 1)), T_s)
    # chords of length v T_s, each turned by omega T_s, have their corners on a circle of this radius
    radius = v * T_s / (2 * np.sin(omega * T_s / 2))
    turned = omega * T_s * np.arange(1, n + 1)
    np.testing.assert_allclose(driven, radius * np.stack([np.sin(turned), 1 - np.cos(turned)], axis=1), atol=1e-9)
    assert radius == pytest.approx(v / omega, rel=(omega * T_s) ** 2 / 20)


def test_path_turns_body_velocities_to_the_left_for_positive_v_y():
    np.testing.assert_allclose(path(np.tile([3.0, 4.0, 0.0], (11, 1)), 0.1)[-1], [3.0, 4.0])


def test_path_follows_the_live_predictor_s_rule():
    velocities = np.random.default_rng(0).normal(size=(9, 3))
    pose = (0.0, 0.0, 0.0)
    for k, driven in enumerate(path(velocities, T_s)):
        start = dict(zip(("x", "y", "theta"), pose, strict=True))
        pose = propagate_pose(start, velocities[k], velocities[k + 1], T_s)
        np.testing.assert_allclose(driven, pose[:2], atol=1e-14)
