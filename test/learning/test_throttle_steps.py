"""Steps of the throttle among the layer's features: a force that bends is followed, and exact cars stay exact."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dynssm_ros.errors import ConfigurationError
from dynssm_ros.evaluation.open_loop import evaluate
from dynssm_ros.learning.earned_layer import LayerBase
from dynssm_ros.learning.export import save_artifact
from dynssm_ros.learning.models.base import OnlineConfig
from dynssm_ros.learning.models.physics import PhysicsConfig
from dynssm_ros.learning.models.registry import load_model_config
from dynssm_ros.learning.stages import train
from dynssm_ros.runtime.artifact import Normalisation
from dynssm_ros.runtime.contract import WindowModel
from dynssm_ros.runtime.features import THROTTLES, throttle_steps
from dynssm_ros.runtime.onnx_model import OnnxModel
from dynssm_ros.signals.inputs import WINDOW_COLUMNS
from dynssm_ros.signals.recording import Recording, RecordingInfo
from dynssm_ros.vehicle import Applied, CarModel, Coefficients, State, Vehicle, load_vehicle
from dynssm_ros.vehicle.kinematics import SCALAR

NOISE = (0.001, 0.001, 0.01)


def bent(vehicle: Vehicle, rows: int, seed: int, *, least: float = 0.0) -> Recording:
    """A drive whose throttle goes in steps between three values; it is told as a pedal from ``least`` on that bends between
    them."""
    rng = np.random.default_rng(seed)
    throttle = np.repeat(rng.choice([0.25, 0.34, 0.40], rows), rng.integers(5, 25, rows))[: rows + 1]
    steering = np.convolve(rng.standard_normal(rows + 40), np.ones(40) / 40)[40 : rows + 41] * 0.3
    car = CarModel(vehicle.constants, vehicle.sampling_time, (), xp=SCALAR)
    theta, states = Coefficients(*vehicle.nominal.tolist()), np.zeros((rows, 3))
    states[0] = 1.6, 0.0, 0.0
    for k in range(rows - 1):
        moved, _ = car.step(State(*states[k].tolist()), Applied(throttle[k + 1], steering[k + 1]), theta)
        states[k + 1] = moved + rng.standard_normal(3) * NOISE
    pedal = least + np.interp(throttle, [0.25, 0.34, 0.40], [0.0, 0.02, 0.3])
    matrix = np.column_stack([states, pedal[:-1], steering[:-1], np.diff(pedal), np.diff(steering)])
    info = RecordingInfo(sampling_time=vehicle.sampling_time, commands="topics", source=(f"bent {seed}",))
    time = 10**18 + np.round(np.arange(rows) * vehicle.sampling_time * 1e9).astype(np.int64)
    columns = {name: matrix[:, k] for k, name in enumerate(WINDOW_COLUMNS)}
    return Recording(info, time, np.zeros(rows, np.int32), columns)


def models(laps: Recording, car: Vehicle, folder: Path) -> dict[str, WindowModel]:
    """The online layer without the steps, with them, and with them where they earn their place."""
    found: dict[str, WindowModel] = {}
    for name, steps in (("without", False), ("with", True), ("earned", None)):
        config = load_model_config("rls", {"online": {"throttle_steps": steps}})
        found[name] = OnnxModel(save_artifact(train(laps, config, car, folder / f"{name}.pt"), folder / name))
    return found


def test_a_force_that_bends_is_followed_on_another_drive(orca: Vehicle, tmp_path: Path) -> None:
    known = models(bent(orca, 2000, 0), orca, tmp_path)
    scores = evaluate(bent(orca, 1000, 1), known, calls=1).scores
    assert scores["with"].rmse[0] < 0.8 * scores["without"].rmse[0]
    assert scores["with"].rollout.ade < 0.9 * scores["without"].rollout.ade
    np.testing.assert_allclose(scores["with"].rmse[1:], scores["without"].rmse[1:], rtol=0.03)
    np.testing.assert_array_equal(scores["earned"].rmse, scores["with"].rmse)
    gains = {name: json.loads((tmp_path / name / "metrics.json").read_text())["throttle_gain"] for name in known}
    assert (gains["with"], gains["without"], gains["earned"] > 0.1) == (None, None, True)


def test_laps_that_never_coast_say_nothing_of_a_bend_about_zero(orca: Vehicle, tmp_path: Path) -> None:
    trained = train(bent(orca, 1000, 0, least=0.1), load_model_config("rls"), orca, tmp_path / "model.pt")
    assert trained.throttle_gain is None
    assert trained.features is not None
    assert not trained.features.layout.throttle


def test_where_no_force_bends_they_cost_little(drive: Any, orca: Vehicle, tmp_path: Path) -> None:
    known = models(drive(orca, 1500, noise=NOISE), orca, tmp_path)
    scores = evaluate(drive(orca, 1000, seed=1, noise=NOISE), known, calls=1).scores
    np.testing.assert_allclose(scores["with"].rmse, scores["without"].rmse, rtol=0.01)
    assert scores["with"].rollout.ade < 1.02 * scores["without"].rollout.ade
    np.testing.assert_array_equal(scores["earned"].rmse, scores["without"].rmse)


def test_steps_are_of_the_applied_throttle_and_close_to_each_other_about_zero() -> None:
    windows = np.zeros((3, 2, 7))
    windows[1, -1, 3], windows[1, -1, 5] = 0.03, -0.02
    windows[2, -1, 3] = 0.01
    found = throttle_steps(windows)
    assert found.shape == (3, len(THROTTLES))
    np.testing.assert_allclose(found[1], found[2])
    assert np.abs(found[1] - found[0]).max() > 0.7
    assert np.abs(throttle_steps(1e9 * np.ones((1, 2, 7)))).max() == pytest.approx(1.0)


def test_a_car_that_is_commanded_by_a_speed_has_none() -> None:
    car = load_vehicle("f1tenth")
    one = (1.0, 1.0, 1.0)
    scale = Normalisation(input_mean=(0.0,) * 7, input_std=(1.0,) * 7, state_scale=one, increment_scale=one)
    base = LayerBase(car, PhysicsConfig(), scale, 30, OnlineConfig(throttle_steps=True))
    with pytest.raises(ConfigurationError, match=r"throttle_steps: true, but vehicle f1tenth has .*set_point: speed"):
        base.features(False)
