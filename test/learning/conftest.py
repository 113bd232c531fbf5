"""A synthetic car whose truth is known, and small models of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch

from dynssm_ros.learning.models.base import ModelConfig
from dynssm_ros.learning.models.registry import parse_model_config
from dynssm_ros.signals.inputs import WINDOW_COLUMNS
from dynssm_ros.signals.recording import Recording, RecordingInfo
from dynssm_ros.simulation.plant import SCALAR
from dynssm_ros.vehicle import Applied, Coefficients, State, Vehicle, load_vehicle, step

Drive = Callable[..., Recording]
MakeConfig = Callable[..., ModelConfig]

SMALL: dict[str, Any] = {
    "name": "small",
    "history": 0.08,
    "ssm": {"channels": 4, "states": 2},
    "gru": {"hidden": 4},
    "fusion": {"hidden": 8, "latent": 6},
    "physics": {},
    "adaptation": {"hidden": 6, "alpha": 0.5},
    "residual": {"hidden": [8], "scale": 1.0},
    "loss": {"parameters": 0.001},
    "training": {
        "epochs": 3,
        "batch_size": 64,
        "learning_rate": 0.005,
        "patience": 10,
        "validation_block": 1.0,
    },
}

SMALL_DDM: dict[str, Any] = {
    "name": "small_ddm",
    "kind": "ddm",
    "history": 0.08,
    "gru": {"hidden": 3, "layers": 2},
    "dense": {"layers": 2, "width": 6},
    "physics": {"load_transfer": False},
    "loss": {"scale": "none", "parameters": 0.0},
    "training": {
        "epochs": 3,
        "batch_size": 64,
        "learning_rate": 0.005,
        "schedule": "constant",
        "gradient_clip": None,
        "patience": 10,
        "validation": "random",
        "validation_every": 5,
    },
}


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Small tensors on one core, as they are deployed."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="session")
def orca() -> Vehicle:
    return load_vehicle("orca")


@pytest.fixture(scope="session")
def make_config() -> MakeConfig:
    """The small model with other blocks; ``None`` leaves a block out, a mapping changes fields of it."""

    return partial(_changed, SMALL)


@pytest.fixture(scope="session")
def make_ddm() -> MakeConfig:
    """The small DDM with other blocks."""
    return partial(_changed, SMALL_DDM)


@pytest.fixture(scope="session")
def make_fthd() -> MakeConfig:
    """The small DDM fine-tuned for two epochs, with other fields of ``fine_tuning``; ``start`` changes the DDM's blocks."""

    def make(start: dict[str, Any] | None = None, **changes: Any) -> ModelConfig:
        ddm = _changed(SMALL_DDM, **start or {}).model_dump()
        settings = {"starts_from": ddm, "frozen": 2, "physics": 0.1} | changes
        training = ddm["training"] | {"epochs": 2, "learning_rate": 0.002}
        content = ddm | {"name": "small_fthd", "kind": "fthd", "training": training, "fine_tuning": settings}
        return parse_model_config(content, "test")

    return make


def _changed(base: dict[str, Any], **changes: Any) -> ModelConfig:
    content = dict(base)
    for key, value in changes.items():
        both = isinstance(value, dict) and isinstance(content.get(key), dict)
        content[key] = content[key] | value if both else value
    if content.get("kind") == "ridge":  # it has none of the blocks, and no epochs
        content = {name: content[name] for name in ("name", "kind", "history", "penalty") if name in content}
        content["training"] = {"validation_block": 1.0}
    return parse_model_config(content, "test")


def smooth(rng: np.random.Generator, N: int, mean: float, std: float, over: int) -> np.ndarray:
    """Coloured noise that changes over about ``over`` rows."""
    kernel = np.exp(-0.5 * (np.arange(-3 * over, 3 * over + 1) / over) ** 2)
    noise = np.convolve(rng.standard_normal(N + len(kernel) - 1), kernel / np.sqrt((kernel**2).sum()), "valid")
    return mean + std * noise


@pytest.fixture(scope="session")
def drive() -> Drive:
    """Drives the single-track car under smooth random inputs; the recording holds its states and commands.

    ``noise`` is the standard deviation of a random push per step (m/s, m/s, rad/s): errors of a one-step prediction
    with the true coefficients are exactly these.
    """

    def make(
        vehicle: Vehicle,
        N: int = 1500,
        seed: int = 0,
        throttle: tuple[float, float] = (0.32, 0.05),
        steering: float = 0.06,
        noise: tuple[float, float, float] = (0.0, 0.0, 0.0),
        segments: int = 1,
    ) -> Recording:
        rng = np.random.default_rng(seed)
        r, delta = smooth(rng, N + 1, *throttle, 40), smooth(rng, N + 1, 0.0, steering, 15)
        pushes = rng.standard_normal((N, 3)) * noise
        theta, effects = Coefficients(*vehicle.nominal.tolist()), vehicle.active_effects
        state, states = State(1.8, 0.0, 0.0), np.empty((N, 3))
        for k in range(N):
            states[k] = state
            applied = Applied(float(r[k + 1]), float(delta[k + 1]))
            following = step(SCALAR, state, applied, theta, vehicle.constants, vehicle.sampling_time, effects)
            state = State(*(value + push for value, push in zip(following, pushes[k].tolist(), strict=True)))
        matrix = np.column_stack([states, r[:-1], delta[:-1], np.diff(r), np.diff(delta)])
        info = RecordingInfo(sampling_time=vehicle.sampling_time, commands="topics", source=(f"drive {seed}",))
        time = 10**18 + np.round(np.arange(N) * vehicle.sampling_time * 1e9).astype(np.int64)
        segment = (np.arange(N) * segments // N).astype(np.int32)
        return Recording(info, time, segment, {name: matrix[:, k] for k, name in enumerate(WINDOW_COLUMNS)})

    return make


@pytest.fixture(scope="session")
def laps(drive: Drive, orca: Vehicle) -> Recording:
    """30 s of the small car."""
    return drive(orca)
