"""EKF-FTHD: its filter against closed forms, and a training on noisy laps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from benchmarks.rivals.ekf_fthd import EkfFTHD, kalman_filtered
from dynssm_ros.learning.dataset import normalisation, split_windows
from dynssm_ros.learning.export import load_torch, save_artifact
from dynssm_ros.learning.models.base import ModelConfig
from dynssm_ros.learning.models.registry import parse_model_config
from dynssm_ros.learning.stages import train
from dynssm_ros.signals.recording import Recording
from dynssm_ros.vehicle import Vehicle


def drawn(rows: int, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """Measured states, increments and derivatives of a made-up motion, in double precision."""
    draw = torch.Generator().manual_seed(seed)
    measured, moved = (torch.randn(4, rows, 3, generator=draw).double() for _ in range(2))
    return measured, moved, torch.eye(3).double() + 0.3 * torch.randn(4, rows, 3, 3, generator=draw).double()


def test_the_filter_is_the_textbook_s() -> None:
    measured, moved, F = drawn(5)
    q, r = torch.tensor([0.1, 0.2, 0.3]).double(), torch.tensor([0.5, 0.4, 0.2]).double()
    found = kalman_filtered(measured, moved, F, torch.diag(q).expand(4, 3, 3), r.expand(4, 3))
    for n in range(4):
        x, P, R = measured[n, 0].numpy(), np.diag(r), np.diag(r)
        for k in range(4):
            z, A = measured[n, k].numpy(), F[n, k].numpy()
            x, P = z + moved[n, k].numpy() + A @ (x - z), A @ P @ A.T + np.diag(q)
            K = P @ np.linalg.inv(P + R)
            x, P = x + K @ (measured[n, k + 1].numpy() - x), (np.eye(3) - K) @ P
        np.testing.assert_allclose(found[n].numpy(), x, rtol=1e-9)


def test_without_noise_of_the_measurement_the_state_is_the_measured_one() -> None:
    measured, moved, F = drawn(4)
    found = kalman_filtered(
        measured, moved, F, torch.eye(3).double().expand(4, 3, 3), torch.full((4, 3), 1e-12).double()
    )
    np.testing.assert_allclose(found, measured[:, -1], atol=1e-9)


NOISE = {"v_x": 0.05, "v_y": 0.05, "omega": 0.3}


@pytest.fixture(scope="module")
def clean(drive: Callable[..., Recording], orca: Vehicle) -> Recording:
    """12 s of the small car as it was."""
    return drive(orca, 600)


@pytest.fixture(scope="module")
def noisy(clean: Recording) -> Recording:
    """The same with noise of the sensors."""
    draw = np.random.default_rng(0)
    columns = {n: v + NOISE.get(n, 0.0) * draw.standard_normal(len(v)) for n, v in clean.columns.items()}
    return replace(clean, columns=columns)


@pytest.fixture
def config(make_ddm: Callable[..., ModelConfig]) -> ModelConfig:
    """An EKF-FTHD on the small DDM of these tests, that sees eight rows."""
    ddm = make_ddm(history=0.16, physics={"integrator": "euler"}).model_dump(mode="json")
    fine_tuning = {"starts_from": ddm, "frozen": 0.5, "physics": 0.000025}
    changes = {"name": "e", "kind": "ekf_fthd", "filter": {"rows": 8}, "fine_tuning": fine_tuning}
    return parse_model_config(ddm | changes, "test")


@pytest.mark.slow
def test_variances_that_are_learned_from_the_next_measurement_filter_the_noise_away(
    clean: Recording, noisy: Recording, config: ModelConfig, orca: Vehicle
) -> None:
    """The car's coefficients are given; only the noises are learned, and nobody tells them the true states."""
    windows, _ = split_windows(noisy, config.rows(0.02), config.training, 0.0, 64)
    model = EkfFTHD(config, orca, normalisation(noisy, windows.ends.numpy()))  # type: ignore[arg-type]
    share = (orca.nominal - orca.lower) / (orca.upper - orca.lower)
    with torch.no_grad():
        model.dense[-1].weight.zero_()  # type: ignore[operator]
        model.dense[-1].bias.copy_(torch.logit(torch.tensor(share)))  # type: ignore[operator]
    window, increment = windows.batch(slice(None))
    optimiser = torch.optim.Adam(model.noises.parameters(), lr=0.05)
    unit = model.increment_scale
    for _ in range(80):
        optimiser.zero_grad()
        ((model(window).increment - increment) / unit).square().mean().backward()
        optimiser.step()
    true, _ = replace(windows, matrix=torch.tensor(clean.matrix, dtype=torch.float32)).batch(slice(None))
    with torch.no_grad():
        hidden = model.hidden(window)
        found = model.filtered(window, model.coefficients(hidden), *model.variances(hidden))
    left, before = ((state - true[:, -1, :3]).square().mean(0).sqrt() for state in (found, window[:, -1, :3]))
    assert bool((left < 0.7 * before).all()), (left, before)


def test_it_is_trained_in_two_stages_and_deployed(
    noisy: Recording, config: ModelConfig, orca: Vehicle, tmp_path: Path
) -> None:
    trained = train(noisy, config, orca, tmp_path / "c.pt")
    assert trained.start is not None
    first, second = trained.start.model.state_dict(), trained.model.state_dict()
    assert torch.equal(first["gru.weight_ih_l0"], second["gru.weight_ih_l0"])
    assert not torch.equal(first["dense.2.weight"], second["dense.2.weight"])
    artifact = save_artifact(trained, tmp_path / "model")  # compares the exported graph with torch
    window = torch.tensor(noisy.matrix[None, :8], dtype=torch.float32)
    torch.testing.assert_close(load_torch(artifact)(window).increment, trained.model(window).increment)
