"""Cars of three makes on four wheels, with linear steering: what is named of them that is not there.

    python -m benchmarks.hidden_causes.makes [--seed 0] [--count 12] [--seconds 75] [--of-a-car 4]

Of each car a hash draws how its tyres lose grip with load, how it rolls, its toe, how its steering gives way and how its
differential locks; none of this is in a vehicle file. The file is calibrated on a drive of the healthy car. Four drives of
each car are diagnosed: two healthy ones, one with a drive force 4 % larger, and one with an effect of the library.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from benchmarks.hidden_causes.cases import NOISE, STEP, Hidden, size
from benchmarks.hidden_causes.outcomes import shared
from benchmarks.page import table
from dynssm_ros.errors import DataWarning
from dynssm_ros.identification.result.calibration import calibrate
from dynssm_ros.identification.result.diagnose import diagnose
from dynssm_ros.identification.result.diagnosis import Diagnosis
from dynssm_ros.signals.recording import Recording
from dynssm_ros.simulation.double_track import DoubleTrack, Wheels
from dynssm_ros.simulation.laps import SimulationError, as_recording, simulate
from dynssm_ros.simulation.plant import Rk4Plant, register_plant
from dynssm_ros.track.driver import Style
from dynssm_ros.track.tracks import Track, load_track
from dynssm_ros.vehicle import Vehicle, load_vehicle
from dynssm_ros.vehicle.effects.drivetrain import TRACK_WIDTH
from dynssm_ros.vehicle.single_track import Array, Motion, StageEffect

MAKES = {"av21": ("club", 140.0), "sedan": ("club_b", 120.0), "formula_student": ("club", 45.0)}
"""Vehicle files, with the track that each is driven on and the factor by which it is enlarged for it."""
STRUCTURE = ("load_sensitivity", "load_transfer", "locked_differential")
"""Effects that such a car has."""
_CAUSES = (
    "front_grip", "rear_grip", "steering_offset", "steering_gain", "steering_lag", "throttle_lag", "drag", "mass",
    "downforce", "tire_relaxation", "odometry_lever_arm", "odometry_delay", "yaw_rate_bias",
)  # fmt: skip
_STRONGER = {"drive_gain": {"factor": 1.04}}
_RATE = 0.02  # s: sampling time
_TRIES = 6
_DRIVE = ("drive_gain", "C_m1", "mass")  # what a drive force that is larger is told by


@dataclass(frozen=True)
class FourWheels(DoubleTrack):
    """Four wheels with toe, steering that gives way, and a differential that locks with load and drive."""

    toe: tuple[float, float] = (0.0, 0.0)  # of each front and rear wheel (rad), positive inwards
    compliance: float = 0.0  # angle (rad) by which the front wheels turn back under the front axle's peak force
    preload: float = 0.0  # of the differential, in rear axle loads
    lock: float = 0.0  # share of the drive force that it moves from wheel to wheel

    @classmethod
    def drawn(cls, vehicle: Vehicle, seed: int) -> FourWheels:
        """A car of the make of ``vehicle``."""
        rng, car = np.random.default_rng([seed, 9]), vehicle.constants
        locks = rng.random() < 0.5
        return cls(
            width=TRACK_WIDTH * car.wheelbase * float(rng.uniform(0.9, 1.15)),
            roll_front=car.l_r / car.wheelbase + float(rng.uniform(-0.1, 0.15)),
            sensitivity=float(rng.uniform(0.05, 0.3)),
            toe=(float(rng.uniform(-0.005, 0.005)), float(rng.uniform(0.0, 0.005))),
            compliance=float(rng.uniform(0.0, 0.012)),
            preload=locks * float(rng.uniform(0.0, 0.05)),
            lock=locks * float(rng.uniform(0.1, 0.4)),
        )

    def wheel_slips(self, xp: Any, q: Motion) -> Wheels:
        """Slip angles (rad) with toe and with what the steering gives way."""
        one, back = super().wheel_slips(xp, q), self.compliance * q.F_fy / q.theta.D_f
        front, rear = self.toe
        return Wheels(
            one.front_left - front - back, one.front_right + front - back, one.rear_left - rear, one.rear_right + rear
        )

    def forces(self, xp: Any, q: Motion) -> None:
        """Adds the yaw moment of the differential, against the turn, to that of the steered wheels."""
        super().forces(xp, q)
        moved: Array = self.preload * q.F_zr + self.lock * abs(q.F_d)
        slip = q.omega * self.width / 2 / (abs(q.v_x) + 1.0)
        q.M_z = q.M_z - moved * self.width / 2 * xp.tanh(slip / 0.01)


@dataclass(frozen=True)
class Make(Rk4Plant):
    """A car of a make on the road."""

    seed: int

    def step(self, vehicle: Vehicle) -> float:
        return STEP

    def first(self, vehicle: Vehicle) -> tuple[StageEffect, ...]:
        return (FourWheels.drawn(vehicle, self.seed),)


@dataclass(frozen=True)
class Answer:
    """What a diagnosis says of a drive."""

    make: str
    hidden: Hidden
    verdict: str
    named: tuple[str, ...]
    reach: frozenset[str]  # with alternatives, and what recalibration moved
    small: tuple[str, ...]
    seconds: float  # of the processor

    @property
    def not_there(self) -> tuple[str, ...]:
        """What is named and neither hidden nor of such a car."""
        return tuple(name for name in self.named if name not in (*self.hidden, *STRUCTURE))


def answers(seed: int, count: int, seconds: float, of_a_car: int) -> Iterator[Answer]:
    """Diagnoses of ``count`` drives of ``seconds``, so many of each car."""
    for k in range(-(-count // of_a_car)):
        make = list(MAKES)[k % len(MAKES)]
        name, scale = MAKES[make]
        track, plant = load_track(name).scaled(scale), f"make_{seed + k}"
        register_plant(plant, Make(seed + k))
        vehicle = load_vehicle(make).model_copy(update={"sampling_time": _RATE})
        drives = (_drive(vehicle, track, plant, (seed + k, one), seconds) for one in range(of_a_car + 1))
        file = calibrate(next(drives)[1], vehicle, integrator="rk4").vehicle
        for _, (hidden, laps) in zip(range(min(of_a_car, count - k * of_a_car)), drives, strict=False):
            begun = time.process_time()
            found = diagnose(laps, file, line=track.centre)
            yield _answer(make, hidden, found, time.process_time() - begun)


def _drive(
    vehicle: Vehicle, track: Track, plant: str, seed: tuple[int, int], seconds: float
) -> tuple[Hidden, Recording]:
    """The drive of a car with that number, and what is hidden in it; 0 is the one to calibrate on."""
    rng = np.random.default_rng([*seed, 10])
    style = Style(float(rng.uniform(0.6, 0.85)), float(rng.uniform(0.4, 0.9)))
    noise = [std * float(rng.uniform(0.5, 1.5)) for std in NOISE]
    cause = str(rng.choice(_CAUSES))
    hidden = ({}, {}, {}, _STRONGER, {cause: size(cause, rng)})[seed[1]]
    car = vehicle.with_effects(hidden.items())
    for attempt in range(_TRIES):
        gentler = replace(style, aggressiveness=style.aggressiveness * 0.9**attempt)
        with suppress(SimulationError):
            run = simulate(
                car, track, seconds, plant=plant, seed=seed[0], style=gentler, noise=(noise[0], noise[1], noise[2])
            )
            return hidden, as_recording(run)
    raise SimulationError(f"car {seed[0]}, drive {seed[1]}, {', '.join(hidden)}: off the road in {_TRIES} styles")


def _answer(make: str, hidden: Hidden, found: Diagnosis, seconds: float) -> Answer:
    named = tuple(cause.effect for cause in found.causes)
    small = tuple(cause.effect for cause in found.small_effects)
    moved = {"mass" if name == "m" else name for name in found.moved}  # which a file may know no better
    reach = {*named, *small, *moved}.union(*(cause.alternatives for cause in found.causes))
    return Answer(make, hidden, found.verdict, named, frozenset(reach), small, seconds)


def page(found: list[Answer]) -> str:
    """Rates and a row for each drive, as Markdown."""
    healthy = [one for one in found if not one.hidden]
    stronger = [one for one in found if one.hidden == _STRONGER]
    causes = [one for one in found if one.hidden and one.hidden != _STRONGER]
    rates = [
        ("`steering_curve` is named", ["steering_curve" in one.named for one in found]),
        ("named in a healthy drive and no structure of such a car", [bool(one.not_there) for one in healthy]),
        ("named beside what is hidden and no structure of such a car", [bool(one.not_there) for one in causes]),
        ("the drive force 4 % larger is found", [bool(one.reach & {*_DRIVE}) for one in stronger]),
        (
            "the hidden effect is named, or an alternative to what is",
            [bool(one.reach & {*one.hidden}) for one in causes],
        ),
    ]
    rows = [
        [
            one.make,
            "; ".join(f"{n} {', '.join(f'{v:.3g}' for v in values.values())}" for n, values in one.hidden.items()),
            one.verdict,
            ", ".join(one.named) + (f" (small: {', '.join(one.small)})" if one.small else ""),
            f"{one.seconds:.0f} s",
        ]
        for one in found
    ]
    return "\n\n".join(
        [
            table(["rate", "drives", "share", "95 % interval"], [_rate(words, each) for words, each in rates if each]),
            table(["make", "hidden", "verdict", "named", "processor"], rows),
        ]
    )


def _rate(words: str, each: list[bool]) -> list[str]:
    rate = shared(each)
    low, high = rate["interval_95"]
    return [
        words, f"{rate['count']} of {rate['of']}", f"{100 * rate['share']:.0f} %", f"{100 * low:.0f} to {100 * high:.0f} %"
    ]  # fmt: skip


def main() -> None:
    """Diagnoses and prints the page."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seed", type=int, default=0, help="of the first car")
    parser.add_argument("--count", type=int, default=12, help="drives")
    parser.add_argument("--seconds", type=float, default=75.0, help="length of each")
    parser.add_argument(
        "--of-a-car", type=int, default=4, choices=range(1, 5), help="drives of a car; of 2 both are healthy"
    )
    given = parser.parse_args()
    warnings.simplefilter("ignore", DataWarning)
    found = []
    for one in answers(given.seed, given.count, given.seconds, given.of_a_car):
        print(one, flush=True)
        found.append(one)
    print(page(found))


if __name__ == "__main__":
    main()
