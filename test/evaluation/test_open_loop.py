"""Evaluations: fairness, the JSON contract, and what is refused."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from dynssm_ros.errors import ArtifactError, RecordingError
from dynssm_ros.evaluation.open_loop import evaluate, shared_commands
from dynssm_ros.runtime.baselines import Persistence, SingleTrack
from dynssm_ros.runtime.contract import WindowPrediction
from dynssm_ros.signals.extraction import extract
from dynssm_ros.signals.signal_map import load_signal_map
from dynssm_ros.vehicle import load_vehicle


@pytest.fixture
def recording(recorded):
    rng = np.random.default_rng(5)
    walk = np.cumsum(rng.normal(size=(300, 3)) * [0.05, 0.01, 0.002], axis=0)
    return recorded(walk + np.array([20.0, 0.0, 0.1]))


class Model:
    """Predicts the present state plus ``offset``."""

    parameters, flops, vehicle, card, origin, online = 123, 456, None, None, "the present state", None

    def __init__(self, H=1, offset=0.0, T_s=0.0, commands=None, variance=None, name="model"):
        self.H, self.offset, self.T_s, self.commands, self.name = H, offset, T_s, commands, name
        self.variance = variance

    def predict(self, windows):
        variance = None if self.variance is None else np.tile(self.variance, (len(windows), 1))
        return WindowPrediction(windows[:, -1, :3] + self.offset, None, None, variance)


def test_all_models_are_scored_on_the_rows_that_the_longest_window_allows(recording):
    alone = evaluate(recording, {"short": Model(H=1)}, calls=3)
    together = evaluate(recording, {"short": Model(H=1), "long": Model(H=40)}, calls=3)
    assert alone.rows[0] == 0
    assert together.rows[0] == 39
    short, long = together.scores.values()
    np.testing.assert_array_equal(short.rmse, long.rmse)
    np.testing.assert_array_equal(short.rollout.rmse, long.rollout.rmse)
    assert short.state.shape == (len(together.rows), 3)


def test_coefficients_are_kept_of_every_so_many_th_row_and_counted_in_all(recording, monkeypatch):
    class Adapting(Model):
        vehicle = load_vehicle("orca")

        def predict(self, windows):
            theta = np.tile(self.vehicle.nominal, (len(windows), 1))
            theta[:, 0] = windows[:, -1, 0]
            return super().predict(windows)._replace(theta=theta)

    monkeypatch.setattr("dynssm_ros.evaluation.open_loop._COEFFICIENT_ROWS", 40)
    monkeypatch.setattr("dynssm_ros.evaluation.metrics.BATCH", 16)
    result = evaluate(recording, {"adapting": Adapting()}, min_speed=0.0, calls=3)
    score, driven = result.scores["adapting"], recording.matrix[result.rows, 0]
    assert result.every == 7
    np.testing.assert_array_equal(score.theta[:, 0], driven[::7])
    np.testing.assert_allclose(score.coefficients.std[0], driven.std())
    assert (score.coefficients.low[0], score.coefficients.high[0]) == (driven.min(), driven.max())


def test_persistence_scores_the_rms_of_the_increments_of_exactly_these_rows(recording):
    result = evaluate(recording, {"persistence": Persistence(), "long": Model(H=40)}, calls=3)
    increments = np.diff(recording.matrix[:, :3], axis=0)[39:]
    np.testing.assert_allclose(result.scores["persistence"].rmse, np.sqrt(np.mean(increments**2, axis=0)))
    np.testing.assert_array_equal(result.scores["persistence"].rmse, result.persistence_rmse)
    np.testing.assert_allclose(result.scores["persistence"].explained, 0.0, atol=1e-12)


def test_slow_stretches_and_gaps_are_never_part_of_a_window_or_a_horizon(recorded):
    states = np.full((200, 3), 20.0)
    states[90] = 1.0
    segment = np.repeat([0, 1], [150, 50]).astype(np.int32)
    result = evaluate(recorded(states, segment), {"m": Model(H=5)}, min_speed=5.0, calls=3)
    for t in result.rows:
        touched = set(range(t - 4, t + 2))
        assert 90 not in touched
        assert not touched >= {149, 150}
    assert result.scores["m"].rollout.fde == 0.0
    assert result.starts < len(result.rows)


def test_stride_thins_the_rollouts_and_not_the_one_step_rows(recording):
    every = evaluate(recording, {"m": Model()}, calls=3)
    tenth = evaluate(recording, {"m": Model()}, stride=10, calls=3)
    assert len(every.rows) == len(tenth.rows)
    assert tenth.starts == -(-every.starts // 10)


def test_progress_counts_up_to_all_predictions(recording, monkeypatch):
    told = []
    models = {"a": Model(), "b": Model()}
    monkeypatch.setattr("dynssm_ros.evaluation.metrics.BATCH", 50)
    evaluate(recording, models, calls=3, progress=lambda *counts: told.append(counts))
    assert [done for done, _ in told] == sorted(done for done, _ in told)
    assert told[-1][0] == told[-1][1]


def test_json_follows_the_contract(recording):
    models = {"persistence": Persistence(), "m": Model(variance=np.ones(3))}
    content = evaluate(recording, models, name="run.parquet", horizon_s=0.2, calls=3).to_json()
    assert content["recording"] == "run.parquet"
    assert content["commands"] == "none"
    assert content["horizon_s"] == 0.2
    entry = content["models"]["m"]
    for key in ("rmse", "max_error", "coverage_90"):
        assert list(entry[key]) == ["v_x", "v_y", "omega"]
    assert (entry["parameters"], entry["flops"]) == (123, 456)
    assert set(entry["latency_us"]) == {"p50", "p99"}
    assert entry["ade"] < entry["fde"] == pytest.approx(entry["rollout"]["displacement"][-1])
    assert len(entry["rollout"]["time_s"]) == 5
    assert set(entry["regimes"]) == {"speed", "lateral_acceleration", "throttle"}
    assert entry["regimes"]["throttle"] == {"coasting": {"rows": len(recording) - 1, "rmse": entry["rmse"]}}
    assert (entry["coefficients"], entry["seeds"], entry["std"]) == (None, [], None)
    assert content["models"]["persistence"]["coverage_90"] is None


def test_what_is_not_finite_is_null_in_json(recording):
    bad = {"nan": Model(offset=np.nan), "huge": Model(offset=1e200), "inf": Model(offset=np.inf, variance=np.ones(3))}
    entries = json.loads(json.dumps(evaluate(recording, bad, calls=3).to_json(), allow_nan=False))["models"]
    assert entries["nan"]["rmse"] == {"v_x": None, "v_y": None, "omega": None}
    assert entries["nan"]["ade"] is None
    assert entries["inf"]["max_error"]["omega"] is None
    assert entries["inf"]["coverage_90"]["v_x"] == 0.0
    assert entries["huge"]["rmse"]["v_x"] is None


def test_coverage_uses_the_model_s_own_variances(recording):
    increments = np.diff(recording.matrix[:, :3], axis=0)
    honest = evaluate(recording, {"m": Model(variance=increments.var(axis=0))}, calls=3).scores["m"]
    np.testing.assert_allclose(honest.coverage_90, 0.9, atol=3 * np.sqrt(0.09 / len(increments)))


def test_coverage_uses_the_variance_of_each_prediction(recorded):
    class Knowing(Model):
        """Reads from the throttle how large the coming step is."""

        def predict(self, windows):
            return super().predict(windows)._replace(variance=np.tile(windows[:, -1, 3:4] ** 2, (1, 3)))

    rng, N = np.random.default_rng(3), 4000
    size = np.where(np.arange(N) % 2 == 0, 1.0, 0.1)
    restless = recorded(np.cumsum(rng.normal(size=(N, 3)) * np.roll(size, 1)[:, None], axis=0))
    restless.columns["r_fb"][:] = size
    models = {"knowing": Knowing(), "constant": Model(variance=np.full(3, np.mean(size**2)))}
    scores = evaluate(restless, models, min_speed=-np.inf, calls=3).scores
    within = 3 * np.sqrt(0.09 / N)
    np.testing.assert_allclose(scores["knowing"].coverage_90, 0.9, atol=within)
    assert (np.abs(scores["constant"].coverage_90 - 0.9) > within).all()  # right on average, wrong at each step


def test_another_sampling_time_is_refused_with_the_rate_to_extract_at(recording):
    with pytest.raises(ArtifactError, match=r"sampling time 0\.04 s, but the model is for 0\.02 s.*50 Hz"):
        evaluate(recording, {"m": Model(T_s=0.02)})


def test_another_command_protocol_is_refused(recording):
    with pytest.raises(ArtifactError, match="commands 'none', but the model was trained with 'lookahead'"):
        evaluate(recording, {"m": Model(commands="lookahead")})


def test_models_of_different_protocols_share_none():
    assert shared_commands({"p": Persistence()}) is None
    assert shared_commands({"p": Persistence(), "m": Model(commands="topics")}) == "topics"
    with pytest.raises(ArtifactError, match="a: none, b: lookahead"):
        shared_commands({"a": Model(commands="none"), "b": Model(commands="lookahead")})


def test_no_usable_window_is_refused_with_what_was_needed(recording):
    with pytest.raises(RecordingError, match=r"no stretch of 315 rows \(window 300, horizon 15\).* among its 300 rows"):
        evaluate(recording, {"m": Model(H=300)})
    with pytest.raises(RecordingError, match=r"at 100 m/s or more"):
        evaluate(recording, {"m": Model()}, min_speed=100.0)


def test_rows_are_scored_from_the_least_speed_of_the_models_cars_on(recording):
    assert evaluate(recording, {"m": Model()}).min_speed == 0.0
    slow = load_vehicle("orca").model_copy(update={"minimum_speed": 3.0, "sampling_time": recording.T_s})
    car = SingleTrack(slow)
    assert evaluate(recording, {"m": Model(), "car": car}).min_speed == 3.0


def test_published_orca_run_is_a_single_track_trajectory(orca_bag):
    recording = extract([orca_bag], load_signal_map("default"), 50.0)
    score = evaluate(recording, {"truth": SingleTrack(load_vehicle("orca"))}, calls=3).scores["truth"]
    assert score.rmse.max() < 1e-12
    assert score.rollout.fde < 1e-12


def test_rows_between_slower_samples_are_no_test(recording):
    info = recording.info.model_copy(update={"interpolated": {"v_x": 0.8, "omega": 0.5, "x": 0.8}})
    (told,) = evaluate(replace(recording, info=info), {"still": Persistence()}).not_tests
    assert told.startswith("80 % of v_x, 50 % of omega lies between slower samples: expected")
