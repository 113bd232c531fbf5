"""The stated variance: fitted to stretches that further models did not know, in stages that can be interrupted."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from dynssm_ros.learning.configuration import ModelConfig
from dynssm_ros.learning.dataset import all_windows
from dynssm_ros.learning.training import checkpoints, train
from dynssm_ros.signals.recording import Recording
from dynssm_ros.vehicle import Vehicle

MakeConfig = Callable[..., ModelConfig]

WITH_PARTS = {
    "H": 6,
    "memory": {"taps": 2},
    "hindcast": {"steps": 2, "folds": 2},
    "training": {"epochs": 4, "batch_size": 16},
}


def test_the_variance_is_fitted_to_the_errors_on_parts_that_the_model_did_not_know(
    drive: Callable[..., Recording], make_config: MakeConfig, orca: Vehicle, tmp_path: Path
) -> None:
    recording = drive(orca, 800)
    with_parts = make_config(**WITH_PARTS)
    trained = train(recording, with_parts, orca, tmp_path / "a.pt")
    second = np.arange(len(recording)) >= len(recording) // 2
    errors = []
    for part in (~second, second):
        other = with_parts.with_training(epochs=1).model_copy(
            update={"hindcast": with_parts.hindcast.model_copy(update={"folds": 1})}
        )
        without = train(recording.select(~part), other, orca, tmp_path / f"{part[0]}.pt")
        left_out = all_windows(recording.select(part), with_parts.H, with_parts.training.min_speed)
        errors.append(without.model.errors(*left_out.batch(slice(None))))
    fitted = trained.model.hindcast.variance.clone()
    trained.model.fit_variance(*(torch.cat(each) for each in zip(*errors, strict=True)))
    assert torch.equal(trained.model.hindcast.variance, fitted)
    # the prediction itself knows nothing of it
    plain = train(recording, make_config(**WITH_PARTS | {"hindcast": {"steps": 2}}), orca, tmp_path / "b.pt")
    different = {
        name
        for name, value in plain.model.state_dict().items()
        if not torch.equal(value, trained.model.state_dict()[name])
    }
    assert different == {"hindcast.variance"}


@pytest.mark.parametrize("epoch", [3, 5, 6])
def test_an_interrupted_stage_is_gone_on_with(
    drive: Callable[..., Recording], make_config: MakeConfig, orca: Vehicle, tmp_path: Path, epoch: int
) -> None:
    def interrupt(done: int, total: int, words: str) -> None:
        if done == epoch:
            raise KeyboardInterrupt

    recording, config = drive(orca, 800), make_config(**WITH_PARTS)
    whole = train(recording, config, orca, tmp_path / "whole.pt")
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
    plain = make_config(**WITH_PARTS | {"training": config.training.model_dump(), "hindcast": {"steps": 2}})
    alone = train(recording, plain, orca, tmp_path / "b.pt")
    assert torch.equal(trained.model.hindcast.variance, alone.model.hindcast.variance)
    assert [path.name for path in checkpoints(config, tmp_path / "a.pt") if path.is_file()] == ["a.pt"]
