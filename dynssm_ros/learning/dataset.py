"""Windows of a recording as tensors, and their split into training and validation."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from dynssm_ros.arrays import Indices, Vector
from dynssm_ros.configuration import StrictModel
from dynssm_ros.errors import RecordingError
from dynssm_ros.runtime.artifact import Normalisation
from dynssm_ros.signals.inputs import WINDOW_COLUMNS
from dynssm_ros.signals.recording import Recording
from dynssm_ros.signals.signal_map import STATE_SIGNALS

_BLOCK_SHARE, _BLOCK_RANGE_S = 1 / 40, (1.0, 10.0)  # of the recording; length of validation blocks
_CONSTANT = 1e-9  # a column that varies less than this is not scaled


class SplitConfig(StrictModel):
    """How validation windows are taken out of the training data."""

    seed: int = 0
    validation: Literal["blocks", "random"] = Field(
        default="blocks",
        description="blocks in time that share no row with the training windows, or single windows drawn at random, as "
        "the literature does, whose neighbours are trained on",
    )
    validation_block: float | None = Field(
        default=None,
        gt=0,
        description="length of the validation blocks (s); null: a fortieth of the recording, 1 to 10 s",
    )
    validation_every: int = Field(default=6, ge=2, description="every n-th block (one window in n) is for validation")

    @property
    def effort(self) -> tuple[int, int]:
        """Epochs at most, and training windows that are needed: what is fitted in closed form has one round."""
        return 1, 1


@dataclass(frozen=True)
class TrainingWindows:
    """Windows that end at ``ends`` in the rows ``matrix`` ``(N, 7)``; formed batch by batch, never stored."""

    matrix: Tensor
    ends: Tensor
    H: int

    def __len__(self) -> int:
        return len(self.ends)

    @property
    def increments(self) -> Tensor:
        """Measured increments ``s_{t+1} - s_t`` of all windows, ``(N, 3)``."""
        return self.matrix[self.ends + 1, :3] - self.matrix[self.ends, :3]

    def batch(self, index: Tensor | slice) -> tuple[Tensor, Tensor]:
        """Windows ``(B, H, 7)`` and their measured increments ``s_{t+1} - s_t`` ``(B, 3)``."""
        ends = self.ends[index]
        rows = ends[:, None] + torch.arange(1 - self.H, 1, device=ends.device)
        return self.matrix[rows], self.matrix[ends + 1, :3] - self.matrix[ends, :3]

    def batches(self, size: int = 4096) -> Iterator[tuple[Tensor, Tensor]]:
        """All of them in order, as :meth:`batch` has them, so many at a time."""
        for begin in range(0, len(self), size):
            yield self.batch(slice(begin, begin + size))

    def epoch(self, draw: torch.Generator, size: int) -> Iterator[tuple[Tensor, Tensor]]:
        """All of them once in random order, so many at a time."""
        order = torch.randperm(len(self), generator=draw).to(self.ends.device)
        for index in torch.split(order, size) if len(order) else ():
            yield self.batch(index)

    def to(self, device: torch.device) -> TrainingWindows:
        """The same windows on ``device``."""
        return TrainingWindows(self.matrix.to(device), self.ends.to(device), self.H)


def split_windows(
    recording: Recording, H: int, config: SplitConfig, min_speed: float, least: int
) -> tuple[TrainingWindows, TrainingWindows]:
    """Training and validation windows: by alternating blocks in time, so that no row serves both, or at random.

    The random split is drawn for the last rows of the windows, so that it is the same one for windows of any length
    ``H``. Windows that are slower than ``min_speed`` (m/s) anywhere are left out; ``least`` training windows are needed.

    Raises:
        RecordingError: too little motion to train on.
    """
    training, held = split_ends(recording, H, config, min_speed, least)
    matrix = _matrix(recording)
    return TrainingWindows(matrix, torch.tensor(training), H), TrainingWindows(matrix, torch.tensor(held), H)


def split_ends(
    recording: Recording, H: int, config: SplitConfig, min_speed: float, least: int
) -> tuple[Indices, Indices]:
    """The last rows of the windows of :func:`split_windows`."""
    ends = recording.window_ends(H, min_speed=min_speed)
    if config.validation == "random":
        drawn = np.random.default_rng(config.seed).random(len(recording)) * config.validation_every < 1
        training, held = ends[~drawn[ends]], ends[drawn[ends]]
    else:
        seconds = config.validation_block
        if seconds is None:
            seconds = min(max(_BLOCK_SHARE * len(recording) * recording.T_s, _BLOCK_RANGE_S[0]), _BLOCK_RANGE_S[1])
        block = max(1, round(seconds / recording.T_s))
        blocks = np.arange(len(recording)) // block
        validation = (blocks % config.validation_every == config.validation_every - 1).astype(np.intp)
        cumulated = np.concatenate([[0], np.cumsum(validation)])
        inside = cumulated[ends + 2] - cumulated[ends - H + 1]
        training, held = ends[inside == 0], ends[inside == H + 1]
    if len(training) < least or len(held) == 0:
        raise RecordingError(
            f"recording {', '.join(recording.info.source)}: {len(training)} training and {len(held)} validation windows "
            f"of {H} rows at {min_speed:g} m/s or more; expected at least {least} and 1 - more driving is needed"
        )
    return training, held


def _matrix(recording: Recording) -> Tensor:
    """The model's input rows in single precision, ``(N, 7)``."""
    columns = [recording[name] for name in WINDOW_COLUMNS]
    return torch.from_numpy(np.stack(columns, axis=1, dtype=np.float32, casting="same_kind"))


def normalisation(recording: Recording, ends: Indices) -> Normalisation:
    """Scales from the training windows, which end at the rows ``ends``.

    Raises:
        RecordingError: a state never changes.
    """
    inputs = [_mean_and_std(recording[name][ends]) for name in WINDOW_COLUMNS]
    targets = [_mean_and_std(recording[name][ends + 1]) for name in STATE_SIGNALS]
    increments = [_mean_and_std(recording[name][ends + 1] - recording[name][ends]) for name in STATE_SIGNALS]
    for name, (_, spread) in zip(STATE_SIGNALS, increments, strict=True):
        if spread < _CONSTANT:
            raise RecordingError(
                f"recording {', '.join(recording.info.source)}: {name} never changes; expected a car that drives corners"
            )
    return Normalisation(
        input_mean=tuple(mean for mean, _ in inputs),
        input_std=tuple(1.0 if std < _CONSTANT else std for _, std in inputs),
        state_scale=tuple(std for _, std in targets),
        increment_scale=tuple(std for _, std in increments),
    )


def _mean_and_std(values: Vector) -> tuple[float, float]:
    return float(values.mean()), float(values.std())
