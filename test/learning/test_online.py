"""The online layer from training to prediction: exact cars stay exact, live equals evaluation, changed cars are learned."""

import json
import os
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
import yaml

from dynssm_ros.errors import ArtifactError, ConfigurationError
from dynssm_ros.evaluation import metrics
from dynssm_ros.evaluation.metrics import drive_through, predict_rows
from dynssm_ros.evaluation.open_loop import evaluate
from dynssm_ros.files import checksum
from dynssm_ros.learning.earned_layer import LayerBase
from dynssm_ros.learning.export import save_artifact
from dynssm_ros.learning.stages import train
from dynssm_ros.runtime.artifact import open_artifact
from dynssm_ros.runtime.baselines import SingleTrack
from dynssm_ros.runtime.contract import without_online
from dynssm_ros.runtime.onnx_model import OnnxModel
from dynssm_ros.runtime.predictor import Prediction, Predictor
from dynssm_ros.signals.history import Refusal
from dynssm_ros.signals.recording import concatenate
from dynssm_ros.signals.signal_map import load_signal_map

SIGNALS = load_signal_map("default").with_commands("none")


@pytest.fixture(scope="module")
def noisy_laps(laps):
    rng = np.random.default_rng(0)
    noise = {"v_x": 0.01, "v_y": 0.01, "omega": 0.03}
    columns = {n: v + noise.get(n, 0.0) * rng.standard_normal(len(v)) for n, v in laps.columns.items()}
    return replace(laps, columns=columns).with_commands("none")


@pytest.fixture(scope="module")
def noisy_model(noisy_laps, orca, make_config, tmp_path_factory):
    folder = tmp_path_factory.mktemp("online")
    trained = train(noisy_laps, make_config(kind="rls", history=0.3), orca, folder / "c.pt")
    return OnnxModel(save_artifact(trained, folder / "model"))


def test_on_exact_laps_of_the_known_car_it_is_the_true_model(laps, orca, make_config, tmp_path: Path):
    trained = train(laps, make_config(kind="rls", history=0.3), orca, tmp_path / "c.pt")
    model = OnnxModel(save_artifact(trained, tmp_path / "model"))
    score = evaluate(laps, {"rls": model, "true": SingleTrack(orca)}, calls=1).scores["rls"]
    assert np.all(score.rmse < 1e-5)
    assert score.rollout.ade < 1e-5


@pytest.mark.slow
def test_memory_of_a_training_grows_with_the_rows_of_the_laps_alone(laps, orca, make_config, tmp_path: Path):
    def peak(recording) -> int:
        tracemalloc.start()
        train(recording, make_config(kind="rls", history=0.3), orca, tmp_path / "c.pt")
        _, highest = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        return highest

    less, more = (
        concatenate([laps] * -(-rows // len(laps))) for rows in (12000, 24000)
    )  # of each part more than a block
    peak(laps)
    a_row = (peak(more) - peak(less)) / (len(more) - len(less))
    assert a_row < 8 * 45, "bytes; the row itself has 13 numbers, what the layer sees of a window 3 x 30"


def test_with_sensor_noise_it_beats_the_physics_that_it_starts_from(noisy_laps, noisy_model):
    scores = evaluate(noisy_laps, {"on": noisy_model, "off": without_online(noisy_model)}, calls=1).scores
    assert np.all(scores["on"].rmse < scores["off"].rmse)
    assert scores["on"].rollout.ade < scores["off"].rollout.ade
    assert np.all(np.abs(scores["on"].coverage_90 - 0.9) < 0.03)


def test_scores_do_not_depend_on_the_blocks_in_which_a_log_is_driven_through(noisy_laps, noisy_model, monkeypatch):
    cut = noisy_laps.select(np.flatnonzero(np.arange(len(noisy_laps)) % 700 > 90))  # blocks end within gaps, too
    whole = evaluate(cut, {"on": noisy_model}, calls=1).scores["on"]
    monkeypatch.setattr(metrics, "BATCH", 61)
    blocks = evaluate(cut, {"on": noisy_model}, calls=1).scores["on"]
    np.testing.assert_allclose(blocks.state, whole.state, atol=1e-6)  # the graph is single precision
    np.testing.assert_allclose(blocks.rollout.displacement, whole.rollout.displacement, rtol=1e-5)
    np.testing.assert_allclose(blocks.rollout.rmse, whole.rollout.rmse, rtol=1e-5)
    np.testing.assert_allclose(blocks.known.weights, whole.known.weights, atol=1e-4)
    assert len(blocks.known.weights) > 3
    assert blocks.rollout.starts == whole.rollout.starts > 300


def test_a_network_that_earns_nothing_is_left_out_of_the_layer(noisy_laps, orca, make_config, tmp_path: Path):
    trained = train(noisy_laps, make_config(online={"folds": 2}), orca, tmp_path / "c.pt")
    assert trained.network_gain < 0.03
    assert "network" not in trained.features.names
    artifact = save_artifact(trained, tmp_path / "model")
    assert not artifact.card.network
    assert not artifact.onnx.exists()
    assert artifact.card.flops == 0
    assert "onnx_difference" not in json.loads((tmp_path / "model/metrics.json").read_text())
    rows = noisy_laps.window_ends(trained.H, 1, orca.minimum_speed)
    model, windows = OnnxModel(artifact), noisy_laps.windows(rows, trained.H)
    said, physics = model.predict(windows), SingleTrack(model.vehicle).predict(windows)
    np.testing.assert_allclose(said.state, physics.state, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(said.theta, physics.theta)
    errors = physics.state - noisy_laps.states(rows + 1)
    np.testing.assert_allclose(said.variance[0], np.mean(errors**2, axis=0), rtol=0.05)
    card = yaml.safe_load((tmp_path / "model/model.yaml").read_text())
    (tmp_path / "model/model.yaml").write_text(yaml.safe_dump(card | {"online": None}))
    with pytest.raises(ArtifactError, match="network: false goes with an online layer"):
        open_artifact(tmp_path / "model")


def test_a_layer_whose_features_the_graph_computes_is_read_as_before(noisy_laps, orca, make_config, tmp_path: Path):
    """Model folders of version 0.4 and before."""
    trained = train(noisy_laps, make_config(kind="rls", history=0.3), orca, tmp_path / "c.pt")
    folder = save_artifact(trained, tmp_path / "model").path
    n = len(trained.features.names)
    weights = np.random.default_rng(0).standard_normal((trained.H * 7, 3 * n)).astype(np.float32)
    constants = {"weights": weights, "rows": np.array([-1, trained.H * 7]), "each": np.array([-1, 3, n])}
    nodes = [
        onnx.helper.make_node("Reshape", ["window", "rows"], ["flat"]),
        onnx.helper.make_node("MatMul", ["flat", "weights"], ["found"]),
        onnx.helper.make_node("Reshape", ["found", "each"], ["features"]),
        onnx.helper.make_node("ReduceMean", ["features"], ["increment"], axes=[2], keepdims=0),
        onnx.helper.make_node("Identity", ["increment"], ["nominal_physics"]),
    ]
    shapes = {"increment": ["N", 3], "features": ["N", 3, n], "nominal_physics": ["N", 3]}
    graph = onnx.helper.make_graph(
        nodes, "old", [onnx.helper.make_tensor_value_info("window", onnx.TensorProto.FLOAT, ["N", trained.H, 7])],
        [onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, shape) for name, shape in shapes.items()],
        [onnx.numpy_helper.from_array(value, name) for name, value in constants.items()],
    )  # fmt: skip
    old = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)], ir_version=8)
    onnx.save(old, folder / "model.onnx")
    card = yaml.safe_load((folder / "model.yaml").read_text())
    del card["network"], card["online"]["error_rows"]
    card |= {"format_version": 1, "checksums": card["checksums"] | {"model.onnx": checksum(folder / "model.onnx")}}
    (folder / "model.yaml").write_text(yaml.safe_dump(card))
    model, windows = OnnxModel(open_artifact(folder)), noisy_laps.windows(np.arange(100, 107), trained.H)
    said, expected = model.predict(windows), (windows.reshape(7, -1) @ weights).reshape(7, 3, n)
    np.testing.assert_allclose(said.seen.features, expected, atol=1e-4)
    np.testing.assert_allclose(said.state, windows[:, -1, :3] + expected.mean(axis=2), atol=1e-4)


def test_a_networks_increment_is_an_expert_of_its_own(noisy_laps, orca, make_config, tmp_path: Path, monkeypatch):
    monkeypatch.setattr("dynssm_ros.learning.earned_layer.GAIN_WANTED", -1.0)
    trained = train(noisy_laps, make_config(online={"folds": 2}), orca, tmp_path / "c.pt")
    model = OnnxModel(save_artifact(trained, tmp_path / "model"))
    ends = noisy_laps.window_ends(trained.H, min_speed=orca.minimum_speed)[:20]
    window = torch.tensor(noisy_laps.windows(ends, trained.H), dtype=torch.float32)
    output = trained.model(window)
    seen = model.predict(window.numpy().astype(float)).seen.features
    own = trained.features.names.index("network")
    expected = (output.increment / torch.tensor(trained.normalisation.increment_scale)).detach().numpy()
    np.testing.assert_allclose(seen[:, :, own], expected, atol=1e-4)


def test_features_are_what_their_names_say(noisy_laps, orca, noisy_model):
    names, scale = noisy_model.online.card.features, noisy_model.online.scale
    rows = np.arange(100, 110)
    windows = np.stack([noisy_laps.matrix[k - noisy_model.H + 1 : k + 1] for k in rows])
    features = noisy_model.predict(windows).seen.features
    increments = np.diff(windows[:, :, :3], axis=1) / scale
    car = SingleTrack(noisy_model.vehicle)
    physics = (car.predict(windows).state - windows[:, -1, :3]) / scale
    at = {name: features[:, :, k] for k, name in enumerate(names)}
    np.testing.assert_allclose(at["physics"], physics, atol=1e-4)
    np.testing.assert_allclose(at["physics, next channel"], np.roll(physics, -1, axis=1), atol=1e-4)
    np.testing.assert_allclose(at["increment, 1 steps ago"], increments[:, -1], atol=1e-4)
    np.testing.assert_allclose(at["increment, 4 steps ago"], increments[:, -4], atol=1e-4)
    np.testing.assert_allclose(
        at["increment of the one after, 2 steps ago"], np.roll(increments[:, -2], -2, axis=1), atol=1e-4
    )
    np.testing.assert_allclose(at["one"], 1.0)
    past = (car.predict(windows[:, :-1].reshape(-1, 1, 7)).state).reshape(len(rows), -1, 3) - windows[:, :-1, :3]
    np.testing.assert_allclose(at["mean error of the physics"], (increments - past / scale).mean(1), atol=1e-3)


@pytest.mark.slow
def test_rollouts_of_a_changed_car_stay_as_bounded_as_the_physics(laps, orca, make_config, drive, tmp_path: Path):
    trained = train(laps, make_config(kind="rls", history=0.3), orca, tmp_path / "c.pt")
    model = OnnxModel(save_artifact(trained, tmp_path / "model"))
    changed = drive(orca.with_effect("front_grip", {"factor": 0.75}))
    scores = evaluate(changed, {"on": model, "off": without_online(model)}, calls=1, horizon_s=5.0, stride=10).scores
    assert np.all(np.isfinite(scores["on"].rollout.rmse))
    assert scores["on"].rollout.rmse.max(axis=0) == pytest.approx(scores["off"].rollout.rmse.max(axis=0), rel=1.0)
    short = evaluate(changed, {"on": model, "off": without_online(model)}, calls=1).scores
    assert short["on"].rollout.ade < short["off"].rollout.ade


def feed(predictor, recording, rows, every=1, start=0, overtaken=()):
    """Plays rows as messages, with ``every`` - 1 messages between two rows; the predictions at the rows.

    The actuators of the messages ``overtaken`` come after their odometry.
    """
    found = {}
    T = recording.T_s
    time = start + np.arange(rows[0] * every, rows[-1] * every + 1) * round(T * 1e9 / every)
    columns = {
        n: np.interp(time, start + np.arange(len(recording)) * round(T * 1e9), v) for n, v in recording.columns.items()
    }
    for k, stamp in enumerate(time.tolist()):
        actuators = {f"{n}_feedback": columns[c][k] for n, c in (("throttle", "r_fb"), ("steering", "delta_fb"))}
        if k not in overtaken:
            predictor.observe(stamp, actuators)
        outcome = predictor.predict(stamp, {n: columns[n][k] for n in ("v_x", "v_y", "omega")})
        if k in overtaken:
            predictor.observe(stamp, actuators)
        if k % every == 0 and isinstance(outcome, Prediction):
            found[rows[0] + k // every] = outcome
    return found


def test_live_predictions_are_those_of_the_evaluation(noisy_laps, noisy_model):
    rows = np.arange(0, 400)
    part = noisy_laps.select(rows)
    predictor = Predictor(noisy_model, SIGNALS)
    found = feed(predictor, part, rows)
    ((drive, (shared,)),) = drive_through(noisy_model, part, [np.array(sorted(found))])
    assert len(shared) > 300
    (batch,) = predict_rows(noisy_model, part, shared, drive=drive)
    np.testing.assert_allclose([found[k].state for k in shared], batch.state, atol=1e-5)
    np.testing.assert_allclose([found[k].variance for k in shared], batch.variance, rtol=1e-3)


def test_odometry_at_four_times_the_rate_teaches_each_step_once(noisy_laps, noisy_model):
    rows = np.arange(0, 300)
    part = noisy_laps.select(rows)
    slow, fast = (Predictor(noisy_model, SIGNALS) for _ in range(2))
    feed(slow, part, rows)
    feed(fast, part, rows, every=4)
    assert abs(fast.online.steps - slow.online.steps) <= 1
    np.testing.assert_allclose(fast.online.mean, slow.online.mean, atol=0.02)


def test_odometry_that_overtakes_its_actuators_teaches_the_same(noisy_laps, noisy_model):
    rows, overtaken = np.arange(0, 300), {80, 150, 151, 220}
    part = noisy_laps.select(rows)
    ordered, disordered = (Predictor(noisy_model, SIGNALS) for _ in range(2))
    expected, found = feed(ordered, part, rows), feed(disordered, part, rows, overtaken=overtaken)
    assert {k for k in expected if not np.array_equal(found[k].state, expected[k].state)} == overtaken
    np.testing.assert_array_equal(disordered.online.mean, ordered.online.mean)
    assert disordered.online.steps == ordered.online.steps


def test_odometry_that_misses_the_grid_teaches_as_many_steps(noisy_laps, noisy_model):
    part = noisy_laps.select(np.arange(0, 300))
    predictor = Predictor(noisy_model, SIGNALS)
    T = part.T_s
    grid = np.arange(300) * T
    for t in np.arange(0.0, grid[-1], 0.0271):  # 37 Hz, where T_s asks for 50
        now = {n: float(np.interp(t, grid, v)) for n, v in part.columns.items()}
        predictor.observe(round(t * 1e9), {"throttle_feedback": now["r_fb"], "steering_feedback": now["delta_fb"]})
        predictor.predict(round(t * 1e9), {n: now[n] for n in ("v_x", "v_y", "omega")})
    assert predictor.online.steps > 0.9 * (300 - noisy_model.H)


def test_it_is_kept_over_a_gap_and_forgotten_when_time_jumps_back(noisy_laps, noisy_model):
    rows = np.arange(0, 200)
    part = noisy_laps.select(rows)
    predictor = Predictor(noisy_model, SIGNALS)
    feed(predictor, part, rows)
    steps, mean = predictor.online.steps, predictor.online.mean.copy()
    assert steps > 100
    for stamp in (20_000_000_000, 20_020_000_000):  # a gap of 16 s
        assert isinstance(predictor.predict(stamp, {"v_x": 2.0, "v_y": 0.0, "omega": 0.0}), Refusal)
    np.testing.assert_array_equal(predictor.online.mean, mean)
    assert predictor.predict(0, {"v_x": 2.0, "v_y": 0.0, "omega": 0.0}) is Refusal.OUTLIER
    assert predictor.predict(20_000_000, {"v_x": 2.0, "v_y": 0.0, "omega": 0.0}) is Refusal.JUMPED_BACK
    assert predictor.online.steps == 0


def test_a_second_stint_starts_where_the_first_ended(noisy_laps, noisy_model, tmp_path: Path):
    rows = np.arange(0, 200)
    part = noisy_laps.select(rows)
    first, second = (Predictor(noisy_model, SIGNALS) for _ in range(2))
    feed(first, part, rows)
    first.online_writer(tmp_path / "state")()
    second.load_online(tmp_path / "state")
    np.testing.assert_array_equal(second.online.mean, first.online.mean)
    with pytest.raises(ArtifactError, match="switched off"):
        Predictor(noisy_model, SIGNALS, online=False).load_online(tmp_path / "state")
    before = second.online.mean.copy()
    (tmp_path / "damaged").write_bytes((tmp_path / "state").read_bytes()[:-9])
    os.mkfifo(tmp_path / "fifo")
    for name in ("damaged", "fifo", "none"):
        with pytest.raises(ArtifactError, match=f"{name}: not a readable online state"):
            second.load_online(tmp_path / name)
    np.testing.assert_array_equal(second.online.mean, before)


def test_a_swap_keeps_what_was_learned_only_for_the_same_prior(
    noisy_laps, noisy_model, orca, make_config, tmp_path: Path
):
    rows = np.arange(0, 200)
    predictor = Predictor(noisy_model, SIGNALS)
    feed(predictor, noisy_laps.select(rows), rows)
    state = predictor.online
    predictor.swap(OnnxModel(noisy_model.artifact))
    assert predictor.online is state
    trained = train(noisy_laps.select(np.arange(800)), make_config(kind="rls", history=0.3), orca, tmp_path / "c.pt")
    predictor.swap(OnnxModel(save_artifact(trained, tmp_path / "other")))
    assert (predictor.online is state, predictor.online.steps) == (False, 0)


def test_a_damaged_layer_is_found_when_the_folder_is_opened(noisy_laps, orca, make_config, tmp_path: Path):
    trained = train(noisy_laps, make_config(kind="rls", history=0.3), orca, tmp_path / "c.pt")
    artifact = save_artifact(trained, tmp_path / "model")
    (artifact.path / "online.safetensors").unlink()
    with pytest.raises(ArtifactError, match=r"incomplete model folder, online\.safetensors is missing"):
        open_artifact(artifact.path)


def test_features_fit_into_a_short_window(orca, noisy_model):
    from dynssm_ros.learning.models.base import OnlineConfig
    from dynssm_ros.learning.models.physics import PhysicsConfig

    base = LayerBase(orca, PhysicsConfig(), noisy_model.card.normalisation, 5, OnlineConfig())
    features = base.features(False)
    seen, physics = features.seen(np.random.default_rng(0).random((7, 5, 7)) + 1.0)
    assert seen.shape == (7, 3, len(features.names))
    assert physics.shape == (7, 3)
    with pytest.raises(ConfigurationError, match="a window of 2 rows; expected at least 3"):
        base._replace(H=2).features(False)
