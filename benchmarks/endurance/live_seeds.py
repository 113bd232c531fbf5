"""Live laps in one process, for many seeds of the noise: ``python -m benchmarks.endurance.live_seeds --count 100``.

The same car, road, noise, delay and patch of little grip as in :mod:`benchmarks.endurance.live_laps`. Nothing waits for
anything: each message is answered before the next, so that a drive depends on its seed alone. The predictor's answer is there
at the next step, as on the bus. What is left is whether the controller holds the road, whatever is measured.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.endurance.live_laps import CHANGE, PLANT, ROAD, SPEED_SCALE, WATCHDOG
from benchmarks.matrix.raced_cells import CHANGES, Cell, sensing
from benchmarks.matrix.scored_cells import CARS
from dynssm_ros.cli.console import console, progress_bar
from dynssm_ros.control.live import LiveController
from dynssm_ros.control.race import PATIENCE
from dynssm_ros.control.reference import load_reference
from dynssm_ros.control.settings import Settings
from dynssm_ros.errors import UserError
from dynssm_ros.runtime.artifact import open_artifact
from dynssm_ros.runtime.onnx_model import OnnxModel
from dynssm_ros.runtime.predictor import Prediction, Predictor
from dynssm_ros.signals.signal_map import load_signal_map
from dynssm_ros.simulation.external import CommandHolder, drive_by_commands
from dynssm_ros.simulation.sensing import Sensors
from dynssm_ros.vehicle import COEFFICIENTS, Applied, State, load_vehicle
from dynssm_ros.vehicle.kinematics import Pose


class Seeded(NamedTuple):
    """What became of a drive."""

    seed: int
    laps: int  # complete ones
    least_room: float  # the least distance of the true car's centre from the borders (m); negative outside of them
    predictions: int  # that the controller heard


def drive_seeded(car: str, seed: int, laps: int, model: Path | None = None) -> Seeded:
    """Drives laps with the live controller, and with the live predictor if there is a ``model`` folder; a car that
    leaves the road ends the drive. ``seed`` is that of the noise.

    Raises:
        UserError: the model is damaged, or of another car.
    """
    road, vehicle = Cell(car, ROAD, CHANGE).road, load_vehicle(CARS[car].vehicle)
    predictor = None if model is None else Predictor(OnnxModel(open_artifact(model)), load_signal_map("default"))
    known = vehicle if predictor is None else predictor.model.artifact.card.vehicle
    reference = load_reference("racing", known, road, SPEED_SCALE)
    sensed, T_s = replace(sensing(car, 1.0, True), seed=seed), vehicle.sampling_time
    settings = replace(Settings.of(known), deadline=np.inf)
    controller = LiveController(known, reference, road, settings, max_gap=WATCHDOG, delay=sensed.delay)
    sensors, time = Sensors(sensed, T_s), 0.0
    holder = CommandHolder(vehicle, WATCHDOG, lambda: time)
    driven = vehicle.with_effects(CHANGES[CHANGE].items())
    least, end, predictions = np.inf, PATIENCE * (laps + 1) * reference.lap_time, 0
    for k, sample in enumerate(drive_by_commands(driven, road, PLANT, holder.command)):
        time = k * T_s
        least = min(least, float(road.room(sample.s, sample.lateral)))
        if least < 0 or controller.laps.count >= laps or time > end:
            break
        sensors.measure(sample.pose, State(*sample.measured))
        if not sensors.is_full:
            continue
        pose, seen, age = sensors.arrived
        stamps = round(k * T_s * 1e9), round((k - age) * T_s * 1e9)
        command = controller.step(stamps[1], pose, seen)
        if isinstance(command, Applied):
            holder.receive(command)
            controller.learn()
        if predictor is not None:
            _observe(predictor, stamps[0], "feedback", sample.feedback)
            predictions += _predict(predictor, controller, stamps[1], pose, seen)
            if isinstance(command, Applied):
                _observe(predictor, stamps[1] + controller.answered_after, "command", command)
    return Seeded(seed, controller.laps.count, least, predictions)


def _observe(predictor: Predictor, stamp: int, kind: str, inputs: Applied) -> None:
    """Tells the predictor of the actuators: what they do, or what they are sent (``kind``) from ``stamp`` (ns) on."""
    predictor.observe(stamp, {f"throttle_{kind}": inputs.r, f"steering_{kind}": inputs.delta})


def _predict(predictor: Predictor, controller: LiveController, stamp: int, pose: Pose, seen: State) -> bool:
    """Tells the controller what the predictor says of odometry at ``stamp`` (ns); returns whether it says anything."""
    said = predictor.predict(stamp, {**pose._asdict(), **seen._asdict()})
    if not isinstance(said, Prediction):
        return False
    controller.remote.predicted(said.stamp, said.state.tolist())
    if said.theta is not None:
        controller.remote.adapted(said.stamp, dict(zip(COEFFICIENTS, said.theta.tolist(), strict=True)))
    predictor.finish()
    return True


def words(car: str, drives: Iterable[Seeded]) -> str:
    """What became of the drives, in a line."""
    drives = list(drives)
    rooms = {drive.seed: drive.least_room for drive in drives}
    left = [str(seed) for seed, room in rooms.items() if room < 0]
    return (
        f"{car}: {len(left)} of {len(rooms)} drives left the road{' with seeds ' + ', '.join(left) if left else ''}; "
        f"least room to the borders {min(rooms.values()):.3g} m, median {np.median(list(rooms.values())):.3g} m; "
        f"at least {min(drive.predictions for drive in drives)} predictions heard in each"
    )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--car", choices=list(CARS), default="orca")
    parser.add_argument("--first", type=int, default=0, help="seed")
    parser.add_argument("--count", type=int, default=100, help="of seeds")
    parser.add_argument("--laps", type=int, default=2)
    parser.add_argument("--model", type=Path, help="folder, for the predictor; without it there is none")
    given = parser.parse_args()
    drives = []
    try:
        with progress_bar("drives") as progress:
            for seed in range(given.first, given.first + given.count):
                drives.append(drive_seeded(given.car, seed, given.laps, given.model))
                progress(len(drives), given.count)
    except UserError as error:
        sys.exit(f"error: {error}")
    console.print(words(given.car, drives), markup=False, soft_wrap=True)
    sys.exit(0 if all(drive.least_room >= 0 for drive in drives) else 1)


if __name__ == "__main__":
    main()
