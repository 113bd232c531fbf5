"""Cars of a class drawn at random, each with a drive of its own: what a prior over cars is learned from.

A car's coefficients are drawn about its class's file with the standard deviations that stand there, within the bounds. Most
cars have lags of steering and throttle, and up to two more effects of the library. Half of them have four wheels. A drive is
kept as the car moved; what sensors and estimators make of it is drawn apart, so that it costs no simulation.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.signal import savgol_filter

from benchmarks.hidden_causes.cases import COARSE, NOISE, TRACKS, size
from benchmarks.matrix.scored_cells import CARS, RACER
from dynssm_ros.arrays import Vector
from dynssm_ros.errors import UserError
from dynssm_ros.signals.recording import Recording
from dynssm_ros.signals.signal_map import STATE_SIGNALS
from dynssm_ros.simulation.laps import SimulationError, as_recording, simulate
from dynssm_ros.simulation.plant import PlantKind
from dynssm_ros.track.driver import Style
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import Vehicle, load_vehicle
from dynssm_ros.vehicle.effects import EFFECTS

SECONDS = 60.0
_LAGS = ("steering_lag", "throttle_lag")
_LAGGING = 0.7  # share of cars with each of them
_TRIES = 4
_PLANTS = COARSE["rk4"], COARSE["double_track"]
_SMOOTHED_S = 0.2  # of an odometry that is fitted to poses, at most
_SPEED_NOISE, _AXLE_NOISE = 0.02, 0.007  # m/s; of omega the same times a wheelbase
_BRAKING = -0.5  # a throttle that goes below is that of a car with brakes
_SMALL_WHEELBASE, _LARGER = 0.062, 1.25
"""Tracks are for 1:43 cars of that wheelbase (m). Larger cars are faster too: with 0.17 m a track is 3.6 times as large, with
3 m 126 times."""
_NOISES = 0.03, 2.0  # in usual deviations
_HELD_S = 0.1  # for which an input's sample is held, at most


@dataclass(frozen=True)
class CarClass:
    """A class of cars."""

    name: str
    file: str  # vehicle file of its middle
    tracks: dict[str, float]  # names with their scales
    noise: tuple[float, float, float]  # usual deviations of the measured v_x, v_y, omega (m/s, m/s, rad/s)
    throttle_steps: bool = False  # as features of the layer: brakes take over from the engine

    @classmethod
    def about(cls, file: str) -> CarClass:
        """The class about a vehicle file, with tracks and noise as other cars have them for their wheelbases."""
        car = load_vehicle(file)
        scale = (car.constants.wheelbase / _SMALL_WHEELBASE) ** _LARGER
        omega = _AXLE_NOISE / car.constants.wheelbase
        brakes = car.inputs.set_point == "throttle" and car.inputs.throttle[0] <= _BRAKING
        noise = _SPEED_NOISE, _SPEED_NOISE, omega
        return cls(car.name, file, {"club": scale, "club_b": scale}, noise, brakes)

    @property
    def middle(self) -> Vehicle:
        """The car of its middle: its file, with lags in the middle of what is typical.

        It steps by Runge and Kutta, since Euler steps ring in slow light cars.
        """
        car = load_vehicle(self.file).model_copy(update={"integrator": "rk4"})
        lags = [(lag, {"time_constant": float(np.sqrt(np.prod(EFFECTS[lag].TYPICAL)))}) for lag in _LAGS]
        return car.with_effects(lags)


CLASSES = {
    of.name: of
    for of in (
        CarClass("racer", RACER, {"club": 3.0, "club_b": 3.0}, CARS["racer"].noise),
        CarClass("indy", "indy", TRACKS, NOISE, throttle_steps=True),
    )
}


def drawn(of: CarClass, seed: int) -> tuple[Vehicle, PlantKind]:
    """A car of the class, and how it moves."""
    file, rng = load_vehicle(of.file), np.random.default_rng([seed, 21])
    spread = np.array([std or 0.0 for std in file.std])
    theta = np.clip(file.nominal + spread * rng.standard_normal(len(spread)), file.lower, file.upper)
    others = [effect for effect in EFFECTS if effect not in _LAGS]
    chosen = [lag for lag in _LAGS if rng.random() < _LAGGING]
    chosen += rng.choice(others, rng.integers(0, 3), replace=False).tolist()
    car = file.with_nominal(theta).with_effects([(effect, size(effect, rng)) for effect in chosen])
    return car, _PLANTS[int(rng.integers(2))]


def drive(of: CarClass, seed: int) -> Recording | None:
    """The drive of a drawn car without errors of sensors; ``None`` if it cannot be driven however gently."""
    rng = np.random.default_rng([seed, 22])
    track = str(rng.choice(list(of.tracks)))
    road = load_track(track).scaled(of.tracks[track])
    aggressiveness, variation = float(rng.uniform(0.2, 0.9)), float(rng.uniform(0.4, 0.9))
    with suppress(UserError, ValueError):
        car, plant = drawn(of, seed)
        for attempt in range(_TRIES):
            style = Style(aggressiveness * 0.75**attempt, variation)
            with suppress(SimulationError):
                return as_recording(simulate(car, road, SECONDS, plant=plant, seed=seed, style=style))
    return None


def drives(of: CarClass, count: int, kept: Path) -> Iterator[Recording]:
    """Drives of the first ``count`` cars that can be driven; kept in a folder, and measured as :func:`measured` says."""
    kept.mkdir(parents=True, exist_ok=True)
    seed = -1
    while count:
        seed += 1
        file, failed = kept / f"{of.name}_{seed}.parquet", kept / f"{of.name}_{seed}.undrivable"
        if failed.exists():
            continue
        if not file.exists():
            recording = drive(of, seed)
            if recording is None:
                failed.touch()
                continue
            recording.save(file)
        count -= 1
        yield measured(Recording.load(file), of, seed)


def measured(recording: Recording, of: CarClass, seed: int) -> Recording:
    """The drive as its car's sensors and estimators give it: noise, smoothing, inputs that are sampled seldom."""
    rng, T_s = np.random.default_rng([seed, 23]), recording.T_s
    recording = recording.with_commands("none")
    columns = dict(recording.columns)
    noise = np.exp(rng.uniform(*np.log(_NOISES))) * np.array(of.noise)
    rows = 2 * int(rng.integers(0, round(_SMOOTHED_S / T_s / 2) + 1)) + 1
    for signal, deviation in zip(STATE_SIGNALS, noise, strict=True):
        columns[signal] = smoothed(columns[signal] + deviation * rng.standard_normal(len(recording)), rows)
    every = int(rng.integers(1, round(_HELD_S / T_s) + 1))
    for signal in ("r_fb", "delta_fb"):
        columns[signal] = columns[signal][np.arange(len(recording)) // every * every]
    return replace(recording, columns=columns)


def smoothed(values: Vector, rows: int) -> Vector:
    """Slopes of quadratics through the integral, over an odd number of rows about each; a single row stays as it is."""
    if rows == 1:
        return values
    return np.asarray(savgol_filter(np.cumsum(values) - values / 2, rows, 2, deriv=1))
