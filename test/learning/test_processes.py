"""Training in several processes: gradients of shares are those of the whole, and so are models; a dead process is told."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file

import benchmarks.rivals  # noqa: F401 - one is trained
from dynssm_ros import train
from dynssm_ros.errors import UserError
from dynssm_ros.learning.models.registry import load_model_config
from dynssm_ros.learning.processes import ProcessGroup, run_in_processes
from dynssm_ros.signals.recording import Recording
from dynssm_ros.simulation.laps import as_recording, simulate
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import load_vehicle

CPU = torch.device("cpu")
ORCA = load_vehicle("orca")


MEMBERS = """
import os, signal, torch

def gradients(group, progress, batch):
    weights = torch.ones(batch.shape[1], requires_grad=True)
    ((group.share(batch) @ weights).square().mean() * group.weight(len(batch))).backward()
    group.average_gradients([weights])
    return weights.grad.tolist(), group.average({"rank": float(group.rank)})

def killed(group, progress, what):
    if group.rank == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    group.average({"never": 0.0})

def failed(group, progress, what):
    raise ValueError("no such luck")
"""


@pytest.fixture
def members(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """What processes do, in a module that they can import."""
    (tmp_path / "members_of_a_group.py").write_text(MEMBERS)
    monkeypatch.syspath_prepend(tmp_path)
    return importlib.import_module("members_of_a_group")


@pytest.fixture(scope="module")
def laps() -> Recording:
    return as_recording(simulate(ORCA, load_track("club"), 30.0, seed=1, noise=(0.01, 0.01, 0.03)))


@pytest.mark.parametrize("rows", [1, 2, 3, 7, 64])
def test_weighted_means_of_shares_are_the_mean_of_the_batch(rows: int) -> None:
    batch, groups = torch.randn(rows, 4, dtype=torch.float64), [ProcessGroup() for _ in range(3)]
    for rank, group in enumerate(groups):
        group.rank, group.count = rank, 3
    means = [group.share(batch).mean(0) * group.weight(rows) for group in groups]
    torch.testing.assert_close(torch.stack(means).mean(0), batch.mean(0), rtol=1e-14, atol=1e-14)


@pytest.mark.slow
def test_gradients_of_two_processes_are_those_of_one(members: ModuleType) -> None:
    batch = torch.randn(7, 4, generator=torch.Generator().manual_seed(0))
    together, mean = run_in_processes(2, CPU, None, members.gradients, batch)
    alone, _ = members.gradients(ProcessGroup(), None, batch)
    np.testing.assert_allclose(together, alone, rtol=1e-6)
    assert mean == {"rank": 0.5}


class StoppedError(Exception):
    """Of a training."""


@pytest.mark.slow
def test_two_processes_train_the_model_of_one_and_go_on_with_what_one_began(
    laps: Recording, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    config = load_model_config("ddm_orca").with_training(epochs=3)
    told: list[int] = []

    def stop(done: int, _total: int, _words: str) -> None:
        raise StoppedError

    one = train(laps, config, ORCA, tmp_path / "one")
    with pytest.raises(StoppedError):
        train(laps, config, ORCA, tmp_path / "two", on_progress=stop)
    two = train(
        laps, config, ORCA, tmp_path / "two", processes=2, on_progress=lambda done, _total, _words: told.append(done)
    )
    assert (two.trained.resumed_from, told) == (1, [2, 3])
    assert "distributed" not in capfd.readouterr().err.lower()  # progress is told by us
    for name, losses in one.trained.history.items():
        np.testing.assert_allclose(two.trained.history[name], losses, rtol=1e-4, atol=1e-9, err_msg=name)
    np.testing.assert_allclose(two.trained.validation_rmse, one.trained.validation_rmse, rtol=1e-3)
    names = [load_file(tmp_path / each / "weights.safetensors") for each in ("one", "two")]
    assert names[0].keys() == names[1].keys()


@pytest.mark.slow
@pytest.mark.parametrize(("function", "words"), [("killed", "SIGKILL"), ("failed", "no such luck")])
def test_a_process_that_ends_early_is_named(members: ModuleType, function: str, words: str) -> None:
    with pytest.raises(UserError, match=f"training in 2 processes: .*{words}"):
        run_in_processes(2, CPU, None, getattr(members, function), None)


def test_fabric_is_named_where_it_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dynssm_ros.extras.find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"--processes needs lightning_fabric: pip install 'dynssm_ros\[processes\]'"):
        run_in_processes(2, CPU, None, lambda *_: None, None)
