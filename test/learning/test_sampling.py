"""Training within a bound on memory: a sample of all logs, in proportion to their length."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from dynssm_ros import train
from dynssm_ros.errors import ConfigurationError
from dynssm_ros.learning.sampling import sampled
from dynssm_ros.signals.recording import Recording
from dynssm_ros.simulation.laps import as_recording, simulate
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import load_vehicle

ROW_MB = 600 / 1e6


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Three logs, together 6,003 rows."""
    folder = tmp_path_factory.mktemp("logs")
    for k, duration in enumerate((60.0, 40.0, 20.0)):
        run = simulate(load_vehicle("orca"), load_track("club"), duration, seed=k, noise=(0.01, 0.01, 0.03))
        as_recording(run).save(folder / f"{k}.parquet")
    return [folder / f"{k}.parquet" for k in range(3)]


@pytest.mark.parametrize(("holdout", "rows"), [(0.0, 6003), (0.5, 3002)])
def test_the_sample_is_of_all_logs_and_within_the_memory(files: list[Path], holdout: float, rows: int) -> None:
    sample = sampled(files, 2400 * ROW_MB, holdouts=[holdout] * len(files))
    assert len(sample) == pytest.approx(2400, abs=5)
    assert len(sample.info.source) == 3
    np.testing.assert_allclose(np.bincount(sample.segment) / len(sample), [0.5, 1 / 3, 1 / 6], atol=0.01)
    assert len(sampled(files, 1000.0, holdouts=[holdout] * len(files))) == pytest.approx(rows, abs=1)
    first = Recording.load(files[0]).time
    last = first[round((1 - holdout) * len(first)) - 1]
    assert last > sample.time[sample.segment == 0].max() > sample.time[sample.segment == 0].min() > first[0]


def test_with_memory_for_all_the_model_is_the_same_and_what_cannot_be_sampled_is_refused(
    files: list[Path], tmp_path: Path
) -> None:
    whole, same = (train(files, "ridge", "orca", tmp_path / f"{mb}", memory=mb) for mb in (None, 1000.0))
    for name, value in whole.trained.model.state_dict().items():
        assert torch.equal(value, same.trained.model.state_dict()[name]), name
    little = train(files, "ridge", "orca", tmp_path / "little", memory=2400 * ROW_MB)
    assert 0 < little.trained.windows[0] < 0.45 * whole.trained.windows[0]
    with pytest.raises(ConfigurationError, match="expected files"):
        train(Recording.load(files[0]), "ridge", "orca", tmp_path / "no", memory=100.0)
    with pytest.raises(ConfigurationError, match=r"memory 1 MB: room for 1666 rows; expected at least 1\.2 MB"):
        sampled(files, 1.0)
