"""Live laps over DDS, with noise, delay and a patch of little grip: ``python -m benchmarks.endurance.live_laps``.

Simulated car, predictor and controller are processes of their own and run in real time, or in lockstep, beside processes that
keep a core busy each. The simulator tells how near the borders the car truly came, whatever is measured of it.
"""

from __future__ import annotations

import argparse
import csv
import multiprocessing
import os
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from benchmarks.endurance.live_run import LiveRun, check_running, collecting, isolated_environment, node_process
from benchmarks.matrix.raced_cells import CHANGES, Cell, sensing
from benchmarks.matrix.scored_cells import CARS
from dynssm_ros.cli.console import console, progress_bar
from dynssm_ros.control.race import PATIENCE
from dynssm_ros.control.reference import load_reference
from dynssm_ros.errors import UserError
from dynssm_ros.files import write_json
from dynssm_ros.progress import Progress
from dynssm_ros.runtime.registry import load_model
from dynssm_ros.simulation.plant import PlantKind
from dynssm_ros.track.tracks import CSV_COLUMNS, Track
from dynssm_ros.vehicle import Vehicle, load_vehicle, save_vehicle

ROAD = ("club", 11)  # built-in track and seed of its variation
SPEED_SCALE = 0.8
CHANGE = "grip_patch"
PLANT: PlantKind = "double_track"
WATCHDOG = 1.0  # s, of the simulated car and of its controller
_START = 60.0  # s that processes may take until the first lap begins
_NODES = {"laps": "controller", "driven (laps)": "simulator", "model": "predictor"}  # what its diagnostics tell


@dataclass(frozen=True)
class LiveLaps:
    """What became of a drive."""

    lap_times: list[float]  # of the controller's laps (s)
    least_room: float  # the least distance of the true car's centre from the borders (m); negative outside of them
    plans: dict[str, int]  # by what became of them
    step_p99: float  # of a control step (ms), over the last ones
    held_up: float
    """By how much the simulated car fell behind real time (s), as it drives nothing that nobody could answer."""
    controller: str  # its last words
    predictor: str  # likewise; empty if there was none


class _Listener:
    """Reads the diagnostics of a drive as they come."""

    def __init__(self, run: LiveRun) -> None:
        self._run, self._read = run, 0
        self.lap_times: list[float] = []
        self.values: dict[str, dict[str, str]] = {node: {} for node in _NODES.values()}
        self.words = dict.fromkeys(_NODES.values(), "")

    def read(self) -> bool:
        """Takes what is new; whether there was a new lap."""
        count = len(self.lap_times)
        for _, words, values in self._run.diagnostics[self._read :]:
            node = next(node for key, node in _NODES.items() if key in values)
            self.values[node], self.words[node] = values, words
            if node == "controller" and int(values["laps"]) > len(self.lap_times):
                self.lap_times.append(float(values["last lap (s)"]))
            self._read += 1
        return len(self.lap_times) > count


def drive_live(
    car: str,
    laps: int,
    model: Path | None = None,
    busy: int = 0,
    rate: float = 1.0,
    lockstep: bool = False,
    progress: Progress | None = None,
) -> LiveLaps:
    """Drives laps with the live stack: usual noise, odometry a step late, a patch with four fifths of the grip.

    Without a ``model`` there is no predictor, and the car's file is planned with. ``busy`` processes keep a core busy
    each. ``rate`` is the speed of the car's time over real time, or it waits for the controller (``lockstep``).

    Raises:
        UserError: the car does not come round in time, or a node stopped.
    """
    cell = Cell(car, ROAD, CHANGE)
    vehicle = load_vehicle(CARS[car].vehicle)
    known = vehicle if model is None else load_model(model).vehicle or vehicle
    patience = PATIENCE * load_reference("racing", known, cell.road, SPEED_SCALE).lap_time / rate
    run = LiveRun(0)
    with ExitStack() as stack:
        os.environ.update(isolated_environment())
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        nodes = _parameters(cell, vehicle, known, folder, rate, lockstep)
        if model is not None:
            nodes["predictor"] = {"model": model}
        stack.enter_context(_kept_busy(busy))
        collector = stack.enter_context(collecting(run))
        processes = {
            node: stack.enter_context(node_process(node, parameters, os.environ.copy()))
            for node, parameters in nodes.items()
        }
        listener, deadline = _Listener(run), time.monotonic() + _START + patience
        while len(listener.lap_times) < laps or not listener.values["simulator"]:
            if collector.wait_for(listener.read, 1.0):
                deadline = time.monotonic() + patience
            if progress is not None:
                progress(len(listener.lap_times), laps)
            for node, process in processes.items():
                check_running(node, process)
            if time.monotonic() > deadline:
                done = len(listener.lap_times)
                raise UserError(f"{car}: no lap in {patience:.3g} s after {done}: {listener.words['controller']}")
    told = listener.values["controller"]
    return LiveLaps(
        listener.lap_times,
        float(listener.values["simulator"]["least room to the borders so far (m)"]),
        {key.removeprefix("plans "): int(value) for key, value in told.items() if key.startswith("plans ")},
        float(told["step p99 (ms)"]),
        float(listener.values["simulator"]["held up so far (s)"]),
        listener.words["controller"],
        listener.words["predictor"],
    )


def _parameters(
    cell: Cell, vehicle: Vehicle, known: Vehicle, folder: Path, rate: float, lockstep: bool
) -> dict[str, dict[str, object]]:
    """Of the simulator, which drives ``vehicle``, and of the controller, which knows ``known``, by node; files in
    ``folder``.
    """
    (name, values), sensed = next(iter(CHANGES[cell.change].items())), sensing(cell.car, 1.0, True)
    road = {"track": _save_track(cell.road, folder / "road.csv"), "rate": rate, "watchdog": WATCHDOG}
    for file, car in (("driven.yaml", vehicle), ("known.yaml", known)):
        save_vehicle(car, folder / file)
    return {
        "simulator": road | {
            "vehicle": folder / "driven.yaml", "driver": "external", "plant": PLANT, "lockstep": lockstep,
            "effects": f"{name}:{','.join(f'{key}={value}' for key, value in values.items())}",
            "noise": list(sensed.noise), "pose_noise": list(sensed.pose_noise), "delay": sensed.delay,
        },
        "controller": road | {
            "vehicle": folder / "known.yaml", "speed_scale": SPEED_SCALE, "delay": sensed.delay,
            "diagnostics_period": 0.5, "max_late": 10.0,  # the simulated car's time may stand still
        },
    }  # fmt: skip


def _save_track(track: Track, path: Path) -> Path:
    """Writes a track as :func:`~dynssm_ros.track.tracks.read_track` reads it."""
    rows = np.column_stack([track.centre.points, track.width_right, track.width_left])
    with path.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file).writerows([[f"# {CSV_COLUMNS[0]}", *CSV_COLUMNS[1:]], *rows.tolist()])
    return path


@contextmanager
def _kept_busy(count: int) -> Iterator[None]:
    """Processes that compute all the time."""
    processes = [multiprocessing.get_context("spawn").Process(target=_compute, daemon=True) for _ in range(count)]
    for process in processes:
        process.start()
    try:
        yield
    finally:
        for process in processes:
            process.kill()


def _compute() -> None:
    while True:
        pass


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--car", choices=list(CARS), default="orca")
    parser.add_argument("--laps", type=int, default=20)
    parser.add_argument("--model", type=Path, help="folder, for the predictor; without it there is none")
    parser.add_argument("--busy", type=int, default=1, help="processes that keep a core busy each")
    parser.add_argument("--lockstep", action="store_true", help="the car's time waits for the controller")
    parser.add_argument("--json", type=Path, help="also write the result as JSON")
    given = parser.parse_args()
    try:
        with progress_bar("laps") as progress:
            driven = drive_live(
                given.car, given.laps, given.model, given.busy, lockstep=given.lockstep, progress=progress
            )
    except UserError as error:
        sys.exit(f"error: {error}")
    if given.json is not None:
        write_json(given.json, asdict(driven))
    p50, worst = np.median(driven.lap_times), max(driven.lap_times)
    console.print(
        f"{given.car}: {len(driven.lap_times)} laps, median {p50:.2f} s, worst {worst:.2f} s; least room to the borders "
        f"{driven.least_room:.3g} m; plans {driven.plans}; step p99 {driven.step_p99:.1f} ms; the car was held up for "
        f"{driven.held_up:.3g} s; {driven.controller}; predictor: {driven.predictor}",
        markup=False,
        soft_wrap=True,
    )
    sys.exit(0 if driven.least_room >= 0 else "the car left the road")


if __name__ == "__main__":
    main()
