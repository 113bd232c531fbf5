"""How well the check of a recording's signals works: healthy recordings have no finding, damaged ones are named.

    python -m benchmarks.damaged_recordings [--out PAGE]

Healthy are the logs of ``DYNSSM_DATA`` and 20 simulated drives of four cars with noise and effects. Damaged are 20 copies of
those that turn to both sides: a hash of the copy's number chooses recording, kind and size.
"""

from __future__ import annotations

import argparse
import hashlib
import math
import os
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import dynssm_ros
from benchmarks.matrix.scored_cells import season_logs
from benchmarks.page import render, save_page, table
from dynssm_ros.arrays import Vector
from dynssm_ros.errors import DataWarning
from dynssm_ros.signals.consistency import contradictions
from dynssm_ros.signals.findings import Finding, number
from dynssm_ros.signals.recording import Recording
from dynssm_ros.vehicle import load_vehicle

ROOT = Path(__file__).parents[1]
ORCA, RACER, AV21, SEDAN = (
    "orca", str(ROOT / "examples" / "racer_1_10.yaml"), "av21", str(ROOT / "benchmarks" / "hidden_causes" / "bmw_320i.yaml"),
)  # fmt: skip
_CARS = {  # noise of v_x, v_y (m/s), omega (rad/s); sizes of small and of full-size tracks
    ORCA: ((0.01, 0.01, 0.03), 1.0, 0.01),
    RACER: ((0.02, 0.02, 0.03), 3.0, 0.03),
    AV21: ((0.05, 0.05, 0.005), 140.0, 1.0),
    SEDAN: ((0.03, 0.03, 0.003), 140.0, 1.0),
}
_DRIVES: tuple[tuple[str, dict[str, dict[str, float]]], ...] = (  # track, and what the car has that no model knows of
    ("club", {}),
    ("club_b", {"grip": {"factor": 0.7}}),
    ("road_course", {"road_bank": {"angle": 0.04}}),
    ("oval", {"odometry_delay": {"delay": 0.08}}),
    ("club_b", {"steering_lag": {"time_constant": 0.08}, "road_grade": {"angle": 0.02}}),
)
_SECONDS, _TRIES = 60.0, (0.9, 0.75, 0.6)
_COPIES = 20
_WITHIN, _STEERING_WITHIN, _TIME_WITHIN_S, _ANGLE_WITHIN_RAD = 0.15, 0.35, 0.4, 0.15
"""Within which a size is right: of a factor; of a steering's, whose tyres give way; of a lag, which has the car's own."""


@dataclass(frozen=True)
class Log:
    """A healthy recording and the wheelbase of its car (m)."""

    name: str
    recording: Recording
    wheelbase: float


@dataclass(frozen=True)
class Damage:
    """A kind of damage.

    Attributes:
        sizes: among which the hash chooses.
        apply: gives the damaged recording.
        keys: of findings that name it.
        size: that the finding should tell, of the chosen one; ``None`` where the key says all.
    """

    sizes: tuple[float, ...]
    apply: Callable[[Recording, float], Recording]
    keys: tuple[str, ...]
    size: Callable[[float], float] | None = None


def simulated(seed: int) -> Iterator[Log]:
    """20 drives of four cars."""
    for car, (noise, small, large) in _CARS.items():
        constants = load_vehicle(car).constants
        for turn, (track, effects) in enumerate(_DRIVES):
            scale = small if "club" in track else large
            for aggressiveness in _TRIES:
                try:
                    run = dynssm_ros.simulate(
                        car, track, duration=_SECONDS, seed=seed + turn, noise=noise, effects=effects, scale=scale,
                        aggressiveness=aggressiveness, plant="rk4" if turn % 2 else "euler",
                    )  # fmt: skip
                except dynssm_ros.errors.UserError:  # it leaves the track
                    continue
                recording = dynssm_ros.api.recorded(run)
                name = f"{Path(car).stem} on {track}" + "".join(f", {each}" for each in effects)
                yield Log(name, recording, constants.l_f + constants.l_r)
                break


def measured(data: Path, test: bool) -> Iterator[Log]:
    """Real logs, and the one of a public simulator; those marked as test if ``test``."""
    marked = {"free_driving_1027", "circles_right_03_ramp_1653", "tape_and_tiles_right_03_ramp_1758"}
    logs = [(path, RACER, path.name in marked) for path in sorted((data / "dart").iterdir()) if path.is_dir()]
    logs += [(path, RACER, test) for path in season_logs(data, test)]
    logs += [(data / "av21" / "putnam_park_run4_2", AV21, False), (data / "orca" / "ethz_pure_pursuit", ORCA, False)]
    for path, car, is_test in logs:
        if is_test == test:
            constants = load_vehicle(car).constants
            signals, rate = ("av21", 25.0) if car == AV21 else ("default", 50.0)
            commands = None if car == ORCA else "none"
            recording = dynssm_ros.extract(path, signals, rate=rate, commands=commands, drop_bad=True)
            yield Log(path.name, recording, constants.l_f + constants.l_r)


def changed(recording: Recording, **columns: Vector) -> Recording:
    """With other columns."""
    return replace(recording, columns=recording.columns | columns)


def scaled(*names: str) -> Callable[[Recording, float], Recording]:
    """Multiplies columns."""
    return lambda recording, factor: changed(recording, **{name: factor * recording[name] for name in names})


def shifted(*names: str) -> Callable[[Recording, float], Recording]:
    """Stamps columns early by some seconds, as where a log was cut elsewhere."""

    def apply(recording: Recording, seconds: float) -> Recording:
        rows = round(seconds / recording.T_s)
        here, there = (
            slice(max(0, -rows), len(recording) - max(0, rows)),
            slice(max(0, rows), len(recording) + min(0, rows)),
        )
        kept = {name: values[there if name in names else here] for name, values in recording.columns.items()}
        return replace(recording, time=recording.time[here], segment=recording.segment[here], columns=kept)

    return apply


def _turned(recording: Recording, angle: float) -> Recording:
    return changed(recording, theta=recording["theta"] + angle)


def _in_map(recording: Recording, _: float) -> Recording:
    velocity = (recording["v_x"] + 1j * recording["v_y"]) * np.exp(1j * recording["theta"])
    return changed(recording, v_x=velocity.real, v_y=velocity.imag)


def _resting(recording: Recording, rest: float) -> Recording:
    brake = np.maximum(-recording["r_fb"], 0.0)
    return changed(recording, r_fb=-(rest + (1.0 - rest) * brake))


def _constant(name: str) -> Callable[[Recording, float], Recording]:
    return lambda recording, value: changed(recording, **{name: np.full(len(recording), value)})


_FACTORS = (0.5, 0.6, 0.75, 1.3, 1.6, 2.0)
_SHIFTS = (-8.0, -3.5, -1.5, 1.0, 2.0, 4.0, 7.0)
_DEG, _KMH = 180 / math.pi, 3.6
_SCALE, _TIMES = ("steering_scale",), ("inputs_time", "steering_time", "throttle_time")
DAMAGES: dict[str, Damage] = {
    "sign of omega": Damage((-1.0,), scaled("omega"), ("omega_sign",)),
    "sign of theta": Damage((-1.0,), scaled("theta"), ("theta_sign",)),
    "sign of v_y": Damage((-1.0,), scaled("v_y"), ("v_y_sign",)),
    "sign of v_x": Damage((-1.0,), scaled("v_x"), ("v_x_sign",)),
    "sign of the steering": Damage((-1.0,), scaled("delta_fb"), ("steering_sign",)),
    "sign of the throttle": Damage((-1.0,), scaled("r_fb"), ("throttle_sign",)),
    "scale of the velocity": Damage(_FACTORS, scaled("v_x", "v_y"), ("pose_speed",), lambda f: 1 / f),
    "scale of the pose": Damage(_FACTORS, scaled("x", "y"), ("pose_speed",), lambda f: f),
    "scale of omega": Damage(_FACTORS, scaled("omega"), ("omega_scale",), lambda f: 1 / f),
    "steering wheel's angle": Damage((12.0, 14.5, 17.0, 20.0), scaled("delta_fb"), _SCALE, lambda f: 1 / f),
    "unit of the velocity": Damage((_KMH, 1 / 0.44704), scaled("v_x", "v_y"), ("pose_speed",), lambda f: 1 / f),
    "unit of omega": Damage((_DEG,), scaled("omega"), ("omega_scale",), lambda f: 1 / f),
    "unit of theta": Damage((_DEG,), scaled("theta"), ("theta_scale",), lambda f: f),
    "unit of the steering": Damage((_DEG,), scaled("delta_fb"), _SCALE, lambda f: 1 / f),
    "unit of the throttle": Damage((100.0,), scaled("r_fb"), ("throttle_range",)),
    "unit of the pose": Damage((100.0, 1000.0), scaled("x", "y"), ("pose_speed",), lambda f: f),
    "frame of the velocity": Damage((0.0,), _in_map, ("twist_in_map_frame",)),
    "frame of the pose": Damage((-1.0,), scaled("y", "theta"), ("pose_mirrored", "omega_sign")),
    "frame of the odometry": Damage((-1.0,), scaled("y", "theta", "v_y", "omega"), ("steering_sign",)),
    "heading": Damage((-math.pi / 2, math.pi / 2, math.pi, 0.6), _turned, ("theta_offset",), lambda angle: -angle),
    "clock of the steering": Damage(_SHIFTS, shifted("delta_fb"), ("steering_time",), lambda s: s),
    "clock of the throttle": Damage(_SHIFTS, shifted("r_fb"), ("throttle_time",), lambda s: s),
    "clock of the inputs": Damage(_SHIFTS, shifted("delta_fb", "r_fb"), _TIMES, lambda s: s),
    "clock of the pose": Damage(_SHIFTS, shifted("x", "y", "theta"), ("pose_time",), lambda s: -s),
    "rest value of the brake": Damage((0.0075, 0.02, 0.04), _resting, ("throttle_never_used",), lambda rest: rest),
    "omega that is 0": Damage((0.0,), _constant("omega"), ("omega_constant",)),
    "v_y that is 0": Damage((0.0,), _constant("v_y"), ("v_y_constant",)),
}  # fmt: skip


@dataclass(frozen=True)
class Outcome:
    """A damaged copy, and what was found in it."""

    log: str
    kind: str
    chosen: float
    expected: float | None
    found: tuple[Finding, ...]
    named: Finding | None

    @property
    def is_right(self) -> bool:
        """Whether the damage is named, with its size."""
        if self.named is None or self.expected is None:
            return self.named is not None
        off, what = self.named.size - self.expected, self.named.what
        if what.endswith("_time"):
            return abs(off) < _TIME_WITHIN_S
        if what == "theta_offset":
            return abs(math.remainder(off, 2 * math.pi)) < _ANGLE_WITHIN_RAD
        return abs(off) < (_STEERING_WITHIN if what == "steering_scale" else _WITHIN) * abs(self.expected)


def damaged(logs: list[Log], number: int) -> Outcome:
    """A copy of one of the logs, damaged as the hash of its number says."""
    rng = np.random.default_rng(int(hashlib.sha256(f"damaged copy {number}".encode()).hexdigest()[:16], 16))
    log, kind = logs[rng.integers(len(logs))], sorted(DAMAGES)[rng.integers(len(DAMAGES))]
    damage = DAMAGES[kind]
    chosen = damage.sizes[rng.integers(len(damage.sizes))]
    found = contradictions(damage.apply(log.recording, chosen), log.wheelbase)
    named = next((each for each in found if each.what in damage.keys), None)
    return Outcome(log.name, kind, chosen, damage.size(chosen) if damage.size else None, found, named)


def turns_both_ways(log: Log) -> bool:
    """Whether left and right bends are driven, with a steering that moves."""
    low, high = np.percentile(log.recording["omega"], [5.0, 95.0])
    return bool(min(-low, high) > 0.2 * max(-low, high)) and float(np.ptp(log.recording["delta_fb"])) > 0


def page(groups: dict[str, list[tuple[Log, tuple[Finding, ...]]]], outcomes: list[Outcome], seconds: float) -> str:
    """The page of results."""
    rows = []
    for name, each in groups.items():
        wrong = "; ".join(f"{log.name}: {', '.join(one.what for one in found)}" for log, found in each if found)
        rows.append([name, str(len(each)), str(sum(bool(found) for _, found in each)), wrong])
    copies = []
    for one in outcomes:
        told = ", ".join(f"{each.what} {number(each.size)}" for each in one.found)
        expected = "" if one.expected is None else number(one.expected)
        copies.append([one.log, one.kind, expected, told, "yes" if one.is_right else "no"])
    right = sum(one.is_right for one in outcomes)
    return render(
        "damaged_recordings", healthy=table(["recordings", "number", "with a finding", "which"], rows), right=right,
        copies=table(["recording", "damage", "size", "found", "named with its size"], copies), count=len(outcomes),
        seconds=f"{seconds:.0f}", version=dynssm_ros.__version__,
    )  # fmt: skip


def main() -> None:
    """Measures and writes the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "results" / "damaged_recordings.md")
    parser.add_argument("--seed", type=int, default=500, help="of the simulated drives")
    given, begin = parser.parse_args(), time.process_time()
    data = Path(os.environ.get("DYNSSM_DATA", ROOT.parent / "shared" / "data"))
    warnings.simplefilter("ignore", DataWarning)
    logs = {
        "simulated": list(simulated(given.seed)),
        "measured, development": list(measured(data, test=False)),
        "measured, test": list(measured(data, test=True)),
    }
    groups = {
        name: [(log, contradictions(log.recording, log.wheelbase)) for log in each] for name, each in logs.items()
    }
    pool = [log for each in logs.values() for log in each if turns_both_ways(log)]
    outcomes = [damaged(pool, number) for number in range(_COPIES)]
    save_page(page(groups, outcomes, time.process_time() - begin), given.out)
    print(given.out.read_text(encoding="utf-8"))


if __name__ == "__main__":
    main()
