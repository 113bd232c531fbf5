"""The stated variance: fitted to stretches that further models did not know, in stages that can be interrupted."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from dynssm_ros.learning.dataset import all_windows
from dynssm_ros.learning.models.base import ModelConfig
from dynssm_ros.learning.stages import checkpoints, train
from dynssm_ros.signals.recording import Recording
from dynssm_ros.vehicle import Vehicle

MakeConfig = Callable[..., ModelConfig]

WITH_PARTS = {
    "history": 0.12,
    "innovation": {"history": 0.04},
    "in_window_errors": {"history": 0.04, "folds": 2},
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
            update={"in_window_errors": with_parts.in_window_errors.model_copy(update={"folds": 1})}
        )
        without = train(recording.select(~part), other, orca, tmp_path / f"{part[0]}.pt")
        left_out = all_windows(recording.select(part), with_parts.rows(0.02), 0.0)
        errors.append(without.model.held_out_errors(*left_out.batch(slice(None))))
    fitted = trained.model.in_window.variance.clone()
    trained.model.fit_variance(*(torch.cat(each) for each in zip(*errors, strict=True)))
    assert torch.equal(trained.model.in_window.variance, fitted)
    # the prediction itself knows nothing of it
    plain = train(
        recording, make_config(**WITH_PARTS | {"in_window_errors": {"history": 0.04}}), orca, tmp_path / "b.pt"
    )
    different = {
        name
        for name, value in plain.model.state_dict().items()
        if not torch.equal(value, trained.model.state_dict()[name])
    }
    assert different == {"in_window.variance"}


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
    plain = make_config(
        **WITH_PARTS | {"training": config.training.model_dump(), "in_window_errors": {"history": 0.04}}
    )
    alone = train(recording, plain, orca, tmp_path / "b.pt")
    assert torch.equal(trained.model.in_window.variance, alone.model.in_window.variance)
    assert [path.name for path in checkpoints(config, tmp_path / "a.pt") if path.is_file()] == ["a.pt"]
