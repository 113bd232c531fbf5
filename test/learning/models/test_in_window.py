"""Coefficients that the window tells: planted changes are recovered, no change is invented, and no evidence moves nothing."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from dynssm_ros.errors import ConfigurationError
from dynssm_ros.learning.export import save_artifact
from dynssm_ros.learning.models.dynssm.in_window import InWindowEstimation, solved
from dynssm_ros.learning.models.dynssm.network import DynSSM
from dynssm_ros.learning.models.registry import load_model_config
from dynssm_ros.learning.stages import train
from dynssm_ros.runtime.artifact import Normalisation
from dynssm_ros.runtime.models import OnnxModel
from dynssm_ros.signals.recording import Recording
from dynssm_ros.vehicle import COEFFICIENTS, Vehicle, load_vehicle

SCALES = Normalisation(
    input_mean=(0.0,) * 7, input_std=(1.0,) * 7, state_scale=(1.0,) * 3, increment_scale=(0.02, 0.02, 0.5)
)
IDENTIFIED: dict[str, Any] = {
    "history": 0.24,
    "physics": {"nominal": "vehicle"},
    "in_window_estimation": {"spread": {"D_f": 0.0625, "D_r": 0.0625, "S_hf": 0.125}, "noise": 0.03, "history": 0.2},
}
NAMES = tuple(IDENTIFIED["in_window_estimation"]["spread"])
CHOSEN = [COEFFICIENTS.index(name) for name in NAMES]
SPREAD = np.array([0.05, 0.05, 0.02])  # the same in N, N, rad

Drive = Callable[..., Recording]
MakeConfig = Callable[..., Any]


@pytest.fixture(scope="module")
def wide() -> Vehicle:
    return load_vehicle("orca_wide")


@pytest.fixture
def model(make_config: MakeConfig, wide: Vehicle) -> DynSSM:
    return DynSSM(make_config(**IDENTIFIED), wide, SCALES).eval()


def windows(recording: Recording, H: int = 12) -> torch.Tensor:
    rows = np.lib.stride_tricks.sliding_window_view(recording.matrix, H, axis=0).transpose(0, 2, 1)
    return torch.tensor(rows.copy(), dtype=torch.float32)


def identified(model: DynSSM, given: torch.Tensor) -> np.ndarray:
    """``D_f, D_r, S_hf`` that adaptation starts from."""
    with torch.no_grad():
        theta = model(given).theta
    assert theta is not None
    return theta.numpy()[:, CHOSEN]


def test_small_systems_are_solved() -> None:
    generator = torch.Generator().manual_seed(0)
    root = torch.randn(50, 4, 9, generator=generator, dtype=torch.float64)
    A, b = root @ root.transpose(1, 2) + torch.eye(4), torch.randn(50, 4, 2, generator=generator, dtype=torch.float64)
    np.testing.assert_allclose(solved(A, b), torch.linalg.solve(A, b), atol=1e-10)


def test_the_estimate_is_the_regularised_least_squares_solution(model: DynSSM) -> None:
    """Of a physics that is linear in the coefficients, whatever the rounds."""
    assert isinstance(model.estimation, InWindowEstimation)
    generator = torch.Generator().manual_seed(1)
    errors, slopes = torch.randn(8, 10, 3, generator=generator), torch.randn(8, 10, 3, 3, generator=generator)
    spread = torch.tensor(SPREAD, dtype=torch.float32)

    def physics(cars: torch.Tensor) -> torch.Tensor:
        changes = (cars - model.nominal)[..., CHOSEN] / spread
        return torch.einsum("bsck,bnk->bsnc", slopes, changes.expand(8, -1, -1))

    found = (model.estimation(0.01 * errors, physics, model.nominal) - model.nominal).numpy()
    for k in range(8):
        J = slopes[k].reshape(30, 3).numpy() / 0.03
        expected, *_ = np.linalg.lstsq(
            np.vstack([J, np.eye(3)]), np.append(errors[k].reshape(30).numpy() / 3, np.zeros(3)), rcond=None
        )
        np.testing.assert_allclose(found[k, CHOSEN], expected * spread.numpy(), rtol=2e-3, atol=1e-6)
    assert not found[:, [k for k in range(len(COEFFICIENTS)) if k not in CHOSEN]].any()


def test_planted_changes_are_recovered(model: DynSSM, drive: Drive, wide: Vehicle) -> None:
    """Grip and steering of another car than the nominal one, without that a network was trained on it."""
    truth = wide.nominal.copy()
    truth[CHOSEN] = 0.8 * truth[CHOSEN[0]], 0.85 * truth[CHOSEN[1]], 0.025
    found = identified(model, windows(drive(wide.with_nominal(truth), 600, steering=0.12)))
    np.testing.assert_allclose(np.median(found, axis=0), truth[CHOSEN], rtol=0.02)
    # where a window hardly turns, the prior draws towards the nominal car
    change = np.abs(truth - wide.nominal)[CHOSEN]
    assert np.all(np.sqrt(np.mean((found - truth[CHOSEN]) ** 2, axis=0)) < 0.25 * change)


def test_further_rounds_tell_large_changes_that_come_together(
    make_config: MakeConfig, drive: Drive, wide: Vehicle
) -> None:
    truth = wide.nominal.copy()
    truth[CHOSEN] = 0.7 * truth[CHOSEN[0]], truth[CHOSEN[1]], 0.03
    given = windows(drive(wide.with_nominal(truth), 300, steering=0.12))
    errors = []
    for rounds in (1, 2, 3):
        config = make_config(
            **(IDENTIFIED | {"in_window_estimation": IDENTIFIED["in_window_estimation"] | {"rounds": rounds}})
        )
        found = identified(DynSSM(config, wide, SCALES).eval(), given)
        errors.append(np.median(np.abs(found - truth[CHOSEN]), axis=0) / truth[CHOSEN])
    assert errors[0][2] > 0.1
    assert np.all(errors[1] < 0.02)
    assert np.all(errors[2] < 0.02)


def test_a_car_that_did_not_change_stays_as_it_is(model: DynSSM, drive: Drive, wide: Vehicle) -> None:
    found = identified(model, windows(drive(wide, 300)))
    np.testing.assert_allclose(found, np.broadcast_to(wide.nominal[CHOSEN], found.shape), atol=2e-4)


def test_errors_that_mean_nothing_move_little(model: DynSSM, drive: Drive, wide: Vehicle) -> None:
    """Random pushes of the stated size leave the estimate within the spread, where the window is excited well within."""
    noise = tuple(0.03 * scale for scale in SCALES.increment_scale)
    found = identified(model, windows(drive(wide, 600, steering=0.12, noise=noise))) - wide.nominal[CHOSEN]
    assert np.all(np.std(found, axis=0) < 0.3 * SPREAD)


def test_straight_ahead_nothing_is_told_of_the_grip(make_config: MakeConfig, orca: Vehicle) -> None:
    """On a car without shifts, whose tyres do nothing on a straight."""
    theta = orca.nominal.copy()
    theta[[COEFFICIENTS.index(name) for name in ("S_hf", "S_hr", "S_vf", "S_vr")]] = 0.0
    straight = orca.with_nominal(theta)
    config = make_config(
        **(IDENTIFIED | {"in_window_estimation": {"spread": {"D_f": 0.0625, "D_r": 0.0625}, "history": 0.2}})
    )
    given = torch.zeros(1, 12, 7)
    given[..., 0] = torch.linspace(1.5, 2.5, 12)  # faster than the throttle of zero explains
    found = identified(DynSSM(config, straight, SCALES).eval(), given)
    np.testing.assert_allclose(found, theta[CHOSEN][None], atol=1e-6)


def test_the_estimate_stays_within_the_bounds(model: DynSSM, drive: Drive, wide: Vehicle) -> None:
    given = windows(drive(wide, 100))
    given[:, :, 2] += torch.linspace(0.0, 500.0, 12)
    found = identified(model, given)
    assert np.all(found >= wide.lower[CHOSEN] - 1e-6)
    assert np.all(found <= wide.upper[CHOSEN] + 1e-6)


def test_the_deployed_graph_identifies_too(
    make_config: MakeConfig, drive: Drive, wide: Vehicle, tmp_path: Path
) -> None:
    trained = train(drive(wide), make_config(**IDENTIFIED), wide, tmp_path / "checkpoint.pt")
    model = OnnxModel(save_artifact(trained, tmp_path / "model"))
    truth = wide.nominal.copy()
    truth[CHOSEN[0]] *= 0.8
    given = windows(drive(wide.with_nominal(truth), 300, steering=0.12))
    said = model.predict(given.double().numpy())
    with torch.no_grad():
        expected = trained.model(given)
    assert said.theta is not None
    # rounding matters where a window tells little
    spread = SPREAD
    assert np.max(np.abs(said.theta - expected.theta.numpy())[:, CHOSEN] / spread) < 0.01
    np.testing.assert_allclose(np.median(said.theta[:, CHOSEN[0]]), truth[CHOSEN[0]], rtol=0.03)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"in_window_estimation": {"spread": {"D_x": 0.1}, "history": 0.06}}, "unknown D_x; expected some of B_f"),
        ({"in_window_estimation": {"spread": {}, "history": 0.06}}, "at least 1 item"),
        ({"in_window_estimation": {"spread": {"D_f": -0.1}, "history": 0.06}}, "greater than 0"),
        (
            {"in_window_estimation": {"spread": {"D_f": 0.1}, "history": 0.06}, "adaptation": None},
            "in_window_estimation needs adaptation",
        ),
    ],
)
def test_what_cannot_be_identified_is_refused(make_config: MakeConfig, changes: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigurationError, match=words):
        make_config(**(IDENTIFIED | changes))


def test_the_shipped_model_file(tmp_path: Path, wide: Vehicle) -> None:
    config = load_model_config("dynssm_adaptive")
    assert set(config.in_window_estimation.spread) == {"D_f", "D_r", "S_hf"}
    file = tmp_path / "long.yaml"
    file.write_text("base: dynssm_adaptive\nin_window_estimation: {history: 2.0}\n")
    with pytest.raises(ConfigurationError, match=r"in_window_estimation\.history: 100 steps; a window of 1\.2 s"):
        DynSSM(load_model_config(file), wide, SCALES)
