"""Beyond the paper: increments as inputs, the physics' past errors, the innovation filter."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from dynssm_ros.errors import ConfigurationError
from dynssm_ros.learning.export import save_artifact
from dynssm_ros.learning.models.dynssm.config import InnovationConfig
from dynssm_ros.learning.models.dynssm.innovation import InnovationFilter
from dynssm_ros.learning.models.dynssm.network import DynSSM
from dynssm_ros.learning.models.registry import load_model_config
from dynssm_ros.learning.stages import train
from dynssm_ros.runtime.artifact import Normalisation
from dynssm_ros.runtime.baselines import SingleTrackEwma
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
    seen = model._seen(given, model.changes.states(given), model._nominal_increments(given))
    np.testing.assert_allclose(seen[..., 7:].detach(), 0.0, atol=2e-5)
    added = torch.tensor([0.01, -0.02, 0.04])
    given[:, -1, :3] += added
    errors = model._seen(given, model.changes.states(given), model._nominal_increments(given))[..., 7:].detach()
    assert errors.shape[1] == model.config.rows(0.02) - 1
    about_the_mean = torch.tensor([-1.0, -1.0, 2.0])[:, None] / 3 * added / S_DELTA  # of the three steps in the window
    np.testing.assert_allclose(errors, about_the_mean.expand(20, 3, 3), atol=2e-5)


def test_increments_do_not_depend_on_the_absolute_state(
    drive: Callable[..., Recording], make_config: Callable[..., Any], orca: Vehicle
) -> None:
    model = DynSSM(make_config(inputs={"features": "increments"}), orca, SCALES)
    given = windows(drive(orca, 100), model.config.rows(0.02))
    shifted = given + torch.tensor([3.0, 1.0, -2.0, 0.2, 0.1, 0.0, 0.0])
    there, here = (model._seen(each, model.changes.states(each), None) for each in (shifted, given))
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
    q, _, mean = memory(increments, physics)
    np.testing.assert_allclose(q.detach(), (physics[:, -1] + constant).detach(), atol=1e-4)
    np.testing.assert_allclose(mean.detach(), constant.expand(5, 3), atol=1e-4)


def test_frozen_kernels_are_the_learned_ones() -> None:
    memory = InnovationFilter(InnovationConfig(history=1.0), 4)
    torch.nn.init.normal_(memory.filter)
    torch.nn.init.normal_(memory.A)
    increments, physics = torch.randn(5, 11, 3), torch.randn(5, 12, 3)
    live = [each.detach() for each in memory(increments, physics)]
    memory.freeze()
    for now, frozen in zip(live, memory(increments, physics), strict=True):
        np.testing.assert_allclose(frozen, now, atol=1e-6)


def test_the_deployed_graph_has_it_all(
    drive: Callable[..., Recording], make_config: Callable[..., Any], orca: Vehicle, tmp_path: Path
) -> None:
    trained = train(drive(orca, 1500), make_config(**BEYOND), orca, tmp_path / "checkpoint.pt")
    artifact = save_artifact(trained, tmp_path / "model")  # refuses a graph that differs from torch
    assert artifact.card.architecture["innovation"]["history"] == 0.08


NEURAL = "base: dynssm_paper_orca\nphysics: null\nadaptation: null\nresidual: {scale: 3.0}\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (f"{NEURAL}inputs: {{physics_errors: true}}", "need physics"),
        ("base: dynssm\nresidual: {inputs: raw}", "residual.inputs: raw goes with inputs as in the paper"),
        (
            "base: dynssm_paper_orca\nhistory: 0.3\ninnovation: {history: 0.3}",
            "reaches back over 16 rows; a window of 0.3 s at T_s = 0.02 s has 15",
        ),
        (
            "base: dynssm_paper_orca\nhistory: 0.3\nresidual: {inputs: normalised}\n"
            "inputs: {features: increments, history: 0.3}",
            "inputs.history: 15 rows; a window of 0.3 s at T_s = 0.02 s has 14",
        ),
    ],
)
def test_what_cannot_be_is_refused(text: str, message: str, tmp_path: Path, orca: Vehicle) -> None:
    (tmp_path / "m.yaml").write_text(f"{text}\nname: m\n")
    with pytest.raises(ConfigurationError, match=message):
        DynSSM(load_model_config(tmp_path / "m.yaml"), orca, SCALES)
