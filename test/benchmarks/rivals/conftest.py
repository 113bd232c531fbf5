"""Small rivals, of a synthetic car whose truth is known."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import pytest
import torch

from dynssm_ros.learning.models.base import ModelConfig
from dynssm_ros.learning.models.registry import merge, parse_model_config
from dynssm_ros.signals.recording import Recording
from dynssm_ros.vehicle import Vehicle

MakeConfig = Callable[..., ModelConfig]

SMALL_DDM: dict[str, Any] = {
    "name": "small_ddm",
    "kind": "ddm",
    "history": 0.08,
    "gru": {"hidden": 3, "layers": 2},
    "dense": {"layers": 2, "width": 6},
    "physics": {"load_transfer": False},
    "loss": {"scale": "none", "parameters": 0.0},
    "training": {
        "epochs": 3, "batch_size": 64, "learning_rate": 0.005, "schedule": "constant", "gradient_clip": None,
        "patience": 10, "validation": "random", "validation_every": 5,
    },
}  # fmt: skip


def _changed(base: dict[str, Any], **changes: Any) -> ModelConfig:
    return parse_model_config(merge(base, changes), "test")


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Small tensors on one core, as they are deployed."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="session")
def make_fitted() -> MakeConfig:
    """A model that is fitted at once (``gp``, ``on_track``) with the given fields."""
    return partial(_changed, {"name": "small", "training": {"validation_block": 1.0}})


@pytest.fixture(scope="session")
def make_ddm() -> MakeConfig:
    """The small DDM with other blocks."""
    return partial(_changed, SMALL_DDM)


@pytest.fixture(scope="session")
def make_fthd() -> MakeConfig:
    """The small DDM fine-tuned for two epochs, with other fields of ``fine_tuning``; ``start`` changes the DDM's blocks."""

    def make(start: dict[str, Any] | None = None, **changes: Any) -> ModelConfig:
        ddm = _changed(SMALL_DDM, **start or {}).model_dump()
        settings = {"starts_from": ddm, "frozen": 0.7, "physics": 0.00004} | changes
        training = ddm["training"] | {"epochs": 2, "learning_rate": 0.002}
        content = ddm | {"name": "small_fthd", "kind": "fthd", "training": training, "fine_tuning": settings}
        return parse_model_config(content, "test")

    return make


@pytest.fixture(scope="session")
def laps(drive: Callable[..., Recording], orca: Vehicle) -> Recording:
    """30 s of the small car."""
    return drive(orca)
