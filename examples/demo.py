"""``make demo``: the whole way on the embedded simulator and a real DDS bus, ending with an HTML report.

A car drives laps on one track; its bag becomes a recording, a calibrated vehicle and a trained DynSSM; that is scored
on another track, and then runs as a node in its own process while the other track's bag is played to it in real time.
The simulated car is not the model's: it integrates finely, its sensors are noisy, and its steering sensor is off.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dynssm_ros import api
from dynssm_ros.cli.console import console, progress_bar
from dynssm_ros.errors import UserError
from dynssm_ros.evaluation.open_loop import Evaluation
from dynssm_ros.reporting import evaluation_figures as figures
from dynssm_ros.reporting.evaluation_report import open_loop_report, summary_table, verdict
from dynssm_ros.reporting.page import Report, Section
from dynssm_ros.signals.recording import Recording
from dynssm_ros.signals.signal_map import STATE_SIGNALS
from dynssm_ros.vehicle import Vehicle, load_vehicle, save_vehicle

VEHICLE, MODEL, SIGNALS = "av21", "dynssm", "default"
TRAINING_TRACK, TEST_TRACK = "road_course", "oval"
TRAINING_TIME, TEST_TIME, LIVE_TIME = 600.0, 120.0, 15.0  # s
NOISE = (0.02, 0.01, 0.002)  # m/s, m/s, rad/s
HIDDEN = {"steering_offset": {"offset": 0.004}}
EPOCHS = 40
SEED = 0


@dataclass(frozen=True)
class _Live:
    """What the node said while the bag was played to it."""

    sent: int
    missing: int
    latencies: np.ndarray
    time: np.ndarray
    predicted: np.ndarray
    measured: np.ndarray
    theta: np.ndarray
    verdicts: list[str]


def demo(out: Path = Path("out/demo")) -> None:
    """Show the whole way: simulate, extract, calibrate, train, evaluate, predict live on DDS, report."""
    begin = time.monotonic()
    out.mkdir(parents=True, exist_ok=True)
    car = load_vehicle(VEHICLE)
    laps, test = (_drive(car, *arguments, out) for arguments in (
        (TRAINING_TRACK, TRAINING_TIME, SEED), (TEST_TRACK, TEST_TIME, SEED + 1)
    ))  # fmt: skip
    calibrated = _calibrate(laps, car, out)
    model = _train(laps, calibrated, out)
    evaluation = _evaluate(test, calibrated, model)
    live = _run_live(model, out / f"{TEST_TRACK}_bag", test)
    report = _report(evaluation, live)
    report.save(out / "report.html")
    console.print(summary_table(evaluation).brief.rich())
    console.print(verdict(evaluation), soft_wrap=True)
    console.print(_live_words(live), soft_wrap=True)
    console.print(
        f"{out / 'report.html'}: figures; the whole way took {time.monotonic() - begin:.0f} s", soft_wrap=True
    )
    if live.missing:
        raise UserError(f"the node left {live.missing} of {live.sent} odometry messages unanswered; see the report")


def _drive(car: Vehicle, track: str, duration: float, seed: int, out: Path) -> Recording:
    """Simulates laps into a bag and extracts that."""
    bag = out / f"{track}_bag"
    from dynssm_ros.simulation.laps import write_run

    with progress_bar(f"1 simulate {track}") as progress:
        run = api.simulate(
            car, track, duration=duration, plant="rk4", seed=seed, aggressiveness=0.85, variation=0.6, noise=NOISE,
            effects=HIDDEN, on_progress=progress,
        )  # fmt: skip
        write_run(run, bag)
    with progress_bar(f"2 extract {track}") as progress:
        recording = api.extract(bag, SIGNALS, rate=1 / car.sampling_time, on_progress=progress)
    recording.save(out / f"{track}.parquet")
    console.print(
        f"{track}: {run.laps:.1f} laps, {len(recording)} rows, top speed {run.state[:, 0].max():.2f} m/s, seed {seed}"
    )
    return recording


def _calibrate(recording: Recording, car: Vehicle, out: Path) -> Vehicle:
    guess = car.unmeasured()  # the demo does not start from the simulator's own values
    with progress_bar("3 calibrate") as progress:
        result = api.calibrate(recording, guess, seed=SEED, on_progress=progress)
    save_vehicle(result.vehicle, out / "vehicle.yaml", f"Calibrated by the demo on {TRAINING_TRACK}.")
    before, after = (", ".join(f"{v:.3g}" for v in rmse) for rmse in (result.rmse_before, result.rmse_after))
    console.print(f"calibrated single-track: one-step RMSE (v_x, v_y, omega) {before} -> {after}", soft_wrap=True)
    return result.vehicle


def _train(recording: Recording, car: Vehicle, out: Path) -> Path:
    with progress_bar("4 train") as progress:
        trained, artifact = api.train(
            recording, MODEL, car, out / "model", seed=SEED, epochs=EPOCHS, on_progress=progress
        )
    figures.loss_components(trained.history, trained.best_epoch).savefig(out / "losses.png", dpi=150)
    console.print(
        f"DynSSM: {artifact.card.parameters} parameters, best epoch {trained.best_epoch} of {EPOCHS}, seed {SEED}"
    )
    return artifact.path


def _evaluate(recording: Recording, car: Vehicle, model: Path) -> Evaluation:
    with progress_bar(f"5 evaluate on {TEST_TRACK}") as progress:
        evaluation = api.evaluate(recording, [model, "single_track", "persistence"], car, on_progress=progress)
    return replace(evaluation, name=f"{TEST_TRACK} (trained on {TRAINING_TRACK})")


def _run_live(model: Path, bag: Path, recording: Recording) -> _Live:
    """Plays the bag to the node and sets its predictions beside what was measured a moment later."""
    from benchmarks.endurance.live_run import run_live

    with progress_bar("6 predict live on DDS") as progress:
        run = run_live(model, bag, recording.T_s, duration=LIVE_TIME, progress=progress)
    rows = {int(stamp): k for k, stamp in enumerate(recording.time)}
    stamps = [stamp for stamp in sorted(run.predicted) if stamp in rows]
    index = [rows[stamp] for stamp in stamps]
    return _Live(
        sent=len(run.sent),
        missing=len(run.missing()),
        latencies=run.latencies,
        time=(recording.time[index] - recording.time[0]) / 1e9,
        predicted=np.array([run.predicted[stamp] for stamp in stamps]),
        measured=np.stack([recording[name][index] for name in STATE_SIGNALS], axis=1),
        theta=np.array([run.parameters[stamp] for stamp in stamps if stamp in run.parameters]),
        verdicts=[words for _, words, _ in run.diagnostics],
    )


def _live_words(live: _Live) -> str:
    p50, p99 = np.percentile(live.latencies, [50, 99]) * 1e3
    return (
        f"Live through DDS: {live.sent} odometry messages, {len(live.predicted)} predictions, {live.missing} missing after "
        f"the first window; odometry published to prediction received p50 {p50:.2f} ms, p99 {p99:.2f} ms"
    )


def _report(evaluation: Evaluation, live: _Live) -> Report:
    """The evaluation's report with what happened live in front."""
    base = open_loop_report(evaluation)
    name = next(iter(evaluation.scores))
    sections = [
        Section(
            "Live: predicted against measured",
            "The node ran in its own process; odometry, feedback and commands reached it through DDS in real time. Each "
            "prediction is drawn at the instant it is for, over what the car then measured.",
            figures.predicted_and_measured(live.time, live.measured, {f"{name}, live": live.predicted}),
        ),
        Section(
            "Live: latency",
            "From odometry published by the player to prediction received by the collector, another process in between.",
            figures.latency_histogram(
                {name: live.latencies * 1e3}, unit="ms", what="odometry published to prediction received"
            ),
        ),
        *base.sections,
    ]
    protocol = dict(base.protocol) | {
        "Simulated car": f"{VEHICLE}, Runge-Kutta at 1 ms, noise {NOISE} on v_x, v_y, ω; hidden from the model: "
        f"steering_offset {HIDDEN['steering_offset']['offset']:g} rad",
    }
    return Report(
        "From a race log to a live prediction", f"{base.summary} {_live_words(live)}.", sections, protocol, base.table
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--out", type=Path, default=Path("out/demo"), help="folder for everything that is made on the way"
    )
    try:
        demo(parser.parse_args().out)
    except UserError as error:
        sys.exit(f"error: {error}")
