"""Cells of the matrix: a car, a track that nothing was tuned on, one hidden change, and how the car is measured.

Every car, track and change is a cell. Plant, noise, delay and objective are drawn by a hash of its name, so that each of them
meets all others in some cells. Another hash says which cells are for development; decisions are taken on those alone.
"""

from __future__ import annotations

import hashlib
from argparse import ArgumentTypeError
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import product, starmap

import numpy as np

from benchmarks.matrix.scored_cells import CARS, NOISE_LEVELS, Training, simulated_car
from dynssm_ros.control.settings import Objective
from dynssm_ros.simulation.plant import PlantKind
from dynssm_ros.simulation.sensing import Sensing
from dynssm_ros.track.centre_points import TrackError
from dynssm_ros.track.lines import Line
from dynssm_ros.track.tracks import Track, load_track
from dynssm_ros.vehicle import load_vehicle

TRACKS = (("club", 11), ("club", 12), ("club", 13), ("club_b", 14), ("club_b", 15), ("club_b", 16))
"""Built-in tracks, and seeds of their variations."""
CHANGES: dict[str, dict[str, dict[str, float]]] = {
    "none": {},
    "grip_patch": {"grip_patch": {"factor": 0.8, "centre": 0.5, "length": 0.3}},
    "front_grip": {"front_grip": {"factor": 0.85}},
    "steering": {"steering_offset": {"offset": 0.02}},
    "mass": {"mass": {"factor": 1.1}},
    "drag": {},
}  # what is hidden. Of drag it is half of the car's own, see effects
PLANTS: tuple[PlantKind, ...] = ("rk4", "double_track")
OBJECTIVES: tuple[Objective, ...] = ("tracking", "progress")
PACE: dict[Objective, float] = {"tracking": 0.85, "progress": 0.9}  # share of the car's limits in the line's speed
LAPS = 2
_SCALES = {"orca": 1.0, "racer": 2.8, "av21": 110.0}
_WIDTHS = {"orca": 0.4, "racer": 1.2, "av21": 15.0}  # m
_POSE_NOISE = {"orca": (0.002, 0.002, 0.002), "racer": (0.01, 0.01, 0.005), "av21": (0.02, 0.02, 0.002)}
_HARMONICS = range(2, 7)
_BENT = 0.2  # of the lap's length over 2 pi, by which the centre line is moved at most by a harmonic
_TIGHTEST = 0.75  # of the least radius of the built-in track
_TRIES = 500
_SEEDS = 100  # of the noise, between drives of a cell


@dataclass(frozen=True)
class Cell:
    """What models drive."""

    car: str  # one of the generalisation matrix' cars
    track: tuple[str, int]  # built-in track and seed of its variation
    change: str  # what is hidden from the models
    again: int = 0  # counts drives of the cell with other noise

    @property
    def name(self) -> str:
        return f"{self.car}-{self.track[0]}_{self.track[1]}-{self.change}"

    def _drawn(self, what: str, options: int) -> int:
        return int.from_bytes(hashlib.sha256(f"{what} {self.name}".encode()).digest()[:4]) % options

    @property
    def is_test(self) -> bool:
        """Whether it is for publishing only."""
        return self._drawn("part", 2) == 0

    @property
    def plant(self) -> PlantKind:
        return PLANTS[self._drawn("plant", len(PLANTS))]

    @property
    def objective(self) -> Objective:
        return OBJECTIVES[self._drawn("objective", len(OBJECTIVES))]

    @property
    def noise(self) -> str:
        return list(NOISE_LEVELS)[self._drawn("noise", len(NOISE_LEVELS))]

    @property
    def late(self) -> bool:
        return bool(self._drawn("delay", 2))

    @property
    def sensing(self) -> Sensing:
        return sensing(self.car, NOISE_LEVELS[self.noise], self.late, self.track[1] + _SEEDS * self.again)

    @property
    def training(self) -> Training:
        """What the models learn from: another track, with the usual noise, of the car without the change."""
        return Training(f"{self.car}-{self.plant}-usual", CARS[self.car].vehicle, (self.car, self.plant, "usual"))

    @property
    def effects(self) -> dict[str, dict[str, float]]:
        if self.change != "drag":
            return CHANGES[self.change]
        return {"drag": {"coefficient": 0.5 * simulated_car(self.car).coefficients["C_r2"].nominal}}

    @property
    def road(self) -> Track:
        road = variation(load_track(self.track[0]), self.track[1]).scaled(_SCALES[self.car])
        half = np.full(len(road.width_left), _WIDTHS[self.car] / 2)
        return replace(road, width_left=half, width_right=half)


def sensing(car: str, level: float, late: bool, seed: int = 0) -> Sensing:
    """What comes between a car and its controller: noise (``level`` 1 is the usual), and whether measurements are a
    step late.
    """
    velocities, pose = ((level * a, level * b, level * c) for a, b, c in (CARS[car].noise, _POSE_NOISE[car]))
    return Sensing(velocities, pose, load_vehicle(CARS[car].vehicle).sampling_time if late else 0.0, seed)


def cells() -> Iterator[Cell]:
    """All of them."""
    return starmap(Cell, product(CARS, TRACKS, CHANGES))


def named(name: str) -> Cell:
    """The cell of a name on the command line.

    Raises:
        ArgumentTypeError: there is none.
    """
    known = {cell.name: cell for cell in cells()}
    if name not in known:
        raise ArgumentTypeError(f"{name} is no cell of the matrix; one is {next(iter(known))}")
    return known[name]


def variation(track: Track, seed: int) -> Track:
    """A track of the same kind: its centre line is bent by a few waves around the lap.

    Raises:
        ValueError: none was found that can be driven.
    """
    rng = np.random.default_rng(seed)
    s, length = track.centre.s, track.length
    radius = 1.0 / np.abs(track.centre.curvature(s)).max()
    for _ in range(_TRIES):
        size, phase = rng.uniform(0.0, 1.0, len(_HARMONICS)), rng.uniform(0.0, 2 * np.pi, len(_HARMONICS))
        waves = (
            a / n * np.cos(2 * np.pi * n * s / length + p) for n, a, p in zip(_HARMONICS, size, phase, strict=True)
        )
        beside = _BENT * length / (2 * np.pi) * np.sum(list(waves), axis=0)
        with suppress(TrackError):  # the road overlaps itself
            bent = replace(track, name=f"{track.name}_{seed}", centre=Line(track.centre.position(s, beside)))
            if 1.0 / np.abs(bent.centre.curvature(bent.centre.s)).max() > _TIGHTEST * radius:
                return bent
    raise ValueError(f"track {track.name}: no variation with seed {seed} in {_TRIES} tries")
