"""Training windows that are mirrored."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from dynssm_ros.learning.augmentation import Augmentation
from dynssm_ros.learning.models.base import AugmentationConfig
from dynssm_ros.learning.models.dynssm.network import PhysicsLayer
from dynssm_ros.learning.models.physics import PhysicsConfig
from dynssm_ros.signals.recording import Recording
from dynssm_ros.vehicle import COEFFICIENTS, Vehicle


def batch(recording: Recording, H: int = 8) -> tuple[torch.Tensor, torch.Tensor]:
    rows = np.lib.stride_tricks.sliding_window_view(recording.matrix, H + 1, axis=0).transpose(0, 2, 1)
    rows = torch.tensor(rows[:200].copy(), dtype=torch.float32)
    return rows[:, :-1], rows[:, -1, :3] - rows[:, -2, :3]


def augmentation(**config: object) -> Augmentation:
    return Augmentation(AugmentationConfig.model_validate(config), torch.Generator().manual_seed(1))


def errors(vehicle: Vehicle, window: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """One-step errors of the nominal physics, the one to come included, ``(B, H, 3)``."""
    physics = PhysicsLayer(vehicle, PhysicsConfig())
    happened = torch.cat([window[:, 1:, :3] - window[:, :-1, :3], target[:, None]], dim=1)
    return happened - physics(window, torch.tensor(vehicle.nominal, dtype=torch.float32))


def test_nothing_switched_on_changes_nothing(drive: Callable[..., Recording], orca: Vehicle) -> None:
    given = batch(drive(orca, 300))
    unchanged = augmentation()(*given)
    assert all(torch.equal(a, b) for a, b in zip(unchanged, given, strict=True))


def test_a_mirrored_symmetric_car_drives_by_the_same_physics(drive: Callable[..., Recording], orca: Vehicle) -> None:
    shifts = [COEFFICIENTS.index(name) for name in ("S_hf", "S_vf", "S_hr", "S_vr")]
    theta = orca.nominal.copy()
    theta[shifts] = 0.0
    symmetric = orca.with_nominal(theta)
    given = batch(drive(symmetric, 300))
    window, target = augmentation(mirror=True)(*given)
    np.testing.assert_allclose(errors(symmetric, window, target), 0.0, atol=2e-5)
    turned = (window[:, -1, 2] * given[0][:, -1, 2] < 0).float().mean()
    assert 0.3 < turned < 0.7
    np.testing.assert_array_equal(window[..., 0], given[0][..., 0])
