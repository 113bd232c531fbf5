"""Training on logs that come and go: every window once an epoch, none of the validation's rows, whatever the room."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

import benchmarks.rivals  # noqa: F401 - one is trained
from dynssm_ros import train
from dynssm_ros.errors import ConfigurationError
from dynssm_ros.learning.dataset import SplitConfig, all_windows, split_windows
from dynssm_ros.learning.streaming import RowStream, StreamedWindows
from dynssm_ros.signals.recording import Recording
from dynssm_ros.simulation.laps import as_recording, simulate
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import load_vehicle

ORCA = load_vehicle("orca")
H = 15
SAMPLE_MB = 1200 / 1e6  # for each row of the sample


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Three logs, together 6,003 rows."""
    folder = tmp_path_factory.mktemp("logs")
    for k, duration in enumerate((60.0, 40.0, 20.0)):
        run = simulate(ORCA, load_track("club"), duration, seed=k, noise=(0.01, 0.01, 0.03))
        as_recording(run).save(folder / f"{k}.parquet")
    return [folder / f"{k}.parquet" for k in range(3)]


def pairs(batches: list[tuple[torch.Tensor, torch.Tensor]]) -> set[bytes]:
    """Windows and their increments, as something that can be compared."""
    return {row.numpy().tobytes() for window, target in batches for row in torch.cat([window.flatten(1), target], 1)}


@pytest.mark.parametrize("room", [300, 1500, 10**6])
def test_an_epoch_has_every_window_once_and_no_validation_row(files: list[Path], room: int) -> None:
    stream = RowStream(files, 2400 * SAMPLE_MB)
    stream.room = room
    stream.pieces = [part for piece in stream.pieces for part in stream._cut(piece)]
    training, held = split_windows(stream.sample(), H, SplitConfig(), 0.0, 1)
    windows = stream.windows(training, 0.0)
    assert isinstance(windows, StreamedWindows)
    batches = list(windows.epoch(torch.Generator().manual_seed(0), 64))
    assert sum(len(target) for _, target in batches) == len(windows) == len(pairs(batches))
    whole = [all_windows(Recording.load(file), H, 0.0) for file in files]
    assert pairs(batches) <= pairs([batch for each in whole for batch in each.batches()])
    assert not pairs(batches) & pairs(list(held.batches()))
    rows = {row.numpy().tobytes() for window, _ in batches for row in window.reshape(-1, 7)}
    assert not rows & {row.numpy().tobytes() for window, _ in held.batches() for row in window.reshape(-1, 7)}
    lost = sum(map(len, whole)) - len(windows) - len(held)
    cuts = len(stream.pieces) + 2 * len(files)
    blocks = 2 * (len(stream.sample()) // 50 // 6 + 1)  # validation blocks are a second long
    assert lost <= (cuts + blocks) * (H + 1)
    assert max(map(len, windows._groups(torch.Generator().manual_seed(1)))) <= max(room, len(training))


def test_the_order_is_another_one_in_each_epoch_and_the_same_for_the_same_seed(files: list[Path]) -> None:
    stream = RowStream(files, 2400 * SAMPLE_MB)
    training, _ = split_windows(stream.sample(), H, SplitConfig(), 0.0, 1)
    windows = stream.windows(training, 0.0)
    assert isinstance(windows, StreamedWindows)
    draw = torch.Generator().manual_seed(0)
    first, second, again = (
        torch.cat([target for _, target in windows.epoch(generator, 64)])
        for generator in (draw, draw, torch.Generator().manual_seed(0))
    )
    assert not torch.equal(first, second)
    assert torch.equal(first, again)


def test_the_sample_is_of_all_logs_and_within_the_memory(files: list[Path]) -> None:
    stream = RowStream(files, 3000 * SAMPLE_MB)
    sample = stream.sample()
    assert len(sample) == pytest.approx(3000, abs=5)
    assert len(sample.info.source) == 3
    lengths = np.bincount(sample.segment)
    np.testing.assert_allclose(lengths / len(sample), [0.5, 1 / 3, 1 / 6], atol=0.01)
    rest = sum(piece.rows for piece in stream.pieces)
    assert rest + len(sample) == 6003
    assert sum(piece.rows for piece in RowStream(files, 3000 * SAMPLE_MB, holdout=0.5).pieces) < rest / 2


def test_with_room_for_all_the_sample_is_all(files: list[Path]) -> None:
    stream = RowStream(files, 1000.0)
    assert len(stream.sample()) == 6003
    assert [piece.rows for piece in stream.pieces] == []


def test_too_little_room_is_refused(files: list[Path]) -> None:
    with pytest.raises(ConfigurationError, match=r"memory 1 MB: room for 833 rows; expected at least 2\.4 MB"):
        RowStream(files, 1.0)


def test_a_model_is_trained_on_what_does_not_fit_and_what_is_not_in_a_file_is_refused(
    files: list[Path], tmp_path: Path
) -> None:
    """As good as with all in memory, and with memory for all the very same."""
    whole = train(files, "ddm_orca", "orca", tmp_path / "whole", epochs=3)
    same = train(files, "ddm_orca", "orca", tmp_path / "same", epochs=3, memory=1000.0)
    for name, value in whole.trained.model.state_dict().items():
        assert torch.equal(value, same.trained.model.state_dict()[name]), name
    little = train(files, "ddm_orca", "orca", tmp_path / "little", epochs=3, memory=2400 * SAMPLE_MB)
    assert little.trained.windows[0] > 0.9 * whole.trained.windows[0]
    assert (
        little.trained.history["validation/prediction"][-1] < 1.3 * whole.trained.history["validation/prediction"][-1]
    )
    with pytest.raises(ConfigurationError, match="expected files"):
        train(Recording.load(files[0]), "ddm_orca", "orca", tmp_path / "no", memory=100.0)
