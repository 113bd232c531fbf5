"""The physics' own past errors as encoder inputs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from dynssm_ros.errors import ConfigurationError
from dynssm_ros.learning.configuration import load_model_config
from dynssm_ros.learning.dynssm import DynSSM
from dynssm_ros.learning.export import save_artifact
from dynssm_ros.learning.training import train
from dynssm_ros.runtime.artifact import Normalisation
from dynssm_ros.signals.recording import Recording
from dynssm_ros.vehicle import Vehicle

SCALES = Normalisation(
    input_mean=(0.0,) * 7, input_std=(1.0,) * 7, state_scale=(1.0,) * 3, increment_scale=(0.1, 0.2, 0.4)
)


def windows(recording: Recording, H: int, count: int = 20) -> torch.Tensor:
    rows = np.lib.stride_tricks.sliding_window_view(recording.matrix, H, axis=0).transpose(0, 2, 1)
    return torch.tensor(rows[:count].copy(), dtype=torch.float32)


def test_they_vanish_where_the_physics_is_right_and_show_what_was_added(
    drive: Callable[..., Recording], make_config: Callable[..., Any], orca: Vehicle
) -> None:
    model = DynSSM(make_config(physics_errors=True), orca, SCALES)
    given = windows(drive(orca, 100), model.config.H)
    np.testing.assert_allclose(model._past_errors(given).detach(), 0.0, atol=2e-5)
    added = torch.tensor([0.01, -0.02, 0.04])
    given[:, 2, :3] += added
    errors = model._past_errors(given).detach()
    np.testing.assert_allclose(errors[:, 2], (added / torch.tensor(SCALES.increment_scale)).expand(20, 3), atol=2e-5)
    assert (errors[:, 0] == 0).all()


def test_errors_are_bounded(drive: Callable[..., Recording], make_config: Callable[..., Any], orca: Vehicle) -> None:
    model = DynSSM(make_config(physics_errors=True), orca, SCALES)
    given = windows(drive(orca, 100), model.config.H)
    given[:, 1, 2] += 1e6
    assert model._past_errors(given).abs().max() <= 8.0


def test_the_deployed_graph_computes_them_too(
    drive: Callable[..., Recording], make_config: Callable[..., Any], orca: Vehicle, tmp_path: Path
) -> None:
    trained = train(drive(orca, 1500), make_config(physics_errors=True), orca, tmp_path / "checkpoint.pt")
    artifact = save_artifact(trained, tmp_path / "model")  # refuses a graph that differs from torch
    assert artifact.card.architecture["physics_errors"] is True


def test_without_physics_they_are_refused(tmp_path: Path) -> None:
    (tmp_path / "m.yaml").write_text("base: dynssm_orca_neural_only\nname: m\nphysics_errors: true\n")
    with pytest.raises(ConfigurationError, match="physics_errors needs physics"):
        load_model_config(tmp_path / "m.yaml")
