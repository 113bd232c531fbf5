"""A synthetic car whose truth is known, and small models of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import pytest
import torch

from dynssm_ros.learning.models.base import ModelConfig
from dynssm_ros.learning.models.registry import parse_model_config
from dynssm_ros.signals.recording import Recording
from dynssm_ros.vehicle import Vehicle

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


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Small tensors on one core, as they are deployed."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="session")
def make_config() -> MakeConfig:
    """The small model with other blocks; ``None`` leaves a block out, a mapping changes fields of it."""

    return partial(_changed, SMALL)


def _changed(base: dict[str, Any], **changes: Any) -> ModelConfig:
    content = dict(base)
    for key, value in changes.items():
        both = isinstance(value, dict) and isinstance(content.get(key), dict)
        content[key] = content[key] | value if both else value
    if content.get("kind") in ("ridge", "rls"):  # they have no layers, and no epochs
        content = {name: content[name] for name in ("name", "kind", "history", "penalty") if name in content}
        content["training"] = {"validation_block": 1.0}
    return parse_model_config(content, "test")


@pytest.fixture(scope="session")
def laps(drive: Drive, orca: Vehicle) -> Recording:
    """30 s of the small car."""
    return drive(orca)
