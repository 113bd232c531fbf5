"""Cells of the matrix: a training, and a drive that differs from it in track, speed, and one hidden change of the car.

Simulated trainings are every car with every plant and every level of sensor noise. Measured ones are of the real logs, as
far as they are there. Decisions are taken on development cells alone. Of simulated cells a hash of the name says which these
are; of real logs those that the data's README marks as *test* are test cells, and all others were looked at.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import pairwise, product
from pathlib import Path

import numpy as np

import dynssm_ros
from dynssm_ros.signals.recording import Recording
from dynssm_ros.simulation.laps import SimulationError
from dynssm_ros.simulation.plant import PlantKind
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import Vehicle, load_vehicle

RACER = str(Path(__file__).parents[2] / "examples" / "racer_1_10.yaml")
NOISE_LEVELS = {"exact": 0.0, "usual": 1.0, "three": 3.0}
PLANTS: tuple[PlantKind, ...] = ("euler", "rk4", "double_track")
CHANGES: dict[str, dict[str, dict[str, float]]] = {
    "none": {},
    "grip": {"front_grip": {"factor": 0.8}, "rear_grip": {"factor": 0.8}},
    "steering": {"steering_offset": {"offset": 0.01}},
    "mass": {"mass": {"factor": 1.1}},
    "bank": {"road_bank": {"angle": 0.05}},
}
_SEEDS = {"train": 1, "test": 2}
_PUTNAM_LAPS = (28.6, 248.9, 409.0)  # s: the gate is passed


@dataclass(frozen=True)
class Car:
    """A simulated car."""

    vehicle: str  # its file
    train: tuple[str, float]  # track of the training with its scale; ``test``: of the test
    test: tuple[str, float]
    seconds: tuple[float, float]  # of training, and of a test
    noise: tuple[float, float, float]  # usual deviations of the measured v_x, v_y, omega (m/s, m/s, rad/s)


CARS = {
    "orca": Car("orca", ("club", 1.0), ("club_b", 1.0), (120.0, 40.0), (0.01, 0.01, 0.03)),
    "av21": Car("av21", ("road_course", 1.0), ("club", 140.0), (240.0, 80.0), (0.02, 0.02, 0.003)),
    "racer": Car(RACER, ("club", 3.0), ("club_b", 3.0), (120.0, 40.0), (0.02, 0.02, 0.03)),
}


@dataclass(frozen=True)
class Training:
    """What models are trained on: a simulated drive, or measured logs."""

    name: str  # of the training
    vehicle: str  # file of the car
    simulated: tuple[str, PlantKind, str] | None = None  # car, plant and level of noise of a simulated one
    logs: tuple[tuple[str, float, float], ...] = ()  # of a measured one: names and parts (s) of prepared recordings


@dataclass(frozen=True)
class Cell:
    """A drive that the models of a training are scored on."""

    training: Training  # of the models
    change: str  # what is hidden from them, or which log it is
    logs: tuple[tuple[str, float, float], ...] = ()  # of a measured one
    marked: bool = field(default=False, compare=False)  # the data's README marks it as *test*

    @property
    def name(self) -> str:
        return f"{self.training.name}-{self.change}"

    @property
    def noise(self) -> tuple[float, float, float] | None:
        """Deviations of what is measured of v_x, v_y, omega (m/s, m/s, rad/s); ``None`` of real logs: nobody knows them."""
        if self.training.simulated is None:
            return None
        car, _, level = self.training.simulated
        return sensor_noise(car, level)

    @property
    def is_test(self) -> bool:
        """Whether it is for publishing only."""
        if self.training.simulated is None:
            return self.marked
        return hashlib.sha256(self.name.encode()).digest()[0] % 2 == 0


def simulated_cells() -> Iterator[Cell]:
    """All of them."""
    for name, plant, level, change in product(CARS, PLANTS, NOISE_LEVELS, CHANGES):
        yield Cell(Training(f"{name}-{plant}-{level}", CARS[name].vehicle, (name, plant, level)), change)


def measured_cells() -> Iterator[Cell]:
    """Those of the real logs."""
    start, end = 16.0, 1e9
    gates = (*_PUTNAM_LAPS, end)
    for k, (begins, ends) in enumerate(pairwise(gates), 1):
        rest = (("putnam", start, begins), ("putnam", ends, end))
        yield Cell(Training(f"putnam-without-lap_{k}", "av21", logs=rest), f"lap_{k}", (("putnam", begins, ends),))
    for way, other in (("slow", "fast"), ("right", "left")):
        driven = Training(f"putnam-{way}", "av21", logs=((f"putnam:{way}", start, end),))
        yield Cell(driven, other, ((f"putnam:{other}", start, end),))
    free, circles = (("free_driving_1002", 0.0, end),), (("circles_1223", 0.0, end),)
    yield Cell(Training("dart-free", RACER, logs=free), "circles_1223", circles)
    yield Cell(Training("dart-circles", RACER, logs=circles), "free_driving_1002", free)
    rubber = Training("dart-rubber", RACER, logs=free + circles)
    for log in ("free_driving_1027", "circles_right_03_ramp_1653", "tape_and_tiles_right_03_ramp_1758"):
        yield Cell(rubber, log, ((log, 0.0, end),), marked=True)


def season_logs(data: Path, test: bool) -> list[Path]:
    """The logs of the 1:10 car's season that are for development, or for a ``test``, by the rule of the data's README."""
    logs = [path for path in sorted((data / "dart_season").iterdir()) if path.is_dir()]
    return [log for log in logs if (int(hashlib.sha256(log.name.encode()).hexdigest(), 16) % 3 == 0) == test]


def cells(data: Path) -> list[Cell]:
    """All cells, those of the real logs if ``data`` has them."""
    return [*simulated_cells(), *(measured_cells() if (data / "dart").is_dir() else ())]


def training_drive(training: Training, data: Path) -> list[Recording]:
    """What the models of a training see."""
    if training.simulated is None:
        return [measured(log, data) for log in training.logs]
    name, plant, level = training.simulated
    return [_simulated(name, plant, level, "train", "none")]


def test_drive(cell: Cell, data: Path) -> list[Recording]:
    """What they are scored on.

    Raises:
        SimulationError: the changed car cannot be driven there.
    """
    if cell.training.simulated is None:
        return [measured(log, data) for log in cell.logs]
    name, plant, level = cell.training.simulated
    return [_simulated(name, plant, level, "test", cell.change)]


def _simulated(name: str, plant: PlantKind, level: str, part: str, change: str) -> Recording:
    """A drive; a changed car that leaves the road is driven more gently.

    Trained is on the centre line, at up to 90 % of the car's limits; scored on the racing line of another track, at up to
    95 %.
    """
    car = CARS[name]
    vehicle = simulated_car(name)
    track, scale = car.train if part == "train" else car.test
    road = load_track(track).scaled(scale)
    for aggressiveness in (0.9, 0.8, 0.7, 0.6) if part == "train" else (0.95, 0.85, 0.75, 0.65, 0.55):
        with suppress(SimulationError):
            run = dynssm_ros.simulate(
                vehicle, road, duration=car.seconds[part == "test"], plant=plant, seed=_SEEDS[part],
                line="centre" if part == "train" else "racing", aggressiveness=aggressiveness,
                noise=sensor_noise(name, level), effects=CHANGES[change],
            )  # fmt: skip
            return dynssm_ros.recorded(run)
    raise SimulationError(f"{name} with {change} on {track}: leaves the road however gently it is driven")


def sensor_noise(name: str, level: str) -> tuple[float, float, float]:
    """Deviations of the measured v_x, v_y, omega (m/s, m/s, rad/s) of a car at a level of noise."""
    v_x, v_y, omega = (NOISE_LEVELS[level] * value for value in CARS[name].noise)
    return v_x, v_y, omega


def simulated_car(name: str) -> Vehicle:
    """The car that is driven: of its file, but for the 1:10 car, whose file is somebody's guess.

    Its coefficients are off that by up to 10 %, so that calibration has work.
    """
    vehicle = load_vehicle(CARS[name].vehicle)
    if name != "racer":
        return vehicle
    random = np.random.default_rng(5)
    theta = vehicle.nominal * (1 + 0.1 * random.uniform(-1.0, 1.0, 17))
    return vehicle.with_nominal(np.clip(theta, vehicle.lower, vehicle.upper))


def measured(log: tuple[str, float, float], data: Path) -> Recording:
    """A part (s) of a real log; ``putnam:slow`` and the like are the rows of one way of driving."""
    (name, start, end), chosen = log, ""
    if ":" in name:
        name, chosen = name.split(":")
    if name == "putnam":
        bag, signals, rate = data / "av21" / "putnam_park_run4_2", "av21", 25.0
    else:
        bag, signals, rate = data / "dart" / name, "default", 50.0
    recording = dynssm_ros.extract(bag, signals, rate=rate, commands="none")
    seconds = (recording.time - recording.time[0]) / 1e9
    kept = (seconds >= start) & (seconds < end)
    v_x, omega = recording["v_x"], recording["omega"]
    ways = {"slow": v_x < 21.0, "fast": v_x >= 23.0, "right": omega < 0.03, "left": omega >= 0.05}
    return recording.select(kept & ways[chosen] if chosen else kept)
