"""The model: physics first, coefficients within bounds, a gate, and components that can be left out."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dynssm_ros.configuration import config_root
from dynssm_ros.learning.dataset import TrainingWindows, normalisation
from dynssm_ros.learning.losses import Output
from dynssm_ros.learning.models.base import ModelConfig
from dynssm_ros.learning.models.dynssm.network import DynSSM, GatedResidual
from dynssm_ros.learning.models.physics import PhysicsLayer
from dynssm_ros.learning.models.registry import load_model_config
from dynssm_ros.runtime.artifact import Normalisation
from dynssm_ros.runtime.baselines import SingleTrack
from dynssm_ros.signals.recording import Recording
from dynssm_ros.vehicle import COEFFICIENTS, Vehicle, load_vehicle

MakeConfig = Callable[..., ModelConfig]
SHIPPED = sorted(path.stem for path in (config_root() / "models").glob("dynssm*.yaml"))
ABLATIONS: dict[str, dict[str, Any]] = {
    "no_ssm": {"ssm": None},
    "no_gru": {"gru": None},
    "no_adaptation": {"adaptation": None},
    "no_residual": {"residual": None},
    "neural_only": {"physics": None, "adaptation": None},
}


@pytest.fixture(scope="module")
def windows(laps: Recording) -> TrainingWindows:
    return TrainingWindows(torch.tensor(laps.matrix, dtype=torch.float32), torch.tensor(laps.window_ends(4)), 4)


@pytest.fixture(scope="module")
def scale(laps: Recording) -> Normalisation:
    return normalisation(laps, laps.window_ends(4))


def build(config: ModelConfig, vehicle: Vehicle, scale: Normalisation, seed: int = 0) -> DynSSM:
    torch.manual_seed(seed)
    return DynSSM(config, vehicle, scale)


def run(model: DynSSM, window: torch.Tensor) -> Output:
    with torch.no_grad():
        return model(window)


def single_track(vehicle: Vehicle, window: torch.Tensor, **how: Any) -> np.ndarray:
    """Increments by the numpy source."""
    rows = window.double().numpy()
    return SingleTrack(vehicle, **how).predict(rows).state - rows[:, -1, :3]


@pytest.mark.parametrize(("integrator", "substeps"), [("euler", 1), ("euler", 3), ("rk4", 1)])
def test_without_learned_parts_it_is_the_numpy_single_track_step(
    make_config: MakeConfig,
    orca: Vehicle,
    scale: Normalisation,
    windows: TrainingWindows,
    integrator: str,
    substeps: int,
) -> None:
    config = make_config(physics={"integrator": integrator, "substeps": substeps})
    model = build(config, orca, scale)
    assert model.head is not None
    assert model.residual is not None
    with torch.no_grad():
        for last in (model.head.deviate, model.residual.network[-1]):
            last.weight.zero_()  # type: ignore[union-attr, operator]
    window, _ = windows.batch(slice(None))
    output = run(model, window)
    expected = single_track(orca, window, integrator=integrator, substeps=substeps)
    np.testing.assert_allclose(output.increment.numpy(), expected, atol=2e-6)
    np.testing.assert_allclose(output.theta.numpy()[0], orca.nominal, rtol=1e-6)
    assert torch.equal(output.increment, output.physics)
    assert not output.deviation.any()


def test_a_fresh_model_starts_next_to_the_nominal_car(
    make_config: MakeConfig, orca: Vehicle, scale: Normalisation, windows: TrainingWindows
) -> None:
    window, _ = windows.batch(slice(None))
    output = run(build(make_config(), orca, scale), window)
    error = np.abs(output.increment.numpy() - single_track(orca, window)) / scale.increment_scale
    assert np.sqrt((error**2).mean(axis=0)).max() < 0.1
    assert output.deviation.abs().max() < 0.01
    assert (np.abs((output.increment - output.physics).numpy()) / scale.increment_scale).max() < 0.01


@given(factor=st.floats(0.01, 100.0), seed=st.integers(0, 1000), alpha=st.floats(0.05, 1.0))
@settings(max_examples=40)
def test_no_weights_push_a_coefficient_over_its_bounds(
    make_config: MakeConfig,
    orca: Vehicle,
    scale: Normalisation,
    windows: TrainingWindows,
    factor: float,
    seed: int,
    alpha: float,
) -> None:
    model = build(make_config(adaptation={"alpha": alpha}), orca, scale, seed)
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            if ".log_" not in name:  # logarithms of rates
                parameter.copy_(factor * torch.randn_like(parameter))
    output = run(model, windows.batch(slice(0, 40))[0])
    theta = output.theta.numpy()
    lower, upper = orca.lower.astype(np.float32), orca.upper.astype(np.float32)
    assert (theta >= lower).all()
    assert (theta <= upper).all()
    within = np.abs(theta - orca.nominal) <= alpha * (orca.upper - orca.lower) * (1 + 1e-5) + 1e-6 * np.abs(orca.upper)
    assert within.all()
    assert np.isfinite(output.increment.numpy()).all()


def test_a_deviation_beyond_a_bound_is_clipped_to_it(
    make_config: MakeConfig, orca: Vehicle, scale: Normalisation, windows: TrainingWindows
) -> None:
    model = build(make_config(adaptation={"alpha": 1.0}), orca, scale)
    assert model.head is not None
    for sign, bound in ((-1.0, orca.lower), (1.0, orca.upper)):
        with torch.no_grad():
            model.head.deviate.bias.fill_(sign * 50.0)
        output = run(model, windows.batch(slice(0, 3))[0])
        np.testing.assert_array_equal(output.theta.numpy(), np.tile(bound.astype(np.float32), (3, 1)))
        expected = (bound - orca.nominal) / (orca.upper - orca.lower)
        np.testing.assert_allclose(output.deviation.numpy()[0], expected, atol=1e-5)


def test_a_small_deviation_is_alpha_tanh_of_the_range(
    make_config: MakeConfig, scale: Normalisation, windows: TrainingWindows, orca: Vehicle
) -> None:
    middle = orca.with_nominal((orca.lower + orca.upper) / 2)
    model = build(make_config(adaptation={"alpha": 0.3}), middle, scale)
    assert model.head is not None
    with torch.no_grad():
        model.head.deviate.weight.zero_()
        model.head.deviate.bias.copy_(torch.linspace(-2, 2, 17))
    output = run(model, windows.batch(slice(0, 2))[0])
    np.testing.assert_allclose(output.deviation.numpy()[0], 0.3 * np.tanh(np.linspace(-2, 2, 17)), rtol=1e-4)


def test_theta_0_is_the_vehicles_or_the_middle_of_the_bounds(make_config: MakeConfig, orca: Vehicle) -> None:
    for name, expected in (("vehicle", orca.nominal), ("mid_range", (orca.lower + orca.upper) / 2)):
        physics = make_config(physics={"nominal": name}).physics
        assert physics is not None
        np.testing.assert_allclose(physics.theta_0(orca).numpy(), expected, rtol=1e-6)


@given(seed=st.integers(0, 1000), factor=st.floats(0.1, 3.0))
@settings(max_examples=25)
def test_the_gate_lies_between_0_and_1_and_scales_the_correction(seed: int, factor: float) -> None:
    torch.manual_seed(seed)
    residual = GatedResidual(10, (8,), 0.7)
    q = factor * torch.randn(50, 10)
    with torch.no_grad():
        scaled, r = residual(q)
    gate = scaled / (0.7 * r)
    assert (gate > 0).all()
    assert (gate < 1).all()
    torch.testing.assert_close(gate, torch.sigmoid(residual.gate(q)), rtol=1e-4, atol=1e-5)


def test_the_correction_is_lambda_s_delta_gate_r(
    make_config: MakeConfig, orca: Vehicle, scale: Normalisation, windows: TrainingWindows
) -> None:
    model = build(make_config(residual={"scale": 0.4}), orca, scale)
    assert model.residual is not None
    last = model.residual.network[-1]
    with torch.no_grad():
        last.weight.zero_()  # type: ignore[union-attr, operator]
        last.bias.copy_(torch.tensor([1.0, -2.0, 3.0]))  # type: ignore[union-attr, operator]
        model.residual.gate.weight.zero_()
        model.residual.gate.bias.copy_(torch.tensor([0.0, np.log(3.0), -np.log(3.0)]))
    output = run(model, windows.batch(slice(0, 5))[0])
    expected = 0.4 * np.array(scale.increment_scale) * [0.5, 0.75, 0.25] * [1.0, -2.0, 3.0]
    np.testing.assert_allclose((output.increment - output.physics).numpy(), np.tile(expected, (5, 1)), rtol=1e-3)
    np.testing.assert_allclose(output.correction.numpy()[0], [1.0, -2.0, 3.0])


@pytest.mark.parametrize("inputs", ["raw", "normalised"])
def test_the_residual_sees_context_deviation_latest_row_and_physics(
    make_config: MakeConfig, orca: Vehicle, scale: Normalisation, windows: TrainingWindows, inputs: str
) -> None:
    model = build(make_config(residual={"inputs": inputs}), orca, scale)
    assert model.residual is not None
    seen: list[torch.Tensor] = []
    model.residual.register_forward_pre_hook(lambda _, given: seen.append(given[0]))
    window, _ = windows.batch(slice(0, 6))
    output = run(model, window)
    q, raw, state = seen[0].numpy(), window[:, -1].numpy(), window[:, -1, :3].numpy() + output.physics.numpy()
    mean, std = np.array(scale.input_mean), np.array(scale.input_std)
    increment = output.physics.numpy()
    latest = raw
    if inputs == "normalised":
        latest, state = (raw - mean) / std, (state - mean[:3]) / std[:3]
        increment = increment / scale.increment_scale
    assert q.shape == (6, 6 + 7 + 17 + 3 + 3)
    for part, expected in (
        (q[:, 6:13], latest),
        (q[:, 13:30], output.deviation.numpy()),
        (q[:, 30:33], state),
        (q[:, 33:], increment),
    ):
        np.testing.assert_allclose(part, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", ABLATIONS)
def test_an_ablation_runs_and_lacks_its_component(
    make_config: MakeConfig, orca: Vehicle, scale: Normalisation, windows: TrainingWindows, name: str
) -> None:
    model = build(make_config(**ABLATIONS[name]), orca, scale)
    window, _ = windows.batch(slice(0, 5))
    output = run(model, window)
    assert output.increment.shape == (5, 3)
    assert (model.fusion.ssm is None) == (name == "no_ssm")
    assert (model.fusion.gru is None) == (name == "no_gru")
    assert (model.head is None) == (output.deviation is None) == (name in ("no_adaptation", "neural_only"))
    assert (model.residual is None) == (output.correction is None) == (name == "no_residual")
    assert (model.physics is None) == (output.physics is None) == (output.theta is None) == (name == "neural_only")
    if name == "no_adaptation":
        np.testing.assert_allclose(output.theta.numpy(), np.tile(orca.nominal, (5, 1)), rtol=1e-6)
    if name == "no_residual":
        assert torch.equal(output.increment, output.physics)


@pytest.mark.parametrize("name", ABLATIONS)
def test_an_ablation_trains_all_that_it_has(
    make_config: MakeConfig, orca: Vehicle, scale: Normalisation, windows: TrainingWindows, name: str
) -> None:
    model = build(make_config(**ABLATIONS[name]), orca, scale)
    window, target = windows.batch(slice(0, 64))
    (model(window).increment - target).square().sum().backward()
    assert all(parameter.grad is not None and parameter.grad.any() for parameter in model.parameters())


def test_the_default_model_is_smaller_than_the_papers(orca: Vehicle, scale: Normalisation) -> None:
    for car in (orca, load_vehicle("av21")):
        model = build(load_model_config("dynssm"), car, scale)
        assert sum(parameter.numel() for parameter in model.parameters()) < 81_000


@pytest.mark.parametrize("integrator", ["euler", "rk4"])
def test_a_standing_car_has_a_prediction_and_gradients(
    make_config: MakeConfig, orca: Vehicle, scale: Normalisation, integrator: str
) -> None:
    model = build(make_config(physics={"integrator": integrator}), orca, scale)
    output = model(torch.zeros(2, 4, 7))
    assert output.increment.isfinite().all()
    output.increment.sum().backward()
    assert all(parameter.grad is not None and parameter.grad.isfinite().all() for parameter in model.parameters())


def test_effects_of_the_vehicle_act_in_the_physics_layer(
    make_config: MakeConfig, orca: Vehicle, windows: TrainingWindows
) -> None:
    car = orca.with_effect("steering_offset", {"offset": 0.02}).with_effect("front_grip", {"factor": 0.8})
    config = make_config().physics
    assert config is not None
    window, _ = windows.batch(slice(0, 50))
    theta = torch.tensor(car.nominal, dtype=torch.float64).expand(50, -1)
    found = PhysicsLayer(car, config)(window[:, -1].double(), theta)
    np.testing.assert_allclose(found.numpy(), single_track(car, window), atol=1e-14)
    assert np.abs(found.numpy() - single_track(orca, window)).max() > 1e-3
    assert len(COEFFICIENTS) == theta.shape[1]


def test_a_model_with_load_transfer_leaves_the_vehicle_as_it_is(make_config: MakeConfig) -> None:
    car = load_vehicle("av21")
    assert make_config().with_physics.modelled(car) is car
    assert make_config(physics=None, adaptation=None).with_physics.modelled(car) is car
