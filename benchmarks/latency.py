"""Latency and throughput of models on this machine, side by side: ``python -m benchmarks.latency --model DIR``."""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.cli.console import console, progress_bar
from dynssm_ros.errors import UserError
from dynssm_ros.files import write_json
from dynssm_ros.reporting.tables import Column, Table
from dynssm_ros.runtime.artifact import Artifact, open_artifact
from dynssm_ros.runtime.onnx_model import OnnxModel
from dynssm_ros.runtime.predictor import Predictor
from dynssm_ros.runtime.registry import disambiguated
from dynssm_ros.signals.recording import Recording, RecordingInfo
from dynssm_ros.signals.signal_map import POSE_SIGNALS, STATE_SIGNALS, load_signal_map
from dynssm_ros.signals.standard import recording_to_bag

_WARM_UP, _BLOCK = 50, 200  # calls


def latency(model: Sequence[Path], rate: float, duration: float, calls: int, json: Path | None) -> None:
    """Measure predictors on one core, against eager torch in the same run, and the live node through DDS."""
    artifacts = open_artifacts(list(model))
    drives = {
        name: sample_drive(artifact, rate, duration + 2 * artifact.card.window * artifact.card.sampling_time)
        for name, artifact in artifacts.items()
    }
    with one_core():
        times = time_predictions([(artifact, drives[name]) for name, artifact in artifacts.items()], calls)
    results: dict[str, dict[str, Any]] = {}
    for (name, artifact), (predictor, torch_eager) in zip(artifacts.items(), times, strict=True):
        with progress_bar(f"live {name}") as progress:
            live = measure_node(artifact, drives[name], duration, progress)
        results[name] = {
            "predictor_us": percentiles(predictor, 1e6),
            "torch_us": percentiles(torch_eager, 1e6),
            "torch_over_predictor": float(np.median(torch_eager) / np.median(predictor)),
            **live,
        }
    first = next(iter(results))
    if json is not None:
        write_json(json, results[first] | {"models": results})
    console.print(comparison(results).rich())
    console.print(
        f"predictor: one sample in, window cut and model run, on one core; torch: the model alone, eagerly; node: odometry "
        f"published at {rate:g} Hz to prediction received; to first: predictor p50 over that of {first}",
        markup=False,
        soft_wrap=True,
    )


def open_artifacts(folders: list[Path]) -> dict[str, Artifact]:
    """The models by name; where two folders hold models of the same name, the folders tell them apart."""
    opened: dict[str, Artifact] = disambiguated(
        {str(folder): open_artifact(folder) for folder in folders}, attrgetter("card.name")
    )
    return opened


def comparison(results: dict[str, dict[str, Any]]) -> Table:
    """What was measured as a table, a row for each model."""
    columns = (
        Column("model"),
        *(Column(title, "us", group="predictor", best="min") for title in ("p50", "p99")),
        Column("to first", group="predictor"),
        Column("p50", "us", group="torch", best="min"),
        *(Column(title, "ms", group="node", best="min") for title in ("p50", "p99")),
        Column("lost", group="node"),
    )
    first = next(iter(results.values()))["predictor_us"]["p50"]
    rows = [
        [
            name,
            *each["predictor_us"].values(),
            each["predictor_us"]["p50"] / first,
            each["torch_us"]["p50"],
            *each["node_latency_ms"].values(),
            each["dropped"],
        ]
        for name, each in results.items()
    ]
    return Table(columns, rows)


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


def time_predictions(models: Sequence[tuple[Artifact, Recording]], calls: int) -> list[tuple[Vector, Vector]]:
    """Times of single predictions (s) of each model on its drive.

    For each model there are two: the whole predictor (sample in, window cut, model run), and eager torch alone. All are
    timed in one run, block by block in turn, because machines are noisy; not call by call, because each would find its
    data driven out of the caches by the others.
    """
    timed = [call for artifact, drive in models for call in (_predictor_call(artifact, drive), _eager_call(artifact))]
    times: list[list[float]] = [[] for _ in timed]
    for _ in range(-(-calls // _BLOCK)):
        for call, kept in zip(timed, times, strict=True):
            block = [call() for _ in range(_WARM_UP + _BLOCK)]
            kept.extend(block[_WARM_UP:])
    arrays = [np.array(each) for each in times]
    return list(zip(arrays[::2], arrays[1::2], strict=True))


def _predictor_call(artifact: Artifact, drive: Recording) -> Callable[[], float]:
    predictor = Predictor(OnnxModel(artifact), load_signal_map("default"))
    samples = _samples(drive)

    def predict() -> float:
        stamp, actuators, odometry = next(samples)
        predictor.observe(stamp, actuators)
        begin = time.perf_counter()
        predictor.predict(stamp, odometry)
        taken = time.perf_counter() - begin
        predictor.finish()  # the node has published by then
        return taken

    return predict


def _eager_call(artifact: Artifact) -> Callable[[], float]:
    """One prediction by the model as trained, in eager torch on one core: what ONNX Runtime is compared with."""
    import torch

    from dynssm_ros.learning.export import load_torch

    torch.set_num_threads(1)
    model = load_torch(artifact)
    window = torch.tensor(artifact.card.normalisation.input_mean).expand(1, artifact.card.window, -1).contiguous()

    def predict() -> float:
        begin = time.perf_counter()
        with torch.inference_mode():
            model(window)
        return time.perf_counter() - begin

    return predict


def measure_node(
    artifact: Artifact, drive: Recording, duration: float, progress: Callable[[int, int], None]
) -> dict[str, Any]:
    """Plays the drive to a predictor process; latency from odometry published to prediction received, rate, losses."""
    from benchmarks.endurance.live_run import run_live

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


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--model", type=Path, action="append", required=True, help="model folder; repeat to compare with the first"
    )
    parser.add_argument("--rate", type=float, default=100.0, help="odometry rate of the live part (Hz)")
    parser.add_argument("--duration", type=float, default=15.0, help="length of the live part of each model (s)")
    parser.add_argument("--calls", type=int, default=2000, help="predictions that are timed")
    parser.add_argument("--json", type=Path, help="also write the result as JSON")
    given = parser.parse_args()
    try:
        latency(given.model, given.rate, given.duration, given.calls, given.json)
    except UserError as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
