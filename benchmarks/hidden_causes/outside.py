"""Outside the library: drives with a fault that no effect describes, and what the diagnosis says of them.

    python -m benchmarks.hidden_causes.outside [--seed 0] [--count 20] [--cars rk4,double_track,foreign] [--only fading_grip]

A hash of the seed draws the size of the fault, from clearly visible to large, track, style, noise and length (60 to 100 s);
faults and truths come in turn. Right is the verdict ``unexplained`` without a cause, with words on the channel that errs
which name the signal or the time that the fault goes with. Words are the patterns at the horizon, what is left, a proposed
formula, and the largest patterns of single steps, as the command prints them.
"""

from __future__ import annotations

import argparse
import math
import re
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np

from benchmarks.hidden_causes import foreign
from benchmarks.hidden_causes.cases import COARSE, STEP, TRACKS, Case, drive, vehicle_file
from benchmarks.hidden_causes.outcomes import shared
from benchmarks.page import table
from dynssm_ros.arrays import Vector
from dynssm_ros.errors import DataWarning
from dynssm_ros.evaluation.residuals.diagnosed import ExaminedDiagnosis
from dynssm_ros.identification.result.diagnose import diagnose
from dynssm_ros.reporting.diagnosis_words import MOST_PATTERNS, formula_in_words, pattern_in_words
from dynssm_ros.signals.recording import Recording
from dynssm_ros.simulation.laps import SimulationError
from dynssm_ros.simulation.plant import PLANTS, PlantKind, PlantType, Rk4Plant, register_plant
from dynssm_ros.vehicle import Vehicle
from dynssm_ros.vehicle.single_track import Array, Motion, StageEffect

TRUTHS: tuple[PlantKind, ...] = ("rk4", "double_track", foreign.NAME)
_SECONDS = (60.0, 100.0)
_RATES = (0.04, 0.02)  # s: sampling times
_BEND = 2.0  # m/s^2 of lateral acceleration, from which on the car is in a bend


@dataclass(frozen=True)
class Fault(StageEffect):
    """Physics that no effect has, of a ``size``; drawn from ``SIZES``."""

    SIZES: ClassVar[tuple[float, float]] = (0.0, 0.0)
    SHOWS: ClassVar[dict[str, str]] = {}
    """By channel that errs, what its words must have (a regular expression)."""
    size: float

    @property
    def carries(self) -> tuple[str, ...]:
        return ()

    def memory(self, q: Motion, rate: Callable[[Array], Array]) -> Array:
        """The state of this effect, which starts at 0; ``rate`` is its derivative."""
        (name,) = self.carries
        now = q.effect_states.setdefault(name, 0.0 * q.v_x)
        q.effect_state_rates[name] = rate(now)
        return now


class FadingGrip(Fault):
    """Tyres that heat up: they lose ``size`` of their grip in each second of a bend, and cool on straights."""

    SIZES = (0.03, 0.12)
    SHOWS: ClassVar = dict.fromkeys(("v_y", "omega"), "lateral acc|steering|sideslip|bend")
    carries = ("outside.heat",)

    def tyres(self, xp: Any, q: Motion) -> None:
        bend = _beyond(xp, abs(q.v_x * q.omega) - _BEND, 0.3)
        heat = self.memory(q, lambda now: bend - (1.0 - bend) * now)
        left = 1.0 / (1.0 + self.size * heat)
        q.F_fy, q.F_ry = left * q.F_fy, left * q.F_ry


class ThrottleAndYaw(Fault):
    """A sideways acceleration of ``size`` times throttle and yaw rate (m/s)."""

    SIZES = (12.0, 36.0)
    SHOWS: ClassVar = {"v_y": "throttle|pedal"}

    def forces(self, xp: Any, q: Motion) -> None:
        q.F_y = q.F_y + self.size * q.m * q.r * q.omega


class SwingingYaw(Fault):
    """A yaw acceleration that swings at 0.3 Hz by ``size`` (rad/s^2)."""

    SIZES = (0.15, 0.6)
    SHOWS: ClassVar = {"omega": r"every 3\.[2-4]\d* s"}

    def accelerations(self, xp: Any, q: Motion) -> None:
        q.omega_dot = q.omega_dot + self.size * xp.sin(2 * math.pi * 0.3 * q.context["t"])


class TiringEngine(Fault):
    """A resistance that grows by ``size`` (m/s^2) in each second on the throttle."""

    SIZES = (0.1, 0.5)
    SHOWS: ClassVar = {"v_x": "throttle|pedal"}
    carries = ("outside.load",)

    def forces(self, xp: Any, q: Motion) -> None:
        on = _beyond(xp, q.r - 0.1, 0.02)
        loaded = self.memory(q, lambda now: on - (1.0 - on) * now / 0.5)
        q.F_x = q.F_x - self.size * q.m * loaded


class PullingBrake(Fault):
    """A yaw acceleration of ``size`` (rad/s^2) times the brake."""

    SIZES = (0.4, 1.6)
    SHOWS: ClassVar = {"omega": "throttle|pedal|braking|longitudinal acc"}

    def accelerations(self, xp: Any, q: Motion) -> None:
        brake = (abs(q.r) - q.r) / 2
        q.omega_dot = q.omega_dot + self.size * brake


class Slosh(Fault):
    """``size`` of the car's mass swings sideways at 0.6 Hz, as fuel in a tank does; the rest is as if it did not."""

    SIZES = (0.1, 0.3)
    SHOWS: ClassVar = dict.fromkeys(("v_y", "omega"), "lateral acc|steering|sideslip|yaw acc|bend")
    carries = ("outside.aside", "outside.speed")

    def forces(self, xp: Any, q: Motion) -> None:
        aside, speed = (q.effect_states.setdefault(name, 0.0 * q.v_x) for name in self.carries)
        spring = (2 * math.pi * 0.6) ** 2 * aside + 0.2 * 2 * math.pi * 0.6 * speed
        q.effect_state_rates["outside.aside"] = speed
        q.effect_state_rates["outside.speed"] = -q.v_x * q.omega - spring
        q.F_y = q.F_y + self.size * q.m * (spring + q.v_x * q.omega)


class SteeringPlay(Fault):
    """The wheels follow the steering with a play of ``size`` (rad) to each side."""

    SIZES = (0.004, 0.015)
    SHOWS: ClassVar = dict.fromkeys(("v_y", "omega"), "steering|lateral acc|sideslip|yaw acc")
    carries = ("outside.wheels",)

    def inputs(self, xp: Any, q: Motion) -> None:
        given = q.delta

        def follows(now: Array) -> Array:
            off = given - now
            return (off - (abs(off + self.size) - abs(off - self.size)) / 2) / 0.02

        q.delta = self.memory(q, follows)


def _beyond(xp: Any, value: Array, width: float) -> Array:
    """1 where ``value`` is above 0, 0 below, over ``width``."""
    return (1.0 + xp.tanh(value / width)) / 2


@dataclass(frozen=True)
class SensorFault:
    """What a sensor does that no effect has.

    Attributes:
        sizes: from clearly visible to large.
        shows: see :attr:`Fault.SHOWS`; of ``when`` the stretch of time that is told must be within.
        spoil: changes columns ``by name``, given the time (s), the size and a generator.
        when: from and to (s), where the fault is short.
    """

    sizes: tuple[float, float]
    shows: dict[str, str]
    spoil: Callable[[dict[str, Vector], Vector, float], None]
    when: tuple[float, float] | None = None


def _drifting_scale(columns: dict[str, Vector], t: Vector, size: float) -> None:
    """The gyroscope's scale factor grows by ``size`` in a minute."""
    columns["omega"] *= 1.0 + size * t / 60.0


def _loose(columns: dict[str, Vector], t: Vector, size: float) -> None:
    """The velocity sensor swings for six seconds by ``size`` (m/s)."""
    loose = (t > 20.0) & (t < 26.0)
    columns["v_y"][loose] += size * np.sin(2 * np.pi * 1.3 * t[loose])


def _pitching(columns: dict[str, Vector], t: Vector, size: float) -> None:
    """The sideways velocity shows ``size`` (s) of the acceleration ahead."""
    v_x = columns["v_x"]
    back = max(1, round(0.2 / float(t[1] - t[0])))
    ahead = np.concatenate([v_x[back:], np.repeat(v_x[-1:], back)])
    behind = np.concatenate([np.repeat(v_x[:1], back), v_x[:-back]])
    columns["v_y"] += size * (ahead - behind) / (2 * back * float(t[1] - t[0]))


SENSORS = {
    "drifting_scale": SensorFault((0.06, 0.25), {"omega": r"\btime\b| t\b", "v_y": r"\btime\b| t\b"}, _drifting_scale),
    "loose_sensor": SensorFault((0.1, 0.4), {"v_y": r"\btime\b"}, _loose, (20.0, 26.0)),
    "pitching_sensor": SensorFault((0.03, 0.12), {"v_y": "throttle|pedal|longitudinal acc|braking"}, _pitching),
}
PHYSICS: dict[str, type[Fault]] = {
    "fading_grip": FadingGrip, "throttle_and_yaw": ThrottleAndYaw, "swinging_yaw": SwingingYaw,
    "tiring_engine": TiringEngine, "pulling_brake": PullingBrake, "slosh": Slosh, "steering_play": SteeringPlay,
}  # fmt: skip
FAULTS = (*PHYSICS, *SENSORS)


@dataclass(frozen=True)
class _Faulty(Rk4Plant):
    """A truth with a fault."""

    of: PlantType
    fault: Fault

    def step(self, vehicle: Vehicle) -> float:
        return STEP

    def first(self, vehicle: Vehicle) -> tuple[StageEffect, ...]:
        return (*self.of.first(vehicle), self.fault)


@dataclass(frozen=True)
class Answer:
    """What the diagnosis says of a drive."""

    fault: str
    size: float
    case: str
    verdict: str
    named: tuple[str, ...]
    shown: bool  # whether the words name the right signal
    words: tuple[str, ...] = field(repr=False)
    seconds: float  # of the processor

    @property
    def right(self) -> bool:
        """Whether nothing is named, and the right signal is."""
        return self.verdict == "unexplained" and not self.named and self.shown


def answers(seed: int, count: int, cars: Sequence[PlantKind] = TRUTHS, only: Sequence[str] = ()) -> Iterator[Answer]:
    """Diagnoses of ``count`` drives; those whose car cannot be driven are left out."""
    for k in range(seed, seed + count):
        rng = np.random.default_rng([k, 12])
        fault, plant = (only or FAULTS)[k % len(only or FAULTS)], cars[k // len(FAULTS) % len(cars)]
        plant = cars[int(rng.integers(len(cars)))] if only else plant
        case = Case({}, k, plant, float(rng.uniform(*_SECONDS)), str(rng.choice([*TRACKS])), float(rng.choice(_RATES)))
        sizes = PHYSICS[fault].SIZES if fault in PHYSICS else SENSORS[fault].sizes
        size = float(np.exp(rng.uniform(*np.log(sizes))))
        try:
            recording = driven(case, fault, size)
        except SimulationError:
            continue
        file, begun = vehicle_file(case), time.process_time()
        found = ExaminedDiagnosis.of(diagnose(recording, file, line=case.road.centre))
        yield _answer(fault, size, case, found, time.process_time() - begun)


def driven(case: Case, fault: str, size: float) -> Recording:
    """A drive with a fault of a size; for errors see :func:`~benchmarks.hidden_causes.cases.record`."""
    if fault in PHYSICS:
        name = f"{fault} {size:.17g} {case.plant}"
        register_plant(name, PLANTS.get(name) or _Faulty(PLANTS[COARSE[case.plant]], PHYSICS[fault](size)))
        return drive(replace(case, plant=name))
    recording = drive(case)
    columns = {name: values.copy() for name, values in recording.columns.items()}
    SENSORS[fault].spoil(columns, recording.elapsed, size)
    return replace(recording, columns=columns)


def _answer(fault: str, size: float, case: Case, found: ExaminedDiagnosis, seconds: float) -> Answer:
    words = list(_words(found))
    shows = PHYSICS[fault].SHOWS if fault in PHYSICS else SENSORS[fault].shows
    shown = any(channel in shows and re.search(shows[channel], each) for channel, each in words)
    when = SENSORS[fault].when if fault in SENSORS else None
    if when is not None and found.clustered.is_there:
        low, high = found.clustered.when
        shown |= when[0] - 1.0 < low and high < when[1] + 1.0
        words.append(("", f"largest {low:.0f} to {high:.0f} s"))
    named = tuple(cause.effect for cause in found.causes)
    told = tuple(f"{channel}: {each}" for channel, each in words)
    return Answer(fault, size, case.name, found.verdict, named, shown, told, seconds)


def _words(found: ExaminedDiagnosis) -> Iterator[tuple[str, str]]:
    """Sentences on what is left, each with the channel that it is about."""
    yield from ((one.channel, one.words) for one in found.structure[:MOST_PATTERNS])
    if found.left.is_there:
        for each in pattern_in_words(found.left).split(". "):
            yield each.partition(",")[0], each
    yield from ((pattern.channel, pattern.words) for pattern in found.patterns[:MOST_PATTERNS])
    yield from ((formula.channel, formula_in_words(formula)) for formula in found.formulas)


def page(found: Sequence[Answer]) -> str:
    """Rates and a row for each drive, as Markdown."""
    counted = [
        ("`unexplained` with the right picture", [one.right for one in found]),
        ("verdict `unexplained`", [one.verdict == "unexplained" for one in found]),
        ("the words name the right signal", [one.shown for one in found]),
    ]
    rates = []
    for words, right in counted:
        rate = shared(right)
        low, high = rate["interval_95"]
        share = f"{100 * rate['share']:.0f} %"
        rates.append([words, f"{rate['count']} of {rate['of']}", share, f"{100 * low:.0f} to {100 * high:.0f} %"])
    drives = [
        [f"`{one.fault}` {one.size:.3g}", f"`{one.case}`", one.verdict, ", ".join(one.named), "yes" if one.shown else "no",
         f"{one.seconds:.0f} s"]
        for one in found
    ]  # fmt: skip
    return "\n\n".join(
        [
            table(["rate", "drives", "share", "95 % interval"], rates),
            table(["fault", "drive", "verdict", "named", "right signal", "processor"], drives),
        ]
    )


def main() -> None:
    """Diagnoses and prints the page."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seed", type=int, default=0, help="of the first drive")
    parser.add_argument("--count", type=int, default=20, help="drives")
    parser.add_argument("--cars", default=",".join(TRUTHS), help="truths, apart by commas")
    parser.add_argument("--only", action="append", default=[], choices=FAULTS, help="of the faults; repeat for more")
    given = parser.parse_args()
    warnings.simplefilter("ignore", DataWarning)
    found = []
    for one in answers(given.seed, given.count, given.cars.split(","), given.only):
        print(f"{one.fault} {one.size:.3g} {one.case}: {one.verdict} {', '.join(one.named)}, shown {one.shown}, "
              f"{one.seconds:.0f} s", *one.words, sep="\n    ", flush=True)  # fmt: skip
        found.append(one)
    print(page(found))


if __name__ == "__main__":
    main()
