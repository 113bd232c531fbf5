"""One step ahead: predictions over a whole recording, their errors, their stated uncertainty, their cost."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from statistics import NormalDist
from time import perf_counter_ns
from typing import NamedTuple

import numpy as np

from dynssm_ros.arrays import Indices, Vector
from dynssm_ros.runtime.along import Along
from dynssm_ros.runtime.contract import WindowModel, WindowPrediction, seen_by
from dynssm_ros.runtime.online import Learned
from dynssm_ros.runtime.onnx_model import OnnxModel
from dynssm_ros.runtime.path_judge import PathJudge
from dynssm_ros.runtime.rollout import RolloutCorrection
from dynssm_ros.signals.recording import Recording
from dynssm_ros.signals.signal_map import STATE_SIGNALS

Tick = Callable[[int], None]
"""Told how many predictions were just made."""

_WARM_UP = 20  # unmeasured predictions before the measured ones
BATCH = 4096  # windows that exist at a time


def silent(predictions: int) -> None:
    """The :data:`Tick` that tells nobody."""


def batches(rows: Indices) -> Iterator[Indices]:
    """Rows in blocks of :data:`BATCH`."""
    return (rows[start : start + BATCH] for start in range(0, len(rows), BATCH))


def predict_rows(
    model: WindowModel,
    recording: Recording,
    rows: Indices,
    *,
    tick: Tick = silent,
    drive: DriveThrough | None = None,
) -> Iterator[WindowPrediction]:
    """The model's predictions of the rows that follow ``rows`` ``(M,)``, batch by batch.

    The model's online layer corrects them by what it knew along a ``drive``; without one it stays out.
    """
    for chunk in batches(rows):
        windows = recording.windows(chunk, model.H)
        predicted = model.predict(windows)
        if model.online is not None and drive is not None:
            predicted = RolloutCorrection(model.online, drive.at(chunk)).corrected(predicted, windows)
        yield predicted._replace(seen=None)
        tick(len(chunk))


class DriveThrough(NamedTuple):
    """What an online layer knew along rows of a recording that it was driven through in order."""

    ends: Indices
    """Rows at which it learned, ascending."""
    learned: Learned

    def at(self, rows: Indices) -> Learned:
        """What it knew at ``rows``; where it did not learn, what it knew before."""
        return self.learned.at(np.maximum(np.searchsorted(self.ends, rows, side="right") - 1, 0))


def drive_through(
    model: WindowModel, recording: Recording, asked: Sequence[Indices], *, paths: bool = True
) -> Iterator[tuple[DriveThrough | None, list[Indices]]]:
    """Lets the model's online layer learn wherever its window is whole and the car not slower than its minimum speed.

    It knows a kilobyte of numbers at each row, so it is asked batch by batch, and what it knew is given up after each.

    Args:
        model: whose layer learns.
        recording: that is driven through.
        asked: rows at which it will be asked, ascending.
        paths: whether it is judged by its paths, as rollouts need it and the next step does not; takes half of the time.

    Yields:
        What it knew, with those rows of each ``asked`` (ascending) that the block answers for. ``None``, once and with all
        of them, if nothing learns.
    """
    layer, H = model.online, model.H
    if layer is None or len(ends := recording.window_ends(H, 0, layer.minimum_speed, layer.least)) == 0:
        yield None, list(asked)
        return
    features = model.layer_features if isinstance(model, OnnxModel) else None
    along, judge = Along(layer), PathJudge(layer, partial(seen_by, model), features)
    blocks = [(np.searchsorted(ends, rows, side="right") - 1).clip(0) // BATCH for rows in asked]
    for k, chunk in enumerate(batches(ends)):
        windows = recording.windows(chunk, H)
        seen, rows = seen_by(model, windows), windows[:, -1]
        following = recording.states(np.minimum(chunk + 1, len(recording) - 1))
        learned = along.over(seen, rows, following - rows[:, :3], chunk)
        trusted = judge.along(windows, chunk, learned, seen) if paths else learned.trusted
        own = [rows[block == k] for rows, block in zip(asked, blocks, strict=True)]
        yield DriveThrough(chunk, learned._replace(trusted=trusted)), own


def rmse(errors: Vector) -> Vector:
    """Root mean square over the rows of ``errors`` ``(N, 3)``, one value per channel and in its unit."""
    return np.asarray(np.sqrt(np.mean(errors**2, axis=0)))


def explained(increments: Vector, predicted: Vector) -> Vector:
    """Share of the measured increments that is predicted, ``1 - sum(e^2) / sum(ds^2)``, shape ``(3,)``.

    1 is perfect, 0 is as good as persistence, below 0 is worse; NaN for a channel that never changes.
    """
    total = np.sum(increments**2, axis=0)
    left = np.sum((increments - predicted) ** 2, axis=0)
    return np.asarray(1.0 - np.divide(left, total, out=np.full(len(total), np.nan), where=total > 0))


def coverage(errors: Vector, variance: Vector) -> Vector:
    """Share of the errors ``(N, 3)`` inside the central 90 % interval, 0.9 for honest variances ``(N, 3)`` or ``(3,)``."""
    z = NormalDist().inv_cdf(0.95)
    return np.asarray(np.mean(np.abs(errors) <= z * np.sqrt(variance), axis=0))


def latency_us(model: WindowModel, windows: Vector, calls: int = 200) -> Vector:
    """Wall-clock time of single predictions (us), shape ``(calls,)``, cycling through real ``windows`` ``(M, H, 7)``."""
    single = [np.ascontiguousarray(window[None]) for window in windows]
    samples = np.empty(_WARM_UP + calls)
    for call in range(len(samples)):
        window = single[call % len(single)]
        begin = perf_counter_ns()
        model.predict(window)
        samples[call] = perf_counter_ns() - begin
    return samples[_WARM_UP:] / 1e3


def finite(value: float) -> float | None:
    """``value`` as JSON has it: ``None`` for NaN and infinity."""
    return float(value) if math.isfinite(value) else None


def by_channel(values: Vector) -> dict[str, float | None]:
    """Names the entries of a ``(3,)`` array."""
    return {name: finite(value) for name, value in zip(STATE_SIGNALS, values, strict=True)}
