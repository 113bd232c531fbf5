"""Beyond the paper: increments as inputs, the physics' past errors, the error memory, predictions in hindsight."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from dynssm_ros.errors import ConfigurationError
from dynssm_ros.learning.export import save_artifact
from dynssm_ros.learning.models.dynssm.config import InnovationConfig, InWindowConfig
from dynssm_ros.learning.models.dynssm.innovation import InnovationFilter, InWindowErrors
from dynssm_ros.learning.models.dynssm.network import DynSSM
from dynssm_ros.learning.models.registry import load_model_config
from dynssm_ros.learning.stages import train
from dynssm_ros.runtime.artifact import Normalisation
from dynssm_ros.runtime.models import SingleTrackEwma
from dynssm_ros.signals.recording import Recording
from dynssm_ros.vehicle import Vehicle

SCALES = Normalisation(
    input_mean=(0.0,) * 7, input_std=(1.0,) * 7, state_scale=(1.0,) * 3, increment_scale=(0.1, 0.2, 0.4)
)
S_DELTA = torch.tensor(SCALES.increment_scale)
BEYOND: dict[str, Any] = {
    "history": 0.2,
    "physics": {"nominal": "vehicle"},
    "inputs": {"features": "increments", "history": 0.08, "physics_errors": True},
    "innovation": {"history": 0.08},
    "in_window_errors": {"history": 0.1},
}


def windows(recording: Recording, H: int, count: int = 20) -> torch.Tensor:
    rows = np.lib.stride_tricks.sliding_window_view(recording.matrix, H, axis=0).transpose(0, 2, 1)
    return torch.tensor(rows[:count].copy(), dtype=torch.float32)


def disturbed(given: torch.Tensor, each: torch.Tensor) -> torch.Tensor:
    """TrainingWindows whose states drift by ``each`` more in every step."""
    steps = torch.arange(given.shape[1], dtype=torch.float32)
    return torch.cat([given[..., :3] + steps[None, :, None] * each, given[..., 3:]], dim=-1)


def test_past_errors_show_what_was_added(
    drive: Callable[..., Recording], make_config: Callable[..., Any], orca: Vehicle
) -> None:
    model = DynSSM(make_config(physics={"nominal": "vehicle"}, inputs={"physics_errors": True}), orca, SCALES)
    given = windows(drive(orca, 100), model.config.rows(0.02))
    seen = model._seen(given, model.changes.states(given))
    np.testing.assert_allclose(seen[..., 7:].detach(), 0.0, atol=2e-5)
    added = torch.tensor([0.01, -0.02, 0.04])
    given[:, -1, :3] += added
    errors = model._seen(given, model.changes.states(given))[..., 7:].detach()
    assert errors.shape[1] == model.config.rows(0.02) - 1
    about_the_mean = torch.tensor([-1.0, -1.0, 2.0])[:, None] / 3 * added / S_DELTA  # of the three steps in the window
    np.testing.assert_allclose(errors, about_the_mean.expand(20, 3, 3), atol=2e-5)


def test_increments_do_not_depend_on_the_absolute_state(
    drive: Callable[..., Recording], make_config: Callable[..., Any], orca: Vehicle
) -> None:
    model = DynSSM(make_config(inputs={"features": "increments"}), orca, SCALES)
    given = windows(drive(orca, 100), model.config.rows(0.02))
    shifted = given + torch.tensor([3.0, 1.0, -2.0, 0.2, 0.1, 0.0, 0.0])
    there, here = (model._seen(each, model.changes.states(each)) for each in (shifted, given))
    np.testing.assert_allclose(there.detach(), here.detach(), atol=1e-4)
    assert here.abs().max() <= 4.0


def test_untrained_memory_is_the_physics_less_its_average_error(
    drive: Callable[..., Recording], make_config: Callable[..., Any], orca: Vehicle
) -> None:
    baseline = SingleTrackEwma(orca)
    config = make_config(
        history=0.62,
        physics={"nominal": "vehicle"},
        innovation={"history": 0.6, "decay": 0.9},
        residual=None,
        adaptation={"hidden": 4, "alpha": 1e-9},
    )
    model = DynSSM(config, orca, SCALES).eval()
    given = disturbed(windows(drive(orca, 200), 31), torch.tensor([0.01, 0.02, -0.03]))
    expected = baseline.predict(given.double().numpy()).state - given[:, -1, :3].numpy()
    np.testing.assert_allclose(model(given).increment.detach(), expected, atol=3e-5)


def test_a_constant_error_of_the_physics_vanishes(orca: Vehicle) -> None:
    memory = InnovationFilter(InnovationConfig(history=1.0), 6)
    physics = torch.randn(5, 12, 3)
    constant = torch.tensor([3.0, -50.0, 0.5])
    increments = physics[:, :-1] + constant
    q, _, mean = memory(increments, physics, 3)
    np.testing.assert_allclose(q.detach(), (physics[:, -4:] + constant).detach(), atol=1e-4)
    np.testing.assert_allclose(mean.detach(), constant.expand(5, 3), atol=1e-4)


def test_hindcasts_are_the_predictions_of_earlier_windows() -> None:
    memory = InnovationFilter(InnovationConfig(history=1.0), 4)
    torch.nn.init.normal_(memory.filter)
    torch.nn.init.normal_(memory.A)
    increments, physics = torch.randn(5, 11, 3), torch.randn(5, 12, 3)
    q, _, _ = memory(increments, physics, 6)
    for back in range(7):
        then, _, _ = memory(increments[:, : 11 - back], physics[:, : 12 - back], 0)
        np.testing.assert_allclose(q[:, 6 - back].detach(), then[:, 0].detach(), atol=1e-4)
    live = [each.detach() for each in memory(increments, physics, 6)]
    memory.freeze()
    for now, frozen in zip(live, memory(increments, physics, 6), strict=True):
        np.testing.assert_allclose(frozen, now, atol=1e-6)


def test_trust_follows_what_could_be_predicted() -> None:
    hindcast = InWindowErrors(InWindowConfig(history=1.0, shrinkage_weight=1.0), 14)
    predicted = torch.randn(2000, 14, 3)
    np.testing.assert_allclose(hindcast.shrinkage(predicted, predicted), 1.0)
    np.testing.assert_allclose(hindcast.shrinkage(predicted, 0.5 * predicted).mean(), 0.5, atol=0.06)
    assert hindcast.shrinkage(predicted, torch.randn(2000, 14, 3)).mean() < 0.2
    assert hindcast.shrinkage(predicted, -predicted).max() < 0.4  # what is wrong is at most ignored, not inverted
    # without evidence the prior holds
    np.testing.assert_allclose(hindcast.shrinkage(1e-4 * predicted, torch.zeros(2000, 14, 3)), 1.0, atol=1e-4)


def test_the_prior_of_trust_is_the_weakest_that_costs_nothing() -> None:
    generator = torch.Generator().manual_seed(0)
    drawn = torch.randn(20_000, 15, 3, generator=generator)
    # the first channel can always be predicted, the second in half of the stretches, the third never
    can = torch.ones(20_000, 1, 3)
    can[::2, :, 1] = can[:, :, 2] = 0.0
    happened = can * drawn + torch.randn(20_000, 15, 3, generator=generator)
    hindcast = InWindowErrors(InWindowConfig(history=1.0, shrinkage_weight=1.0), 14)
    hindcast.fit_shrinkage(drawn[:, :14], happened[:, :14], drawn[:, 14], happened[:, 14])
    always, half, never = hindcast.weight.tolist()
    assert always > 20
    assert never == 1.0
    assert half < 10


def test_stated_variance_follows_the_recent_errors_and_covers_nine_in_ten() -> None:
    generator = torch.Generator().manual_seed(0)
    hindcast = InWindowErrors(InWindowConfig(history=1.0), 14)
    level = torch.tensor([0.5, 2.0]).repeat(20_000)[:, None, None]  # a calm and a rough stretch
    errors = level * torch.randn(40_000, 15, 3, generator=generator)
    past, now = errors[:, :14], errors[:, 14]
    hindcast.fit_variance(past, now)
    std = hindcast.spread(past, torch.zeros_like(past)).sqrt()
    inside = now.abs() <= 1.645 * std
    np.testing.assert_allclose(inside.float().mean(0), 0.9, atol=0.005)
    calm, rough = inside[0::2].float().mean(), inside[1::2].float().mean()
    assert (
        min(calm, rough) > 0.86
    )  # a constant variance would cover all of the calm stretch and 8 in 10 of the rough one
    assert (std[1::2].mean() / std[0::2].mean()) > 3


def test_constant_errors_get_a_constant_variance() -> None:
    hindcast = InWindowErrors(InWindowConfig(history=1.0), 14)
    generator = torch.Generator().manual_seed(0)
    errors = torch.randn(20_000, 15, 3, generator=generator)
    hindcast.fit_variance(errors[:, :14], errors[:, 14])
    constant, share = hindcast.variance
    assert (share < 0.1 * constant).all()


def test_the_deployed_graph_has_it_all(
    drive: Callable[..., Recording], make_config: Callable[..., Any], orca: Vehicle, tmp_path: Path
) -> None:
    trained = train(drive(orca, 1500), make_config(**BEYOND), orca, tmp_path / "checkpoint.pt")
    artifact = save_artifact(trained, tmp_path / "model")  # refuses a graph that differs from torch
    assert artifact.card.architecture["innovation"]["history"] == 0.08


def test_training_does_without_trust(
    drive: Callable[..., Recording], make_config: Callable[..., Any], orca: Vehicle
) -> None:
    model = DynSSM(make_config(**BEYOND), orca, SCALES)
    given = disturbed(windows(drive(orca, 100), 10), torch.tensor([0.01, 0.02, -0.03]))
    given[..., :3] += 0.05 * torch.randn(given[..., :3].shape, generator=torch.Generator().manual_seed(0))
    learning = model.train()(given).increment
    running = model.eval()(given).increment
    assert (learning - running).abs().max() > 1e-4


NEURAL = "base: dynssm_paper_orca\nphysics: null\nadaptation: null\nresidual: {scale: 3.0}\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (f"{NEURAL}inputs: {{physics_errors: true}}", "need physics"),
        ("base: dynssm\nresidual: {inputs: raw}", "residual.inputs: raw goes with inputs as in the paper"),
        (
            "base: dynssm_paper_orca\ninnovation: {history: 0.3}",
            "reach back over 16 rows; a window of 0.3 s at T_s = 0.02 s has 15",
        ),
        ("base: dynssm_paper_orca\nin_window_errors: {history: 0.1}", "in_window_errors needs innovation"),
        (
            "base: dynssm_paper_orca\nresidual: {inputs: normalised}\ninputs: {features: increments, history: 0.3}",
            "inputs.history: 15 rows; a window of 0.3 s at T_s = 0.02 s has 14",
        ),
    ],
)
def test_what_cannot_be_is_refused(text: str, message: str, tmp_path: Path, orca: Vehicle) -> None:
    (tmp_path / "m.yaml").write_text(f"{text}\nname: m\n")
    with pytest.raises(ConfigurationError, match=message):
        DynSSM(load_model_config(tmp_path / "m.yaml"), orca, SCALES)


def test_a_residual_is_not_believed_beyond_the_errors_that_it_is_there_to_correct() -> None:
    generator = torch.Generator().manual_seed(0)
    happened = torch.randn(2000, 14, 3, generator=generator)
    residual = torch.randn(2000, 3, generator=generator)
    hindcast = InWindowErrors(InWindowConfig(history=1.0, limit=1.0), 14)
    small = hindcast.limited(residual, happened + 0.01 * torch.randn(2000, 14, 3, generator=generator), happened)
    assert small.abs().max() < 0.02
    large = hindcast.limited(residual, happened + 100.0, happened)
    np.testing.assert_allclose(large, residual, rtol=1e-3)
    assert torch.equal(
        hindcast.limited(residual, happened, happened).abs() < 1e-10, torch.ones(2000, 3, dtype=torch.bool)
    )
    assert InWindowErrors(InWindowConfig(history=1.0), 14).limited(residual, happened, happened) is residual
