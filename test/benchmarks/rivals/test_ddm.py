"""The Deep Dynamics model: its published sizes, coefficients within bounds, and nothing but physics after them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.rivals.ddm import DDM
from dynssm_ros.learning.dataset import TrainingWindows, split_windows
from dynssm_ros.learning.export import save_artifact
from dynssm_ros.learning.models.base import ModelConfig
from dynssm_ros.learning.models.registry import build_model, load_model_config
from dynssm_ros.learning.stages import train
from dynssm_ros.runtime.artifact import Normalisation
from dynssm_ros.runtime.baselines import SingleTrack
from dynssm_ros.runtime.onnx_model import OnnxModel
from dynssm_ros.signals.recording import Recording
from dynssm_ros.vehicle import Vehicle, load_vehicle

MakeConfig = Callable[..., ModelConfig]
UNIT = Normalisation(input_mean=(0.0,) * 7, input_std=(1.0,) * 7, state_scale=(1.0,) * 3, increment_scale=(1.0,) * 3)


@pytest.fixture
def small(make_ddm: MakeConfig, orca: Vehicle) -> DDM:
    torch.manual_seed(0)
    return DDM(make_ddm(), orca, UNIT)


@pytest.mark.parametrize(
    ("name", "vehicle", "published"),
    [
        ("ddm_av21", "av21_paper", 85_193),
        ("ddm_orca", "orca", 2_878_035),
    ],
)
def test_the_models_have_the_published_number_of_parameters(name: str, vehicle: str, published: int) -> None:
    model = build_model(load_model_config(name), load_vehicle(vehicle), UNIT)
    assert sum(parameter.numel() for parameter in model.parameters()) == published


@pytest.mark.parametrize(("output", "bound"), [(-1e3, "lower"), (1e3, "upper")])
def test_the_coefficients_stay_within_bounds_whatever_the_network_says(
    small: DDM, orca: Vehicle, output: float, bound: str
) -> None:
    window = 30.0 * torch.randn(50, 4, 7)
    with torch.no_grad():
        theta = small(window).theta.double().numpy()
        small.dense[-1].bias.fill_(output)  # type: ignore[operator, union-attr]
        extreme = small(window).theta.double().numpy()
    assert (theta > orca.lower).all()
    assert (theta < orca.upper).all()
    np.testing.assert_allclose(extreme, np.tile(getattr(orca, bound), (50, 1)), rtol=1e-6)


def test_an_undecided_network_gives_the_middle_of_the_bounds(small: DDM, orca: Vehicle) -> None:
    with torch.no_grad():
        small.dense[-1].weight.zero_()  # type: ignore[operator]
        small.dense[-1].bias.zero_()  # type: ignore[operator]
        theta = small(torch.randn(3, 4, 7)).theta
    np.testing.assert_allclose(theta.numpy(), np.tile((orca.lower + orca.upper) / 2, (3, 1)), rtol=1e-6)


def test_every_row_and_column_of_the_window_reaches_the_coefficients(small: DDM) -> None:
    window = torch.randn(1, 4, 7, requires_grad=True)
    small(window).theta.log().sum().backward()
    assert window.grad is not None
    assert (window.grad.abs() > 0).all()


def test_the_network_sees_normalised_windows(make_ddm: MakeConfig, orca: Vehicle, small: DDM) -> None:
    mean, std = np.linspace(-1.0, 2.0, 7), np.linspace(0.5, 3.0, 7)
    scale = UNIT.model_copy(update={"input_mean": tuple(mean.tolist()), "input_std": tuple(std.tolist())})
    torch.manual_seed(0)
    scaled = DDM(make_ddm(), orca, scale)
    window = torch.randn(5, 4, 7)
    with torch.no_grad():
        raw = window * torch.tensor(std, dtype=torch.float32) + torch.tensor(mean, dtype=torch.float32)
        torch.testing.assert_close(scaled(raw).theta, small(window).theta)


def test_the_prediction_is_a_step_of_the_single_track_model_without_load_transfer(
    make_ddm: MakeConfig, drive: Callable[..., Recording], tmp_path: Path
) -> None:
    """What is deployed and noted on the card, by the numpy source."""
    car = load_vehicle("av21_paper").model_copy(update={"sampling_time": 0.02})
    recording = drive(load_vehicle("orca"), 400)
    recording.columns["v_x"] *= 10.0
    artifact = save_artifact(train(recording, make_ddm(training={"epochs": 1}), car, tmp_path / "c.pt"), tmp_path / "m")
    assert car.constants.load_transfer
    assert not artifact.card.vehicle.constants.load_transfer
    windows = np.stack([recording.matrix[k : k + 4] for k in (0, 70, 200)])
    found = OnnxModel(artifact).predict(windows)
    assert found.theta is not None
    assert found.physics is not None
    np.testing.assert_array_equal(found.state, found.physics)
    for k, theta in enumerate(found.theta):
        # single precision may leave the bounds by a last digit
        inside = artifact.card.vehicle.with_nominal(theta)
        expected, loaded = (
            SingleTrack(each).predict(windows[[k]]).state[0] for each in (inside, car.with_nominal(theta))
        )
        np.testing.assert_allclose(found.state[k], expected, atol=1e-5)
        assert np.abs(found.state[k] - loaded).max() > 1e-4


def test_it_learns_a_car_from_its_laps(make_ddm: MakeConfig, laps: Recording, orca: Vehicle, tmp_path: Path) -> None:
    config = make_ddm(dense={"layers": 1, "width": 16}, training={"epochs": 15, "learning_rate": 0.01})
    trained = train(laps, config, orca, tmp_path / "checkpoint.pt")
    prediction = trained.history["validation/prediction"]
    assert min(prediction) < 0.2 * prediction[0]
    held: TrainingWindows = split_windows(laps, 4, config.training, 0.0, 1)[1]
    window, increment = held.batch(slice(None))
    with torch.no_grad():
        error = trained.model(window).increment - increment
    assert error.square().mean().item() == pytest.approx(min(prediction), rel=1e-4)  # in m/s, m/s and rad/s
    assert min(prediction) < 0.1 * increment.square().mean().item()  # of persistence
