"""The online layer: fitted to stretches that further models did not know, in stages that can be interrupted."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from dynssm_ros.learning.earned_layer import LayerBase
from dynssm_ros.learning.models.base import ModelConfig
from dynssm_ros.learning.stages import checkpoints, train
from dynssm_ros.signals.recording import Recording
from dynssm_ros.vehicle import Vehicle

MakeConfig = Callable[..., ModelConfig]

WITH_PARTS = {
    "history": 0.12,
    "innovation": {"history": 0.04},
    "online": {"folds": 2, "throttle_steps": False},
    "training": {"epochs": 4, "batch_size": 16},
}


def test_the_layer_is_fitted_to_what_models_say_of_parts_that_they_did_not_know(
    drive: Callable[..., Recording], make_config: MakeConfig, orca: Vehicle, tmp_path: Path, monkeypatch: Any
) -> None:
    monkeypatch.setattr("dynssm_ros.learning.earned_layer.GAIN_WANTED", -10.0)
    recording = drive(orca, 800)
    config = make_config(**WITH_PARTS)
    trained = train(recording, config, orca, tmp_path / "a.pt")
    second = np.arange(len(recording)) >= len(recording) // 2
    known = []
    for part in (~second, second):
        other = config.with_training(epochs=1).model_copy(update={"online": None})
        known.append(
            (train(recording.select(~part), other, orca, tmp_path / f"{part[0]}.pt").model, recording.select(part))
        )
    physics = config.with_physics
    base = LayerBase(trained.vehicle, physics, trained.normalisation, trained.H, config.online)
    layer = base.fitted(base.features(True), known).layer
    np.testing.assert_array_equal(layer.mean, trained.online.mean)
    np.testing.assert_array_equal(layer.covariance, trained.online.covariance)
    # the model itself knows nothing of it
    plain = train(recording, make_config(**WITH_PARTS | {"online": None}), orca, tmp_path / "b.pt")
    for name, value in plain.model.state_dict().items():
        assert torch.equal(value, trained.model.state_dict()[name])


@pytest.fixture(scope="module")
def whole(drive: Callable[..., Recording], make_config: MakeConfig, orca: Vehicle, tmp_path_factory: Any) -> Any:
    """A training that nobody interrupted."""
    return train(drive(orca, 800), make_config(**WITH_PARTS), orca, tmp_path_factory.mktemp("whole") / "whole.pt")


@pytest.mark.parametrize("epoch", [*(pytest.param(epoch, marks=pytest.mark.slow) for epoch in (3, 5)), 6])
def test_an_interrupted_stage_is_gone_on_with(
    drive: Callable[..., Recording], make_config: MakeConfig, orca: Vehicle, whole: Any, tmp_path: Path, epoch: int
) -> None:
    def interrupt(done: int, total: int, words: str) -> None:
        if done == epoch:
            raise KeyboardInterrupt

    recording, config = drive(orca, 800), make_config(**WITH_PARTS)
    with pytest.raises(KeyboardInterrupt):
        train(recording, config, orca, tmp_path / "cut.pt", progress=interrupt)
    told: list[int] = []
    resumed = train(recording, config, orca, tmp_path / "cut.pt", progress=lambda done, *_: told.append(done))
    ours, theirs = whole.model.state_dict(), resumed.model.state_dict()
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)
    assert told == list(range(epoch + 1, 7))
    assert all(path.is_file() for path in checkpoints(config, tmp_path / "cut.pt"))


def test_too_little_to_leave_any_out_is_trained_on_all_the_same(
    drive: Callable[..., Recording], make_config: MakeConfig, orca: Vehicle, tmp_path: Path
) -> None:
    recording = drive(orca, 400)  # half of it has no validation block
    blocks = {"validation_block": 2.0, "validation_every": 4}
    config = make_config(**WITH_PARTS | {"training": WITH_PARTS["training"] | blocks})
    trained = train(recording, config, orca, tmp_path / "a.pt")
    assert (trained.network_gain, "network" in trained.features.names) == (None, False)
    assert [path.name for path in checkpoints(config, tmp_path / "a.pt") if path.is_file()] == ["a.pt"]
