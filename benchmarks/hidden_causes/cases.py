"""Cases with a hidden cause: simulated laps whose car has effects that the vehicle file does not know.

In every case the sensors are noisy, and driver and track differ. The car is one of four truths: single-track, four wheels,
one of another make (:mod:`benchmarks.hidden_causes.foreign`), or one that somebody else wrote
(:mod:`benchmarks.hidden_causes.multi_body`). The nominal values of the vehicle file are off by about 2 %. Of the last two
nobody knows them: their file comes from a drive without hidden effects, calibrated and then diagnosed, as a team would begin.

Sizes. An effect is just noticeable where its estimate stands seven standard deviations from neutral on the reference
drive: 90 s of the road course at 25 Hz in moderate style, the noise of ``NOISE``, and nominal values free as far as the
file says that they are known. Twice the log-likelihood then falls by 49. Sizes are drawn evenly in their logarithm from
there (rounded) to what a car shows that is badly set up and can still be driven. With a gentler driver or more noise the
least of them are harder than that.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import cycle

import numpy as np

from benchmarks.hidden_causes import foreign, multi_body
from dynssm_ros.identification.result.calibration import calibrate
from dynssm_ros.identification.result.diagnose import diagnose
from dynssm_ros.signals.recording import Recording
from dynssm_ros.simulation.laps import SimulationError, as_recording, simulate
from dynssm_ros.simulation.plant import PLANTS, PlantKind, PlantType, Rk4Plant, register_plant
from dynssm_ros.track.driver import Style
from dynssm_ros.track.tracks import Track, load_track
from dynssm_ros.vehicle import COEFFICIENTS, Vehicle, load_vehicle
from dynssm_ros.vehicle.effects import EFFECTS
from dynssm_ros.vehicle.single_track import StageEffect

Hidden = dict[str, dict[str, float]]

STEP = 5e-3
"""Of Runge and Kutta (s): 0.4 of the fastest of these cars' time constants, within 3e-8 of steps of 1 ms after 12 s."""
NOISE = (0.02, 0.02, 0.003)  # m/s, m/s, rad/s: a good odometry
OFF = 0.02  # of the nominal values
TRACKS = {"road_course": 1.0, "club": 140.0, "club_b": 110.0}
"""Tracks with the factor by which they are enlarged for a full-size car; the clubs are tracks for 1:43 cars."""
_RATES = (0.04, 0.04, 0.04, 0.02)  # s: sampling times, drawn with equal chance
_KNOWN = 0.02  # how well the vehicle file says that they are known
_SHIFTS = {"S_hf": 0.0007, "S_hr": 0.0007, "S_vf": 40.0, "S_vr": 40.0}  # rad, N: the same for values around 0
PEAKS = ("D_f", "D_r")  # of which a file may have one wrong, in turn
_TOO_MUCH = 1.0 / 0.95  # times what the car has
_TRIES = 6
TRUTHS: tuple[PlantKind, ...] = ("rk4", "double_track", foreign.NAME, multi_body.NAME)
_UNKNOWN = (foreign.NAME, multi_body.NAME)  # cars of which nobody knows the values
_OTHER_DRIVE = 10**6  # added to the seed
_REFERENCE_S = 120.0  # of the drive that the file of such a car is calibrated on
COARSE: dict[PlantKind, PlantKind] = {kind: f"{kind} in few steps" for kind in ("rk4", "double_track", foreign.NAME)}
"""Names of the same plants in steps of :data:`STEP`."""
_ROUND = 13  # cases, of which two have a pair of effects and two none
_PAIRS, _NONE = (4, 10), (6, 12)


@dataclass(frozen=True)
class _Coarse(Rk4Plant):
    """Another plant, in as few steps as it needs."""

    of: PlantType

    def step(self, vehicle: Vehicle) -> float:
        return STEP

    def first(self, vehicle: Vehicle) -> tuple[StageEffect, ...]:
        return self.of.first(vehicle)


for _kind, _name in COARSE.items():
    register_plant(_name, _Coarse(PLANTS[_kind]))


@dataclass(frozen=True)
class Case:
    """A hidden cause."""

    hidden: Hidden  # effects of the simulated car, by name and parameter
    seed: int  # of everything random
    plant: PlantKind = "rk4"  # how the car was simulated
    duration: float = 120.0  # of the recording (s)
    track: str = "road_course"  # name of the track
    sampling_time: float = 0.04  # of the recording (s)
    wrong: str = ""  # coefficient that the file has wrong
    reference: int | None = None  # seed of the case whose file it has, of a car that nobody knows; ``None``: its own

    @property
    def name(self) -> str:
        where = f"{self.plant}/{self.track}/{1 / self.sampling_time:.0f}Hz"
        return f"{'+'.join(self.hidden) or 'none'}/{where}/{self.seed}{f'/{self.wrong}' if self.wrong else ''}"

    @property
    def road(self) -> Track:
        return load_track(self.track).scaled(TRACKS[self.track])


def size(effect: str, rng: np.random.Generator) -> dict[str, float]:
    """Random parameters of an effect, between just noticeable and large."""
    low, high = EFFECTS[effect].TYPICAL
    return EFFECTS[effect].drawn(float(np.exp(rng.uniform(np.log(low), np.log(high)))), rng)


def cases(
    seed: int,
    count: int,
    effects: Sequence[str] = tuple(EFFECTS),
    *,
    healthy: bool = False,
    seconds: float = 120.0,
    of_a_file: int = 1,
) -> Iterator[Case]:
    """``count`` cases of ``seconds``: every effect in turn, with pairs and with none in between; the truths in turn.

    With ``healthy`` nothing is hidden in any of them. Every third file of a car that is known has then 5 % too much grip of
    an axle. ``of_a_file`` drives in turn of a car that nobody knows, on one track, have one file.
    """
    rng = np.random.default_rng(seed)
    can_be = {plant: tuple(name for name in effects if _can_be(name, plant)) for plant in TRUTHS}
    turns = {names: cycle(names) for names in can_be.values()}
    first: dict[PlantKind, Case] = {}
    for k in range(count):
        kind, plant = k % _ROUND, TRUTHS[k % len(TRUTHS)]
        can = can_be[plant]
        if healthy or kind in _NONE or not can:
            names: list[str] = []
        elif kind in _PAIRS and len(can) > 1:
            names = [can[i] for i in rng.choice(len(can), 2, replace=False)]
        else:
            names = [next(turns[can])]
        case = Case(
            {name: size(name, rng) for name in names},
            seed + k,
            plant,
            duration=seconds,
            wrong=PEAKS[k // 3 % 2] if healthy and k % 3 == 2 and plant not in _UNKNOWN else "",
            track=str(rng.choice(list(TRACKS))),
            sampling_time=float(rng.choice(_RATES)),
        )
        if plant in _UNKNOWN and of_a_file > 1:
            if k // len(TRUTHS) % of_a_file == 0:
                first[plant] = case
            like = first[plant]
            case = replace(case, track=like.track, sampling_time=like.sampling_time, reference=like.seed)
        yield case


def _can_be(effect: str, plant: PlantKind) -> bool:
    return plant != multi_body.NAME or effect in multi_body.HIDES


def record(case: Case) -> tuple[Recording, Vehicle]:
    """The recording of a case, and the vehicle file that does not know what is hidden.

    Raises:
        SimulationError: the car cannot be driven with what is hidden, however gently.
    """
    return drive(case), vehicle_file(case)


def drive(case: Case) -> Recording:
    """Drives a case; for errors see :func:`record`."""
    recording = _drive(case, known(case).with_effects(case.hidden.items()), case.seed)
    return replace(recording, info=recording.info.model_copy(update={"source": (case.name,)}))


def _drive(case: Case, car: Vehicle, seed: int) -> Recording:
    rng = np.random.default_rng([seed, 7])
    aggressiveness, variation = float(rng.uniform(0.6, 0.85)), float(rng.uniform(0.4, 0.9))
    noise = [std * float(rng.uniform(0.5, 1.5)) for std in NOISE]

    def lap(attempt: int) -> Recording:
        return as_recording(
            simulate(
                car, case.road, duration=case.duration, plant=COARSE.get(case.plant, case.plant), seed=seed,
                style=Style(aggressiveness * 0.9**attempt, variation), noise=(noise[0], noise[1], noise[2]),
            )
        )  # fmt: skip

    for attempt in range(_TRIES - 1):
        with suppress(SimulationError):
            return lap(attempt)
    return lap(_TRIES - 1)


def known(case: Case) -> Vehicle:
    """The car without what is hidden."""
    name = multi_body.FILE if case.plant == multi_body.NAME else "av21"
    return load_vehicle(name).model_copy(update={"sampling_time": case.sampling_time})


def vehicle_file(case: Case) -> Vehicle:
    """The vehicle file, which does not know what is hidden."""
    car = known(case)
    if case.plant not in _UNKNOWN:
        file = off(car, np.random.default_rng([case.seed, 8]))
        too_much = np.array(COEFFICIENTS) == case.wrong
        return file.with_nominal(np.where(too_much, _TOO_MUCH * car.nominal, file.nominal))
    seed = case.seed if case.reference is None else case.reference
    return _calibrated(seed, case.plant, case.track, case.sampling_time)


@lru_cache(maxsize=len(_UNKNOWN))
def _calibrated(seed: int, plant: PlantKind, track: str, sampling_time: float) -> Vehicle:
    """The file of a car that nobody knows, from a drive without hidden effects."""
    reference = Case({}, seed, plant, _REFERENCE_S, track, sampling_time)
    car = known(reference)
    healthy = _drive(reference, car, reference.seed + _OTHER_DRIVE)
    file = car.unmeasured() if reference.plant == foreign.NAME else car  # that of the av21 is of another car
    calibrated = calibrate(healthy, file, integrator="rk4").vehicle
    return diagnose(healthy, calibrated, line=reference.road.centre).vehicle


def off(vehicle: Vehicle, rng: np.random.Generator) -> Vehicle:
    """The vehicle file of somebody who knows the nominal values to about 2 %."""
    spread = np.array([_SHIFTS.get(c, _KNOWN * abs(v)) for c, v in zip(COEFFICIENTS, vehicle.nominal, strict=True)])
    wrong = vehicle.nominal + rng.standard_normal(len(spread)) * spread * OFF / _KNOWN
    return vehicle.with_nominal(np.clip(wrong, vehicle.lower, vehicle.upper), spread)
