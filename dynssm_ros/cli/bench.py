"""``dynssm bench``: latency and throughput of a model on this machine."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
import typer

from dynssm_ros.cli.console import JsonOption, console, progress_bar
from dynssm_ros.files import write_json
from dynssm_ros.runtime.artifact import Artifact, open_artifact
from dynssm_ros.runtime.models import OnnxModel
from dynssm_ros.runtime.predictor import Predictor
from dynssm_ros.signals.recording import Recording, RecordingInfo
from dynssm_ros.signals.signal_map import POSE_SIGNALS, STATE_SIGNALS, load_signal_map
from dynssm_ros.signals.standard import recording_to_bag

Vector = npt.NDArray[np.float64]
_WARM_UP, _BLOCK = 50, 200  # calls


def bench(
    model: Annotated[Path, typer.Option(help="Model folder.")],
    rate: Annotated[float, typer.Option(help="Odometry rate of the live part (Hz).", min=1.0, max=1000.0)] = 100.0,
    duration: Annotated[float, typer.Option(help="Length of the live part (s).", min=2.0)] = 15.0,
    calls: Annotated[int, typer.Option(help="Predictions that are timed.", min=100)] = 2000,
    json: JsonOption = None,
) -> None:
    """Measure the predictor on one core, against eager torch in the same run, and the live node through DDS."""
    artifact = open_artifact(model)
    drive = sample_drive(artifact, rate, duration + 2 * artifact.card.window * artifact.card.sampling_time)
    with one_core():
        predictor, torch_eager = time_predictions(artifact, drive, calls)
    with progress_bar("live") as progress:
        live = measure_node(artifact, drive, duration, progress)
    result = {
        "predictor_us": percentiles(predictor, 1e6),
        "torch_us": percentiles(torch_eager, 1e6),
        "torch_over_predictor": float(np.median(torch_eager) / np.median(predictor)),
        **live,
    }
    if json is not None:
        write_json(json, result)
    console.print(
        f"predictor, one core: p50 {result['predictor_us']['p50']:.1f} us, p99 {result['predictor_us']['p99']:.1f} us; "
        f"eager torch takes {result['torch_over_predictor']:.1f} times as long (p50 {result['torch_us']['p50']:.1f} us)\n"
        f"node, odometry published to prediction received at {result['rate_hz']:.1f} Hz: "
        f"p50 {result['node_latency_ms']['p50']:.2f} ms, p99 {result['node_latency_ms']['p99']:.2f} ms, "
        f"{result['dropped']} dropped",
        soft_wrap=True,
    )


def sample_drive(artifact: Artifact, rate: float, duration: float) -> Recording:
    """Smooth signals of the size that the model was trained on, as standard topics would carry them.

    Args:
        artifact: gives means and spreads of the signals.
        rate: of the samples (Hz).
        duration: of the drive (s).
    """
    card = artifact.card
    t = np.arange(round(duration * rate)) / rate
    mean, std = np.array(card.normalisation.input_mean), np.array(card.normalisation.input_std)
    waves = np.sin(2 * np.pi * (0.1 + 0.05 * np.arange(7))[:, None] * t)
    rows = mean[:, None] + 0.5 * std[:, None] * waves
    columns = dict(zip(card.columns, rows, strict=True)) | dict.fromkeys(POSE_SIGNALS, np.zeros(len(t)))
    info = RecordingInfo(sampling_time=1 / rate, commands="topics" if card.commands == "topics" else "none")
    time_ns = 1_000_000_000_000 + np.round(t * 1e9).astype(np.int64)
    return Recording(info, time_ns, np.zeros(len(t), dtype=np.int32), columns)


def time_predictions(artifact: Artifact, drive: Recording, calls: int) -> tuple[Vector, Vector]:
    """Times of single predictions (s): the whole predictor (sample in, window cut, model run), and eager torch alone.

    Both are timed in one run, block by block in turn, because machines are noisy; not call by call, because each would
    find its data driven out of the caches by the other.
    """
    from dynssm_ros.learning.export import eager_prediction

    run_eager = eager_prediction(artifact)
    predictor = Predictor(OnnxModel(artifact), load_signal_map("default"))
    samples = _samples(drive)

    def predict() -> float:
        stamp, actuators, odometry = next(samples)
        predictor.observe(stamp, actuators)
        begin = time.perf_counter()
        predictor.predict(stamp, odometry)
        return time.perf_counter() - begin

    def predict_eagerly() -> float:
        begin = time.perf_counter()
        run_eager()
        return time.perf_counter() - begin

    times: tuple[list[float], list[float]] = ([], [])
    for _ in range(-(-calls // _BLOCK)):
        for call, kept in zip((predict, predict_eagerly), times, strict=True):
            block = [call() for _ in range(_WARM_UP + _BLOCK)]
            kept.extend(block[_WARM_UP:])
    return np.array(times[0]), np.array(times[1])


def measure_node(
    artifact: Artifact, drive: Recording, duration: float, progress: Callable[[int, int], None]
) -> dict[str, Any]:
    """Plays the drive to a predictor process; latency from odometry published to prediction received, rate, losses."""
    from dynssm_ros.nodes.live import run_live

    with tempfile.TemporaryDirectory(prefix="dynssm-") as folder:
        bag = Path(folder) / "drive"
        recording_to_bag(drive, bag)
        run = run_live(artifact.path, bag, artifact.card.sampling_time, duration=duration, progress=progress)
    sent = np.array(sorted(run.sent.values()))
    return {
        "node_latency_ms": percentiles(run.latencies, 1e3),
        "rate_hz": float((len(sent) - 1) / (sent[-1] - sent[0])),
        "dropped": len(run.missing()),
    }


def percentiles(times: Vector, factor: float) -> dict[str, float]:
    """Median and 99th percentile, times ``factor``."""
    return {"p50": float(np.percentile(times, 50) * factor), "p99": float(np.percentile(times, 99) * factor)}


@contextmanager
def one_core() -> Iterator[None]:
    """Keeps this process on a single core for a while."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(before)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def _samples(drive: Recording) -> Iterator[tuple[int, dict[str, float], dict[str, float]]]:
    """The drive over and over as ``(stamp, actuator values, odometry values)`` with ever increasing stamps."""
    applied = {name: drive[f"{name}_fb"] + drive[f"{name}_cmd"] for name in ("r", "delta")}
    lap = 0
    while True:
        for k, stamp in enumerate(drive.time.tolist()):
            actuators = {
                "throttle_feedback": float(drive["r_fb"][k]),
                "steering_feedback": float(drive["delta_fb"][k]),
                "throttle_command": float(applied["r"][k]),
                "steering_command": float(applied["delta"][k]),
            }
            odometry = {name: float(drive[name][k]) for name in (*STATE_SIGNALS, *POSE_SIGNALS)}
            yield stamp + lap, actuators, odometry
        lap += round(len(drive) * drive.T_s * 1e9)
