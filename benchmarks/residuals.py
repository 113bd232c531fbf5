"""How often the anatomy of errors finds something in healthy drives, and whether it finds what was planted.

    python -m benchmarks.residuals healthy --count 100 [--seed 0] [--rls]
    python -m benchmarks.residuals planted --count 10 [--seed 0] [--only "force by gear"]
    python -m benchmarks.residuals time [--seconds 600]

A healthy drive is of a car that is just what its file says, stepped as the model steps, whose sensors have white or coloured
noise. Car, track, style, length and noise are drawn by the seed. Planted are patterns of a size drawn evenly in its logarithm
from barely to clearly visible, in a drive of the same kind.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import stats
from scipy.signal import lfilter

import dynssm_ros
from benchmarks.page import table
from dynssm_ros.arrays import Vector
from dynssm_ros.errors import DataWarning
from dynssm_ros.evaluation.residuals.patterns import Pattern
from dynssm_ros.signals.recording import Recording
from dynssm_ros.signals.signal_map import STATE_SIGNALS
from dynssm_ros.simulation.laps import SimulationError
from dynssm_ros.vehicle import load_vehicle
from dynssm_ros.vehicle.effects.step_errors import changed_above

ROOT = Path(__file__).parents[1]
_CARS = {  # tracks' scale, noise of v_x, v_y (m/s), omega (rad/s)
    "orca": (1.0, (0.005, 0.005, 0.02)),
    str(ROOT / "examples" / "racer_1_10.yaml"): (3.0, (0.01, 0.01, 0.02)),
    "av21": (140.0, (0.02, 0.02, 0.003)),
}
_TRACKS = ("club", "club_b")
_SECONDS = (60.0, 150.0)
_MEMORIES_S = (0.05, 0.2, 0.5)  # of coloured noise
_DELAY_ROWS = 2
_GEAR_SHARE = 0.15  # of the force, less in the upper gear, for size 1


@dataclass(frozen=True)
class Drive:
    """A simulated drive and the car of its vehicle file."""

    car: str
    recording: Recording
    noise: tuple[float, float, float]
    seed: int


def drive(seed: int, effects: dict[str, dict[str, float]] | None = None) -> Drive:
    """A drive whose car, track, style, length and noise are drawn by the seed."""
    rng = np.random.default_rng(seed)
    car = list(_CARS)[rng.integers(len(_CARS))]
    scale, noise = _CARS[car]
    size, memory = float(np.exp(rng.uniform(np.log(0.3), np.log(3.0)))), rng.choice([0.0, *_MEMORIES_S])
    noise = (size * noise[0], size * noise[1], size * noise[2])
    chosen = {
        "duration": float(rng.uniform(*_SECONDS)), "variation": float(rng.uniform(0.2, 0.9)), "scale": scale,
        "plant": "euler", "seed": seed, "effects": effects or {},
    }  # fmt: skip
    track = _TRACKS[rng.integers(len(_TRACKS))]
    for aggressiveness in (rng.uniform(0.6, 0.95), 0.6, 0.5):
        try:
            run = dynssm_ros.simulate(
                car, track, aggressiveness=float(aggressiveness), noise=(0.0, 0.0, 0.0) if memory else noise, **chosen
            )
        except SimulationError:
            continue
        log = dynssm_ros.recorded(run)
        return Drive(car, _coloured(log, noise, memory, rng) if memory else log, noise, seed)
    raise SimulationError(f"drive {seed} of {car} on {track}: off the road in three styles")


def _coloured(log: Recording, noise: tuple[float, float, float], memory: float, rng: np.random.Generator) -> Recording:
    """The recording with noise of first order in its states."""
    forget = float(np.exp(-log.T_s / memory))
    columns = dict(log.columns)
    for name, std in zip(STATE_SIGNALS, noise, strict=True):
        white = rng.normal(scale=std * np.sqrt(1.0 - forget**2), size=len(log))
        columns[name] = columns[name] + lfilter([1.0], [1.0, -forget], white)
    return replace(log, columns=columns)


def _changed(given: Drive, **columns: Vector) -> Drive:
    return replace(given, recording=replace(given.recording, columns=given.recording.columns | columns))


def _correction(given: Drive, size: float, rng: np.random.Generator) -> tuple[Drive, str]:
    """The estimate of v_y drifts and is pulled back once in a period."""
    log = given.recording
    rows = int(rng.integers(round(0.4 / log.T_s), round(1.6 / log.T_s)))
    at = np.arange(len(log)) / rows
    return _changed(given, v_y=log["v_y"] + 3.0 * size * given.noise[1] * (at - np.ceil(at))), f"{rows * log.T_s:g} s"


def _random_correction(given: Drive, size: float, rng: np.random.Generator) -> tuple[Drive, str]:
    """The estimate of v_y drifts to a random side in each period, and is pulled back."""
    log = given.recording
    rows = int(rng.integers(round(0.4 / log.T_s), round(1.6 / log.T_s)))
    number, row = np.divmod(np.arange(len(log)), rows)
    far = 3.0 * size * given.noise[1] * rng.standard_normal(number[-1] + 1)[number]
    return _changed(given, v_y=log["v_y"] + far * row / rows), f"{rows * log.T_s:g} s"


def _spikes(given: Drive, size: float, rng: np.random.Generator) -> tuple[Drive, str]:
    """Samples of omega that are far off."""
    omega = given.recording["omega"].copy()
    at = rng.choice(len(omega), 20, replace=False)
    omega[at] += rng.choice([-1.0, 1.0], 20) * 6.0 * size * given.noise[2]
    return _changed(given, omega=omega), "20"


def _delay(given: Drive, size: float, rng: np.random.Generator) -> tuple[Drive, str]:
    """The steering acts two samples later than is recorded."""
    log = given.recording
    ahead = {name: np.concatenate([log[name][_DELAY_ROWS:], np.repeat(log[name][-1:], _DELAY_ROWS)])
             for name in ("delta_fb", "delta_cmd")}  # fmt: skip
    return _changed(given, **ahead), f"{_DELAY_ROWS * log.T_s:g} s"


def _steps(given: Drive, size: float, rng: np.random.Generator) -> tuple[Drive, str]:
    """The steering is recorded in steps, while the car turns as without them."""
    log = given.recording
    step = 0.06 * size * float(np.ptp(log["delta_fb"]))
    applied = np.round((log["delta_fb"] + log["delta_cmd"]) / step) * step
    return _changed(given, delta_fb=applied, delta_cmd=np.zeros_like(applied)), f"{step:.3g} rad"


def _pushed(given: Drive, channel: str, force: Vector) -> Drive:
    """Adds to a state what a force (in its noise per step) would, forgotten within half a second as tyres do."""
    log = given.recording
    forget = float(np.exp(-log.T_s / 0.5))
    return _changed(given, **{channel: log[channel] + lfilter([1.0], [1.0, -forget], force)})


def _speed(given: Drive, size: float, rng: np.random.Generator) -> tuple[Drive, str]:
    """A force along the car that depends on its speed, as of a resistance that is not in the file."""
    v_x = given.recording["v_x"]
    low, high = np.percentile(v_x, [35, 65])
    return _pushed(given, "v_x", np.where((v_x > low) & (v_x < high), -size * given.noise[0], 0.0)), "resistance"


def _heading(given: Drive, size: float, rng: np.random.Generator) -> tuple[Drive, str]:
    """A force across the car that stays in the world's direction, as of wind."""
    theta = given.recording["theta"]
    return _pushed(given, "v_y", -size * given.noise[1] * np.sin(theta)), "wind"


def _wheel(given: Drive, size: float, rng: np.random.Generator) -> tuple[Drive, str]:
    """The speed sensor's ring is out of round: v_x errs with each turn of the wheels."""
    log = given.recording
    length = float(rng.uniform(0.5, 1.4)) * load_vehicle(given.car).constants.wheelbase
    turned = 2 * np.pi * np.cumsum(log["v_x"]) * log.T_s / length
    return _changed(given, v_x=log["v_x"] + size * given.noise[0] * np.sin(turned)), f"{length:.3g} m"


def _gears(given: Drive, size: float, rng: np.random.Generator) -> tuple[Drive, str]:
    """The drive force is less in the upper of two gears, of which a sensor tells."""
    up = float(np.percentile(given.recording["v_x"], rng.uniform(40, 60)))
    less = {"factor": 1.0 - _GEAR_SHARE * size, "up": up, "down": 0.93 * up}
    driven = drive(given.seed, {"gear_shift": less})
    return _changed(driven, gear=1.0 + changed_above(driven.recording["v_x"], up, 0.93 * up)), f"{up:.3g} m/s"


Plant = Callable[[Drive, float, np.random.Generator], tuple[Drive, str]]
PLANTS: dict[str, tuple[Plant, str, tuple[str, ...]]] = {  # what is planted, in which channel, kinds that name it
    "correction of v_y": (_correction, "v_y", ("period", "echo", "period_of_size", "period_of_spikes")),
    "correction of random sign": (_random_correction, "v_y", ("period", "echo", "period_of_size", "period_of_spikes")),
    "spikes of omega": (_spikes, "omega", ("spikes",)),
    "late steering": (_delay, "", ("steering_delay",)),
    "steering in steps": (_steps, "", ("quantised",)),
    "resistance by speed": (_speed, "v_x", ("speed", "speed_and_pedal", "speed_and_bend")),
    "force by heading": (_heading, "v_y", ("heading", "place_on_the_lap")),
    "wheels out of round": (_wheel, "v_x", ("wheel_synchronous",)),
    "force by gear": (_gears, "v_x", ("gear", "gear_and_pedal")),
}


def patterns_of(given: Drive, rls: bool = False, learner: bool = True) -> list[Pattern]:
    """What the anatomy of a drive's errors says, of the physics alone or also of ``rls``."""
    found = dynssm_ros.residuals(given.recording, given.car, () if rls else ("single_track",), learner=learner)
    return [pattern for model in found.models.values() for pattern in model.patterns]


def healthy(seed: int, count: int, rls: bool) -> str:
    """Counts drives in which anything is found."""
    rows, done, wrong = [], 0, 0
    for k in range(seed, seed + count):
        try:
            given = drive(k)
        except SimulationError:
            continue
        found = patterns_of(given, rls)
        done, wrong = done + 1, wrong + bool(found)
        rows += [[str(k), Path(given.car).stem, each.channel, each.kind, f"{100 * each.share:.1f} %"] for each in found]
        print(f"{done} healthy drives, {wrong} with a pattern", flush=True)
    low, high = _interval(wrong, done)
    head = f"{wrong} of {done} drives with a pattern: {100 * wrong / done:.1f} % (95 %: {low:.1f} to {high:.1f} %)\n"
    return head + (table(["seed", "car", "channel", "pattern", "share"], rows) if rows else "")


def planted(seed: int, count: int, only: Sequence[str] = ()) -> str:
    """Counts plants that are found, and for how many of them the largest pattern of the channel is the right one."""
    rows = []
    for name, (plant, channel, kinds) in PLANTS.items():
        if only and name not in only:
            continue
        tally: dict[str, list[tuple[bool, bool]]] = {"barely": [], "clearly": []}
        for k in range(seed, seed + count):
            rng = np.random.default_rng([k, len(name)])
            size = float(np.exp(rng.uniform(np.log(0.3), np.log(3.0))))
            try:
                given, _ = plant(drive(k), size, rng)
            except SimulationError:
                continue
            found = patterns_of(given, learner=False)
            named = any(each.kind in kinds and channel in ("", each.channel) for each in found)
            of_channel = [each for each in found if channel in ("", each.channel)]
            tally["barely" if size < 1.0 else "clearly"].append(
                (named, bool(of_channel) and of_channel[0].kind in kinds)
            )
        cells = [
            f"{sum(n for n, _ in each)} of {len(each)} ({sum(f for _, f in each)} first)" for each in tally.values()
        ]
        rows.append([name, *cells])
        print(rows[-1], flush=True)
    return table(["planted", "size 0.3 to 1", "size 1 to 3"], rows)


def times(seconds: float) -> str:
    """Processor time of the anatomy of a simulated drive at 50 Hz, by what it is asked for."""
    scale, noise = _CARS["orca"]
    log = dynssm_ros.recorded(
        dynssm_ros.simulate("orca", "club_b", duration=seconds, scale=scale, noise=noise, plant="euler", seed=3)
    )
    rows = []
    for name, models, learner in (
        ("physics and rls, the command's first call", (), True),
        ("physics and rls", (), True),
        ("physics and rls, without trees", (), False),
        ("physics", ("single_track",), True),
        ("physics, without trees", ("single_track",), False),
    ):
        start = time.process_time()
        dynssm_ros.residuals(log, "orca", models, learner=learner)
        rows.append([name, f"{time.process_time() - start:.1f} s"])
        print(rows[-1], flush=True)
    return f"{len(log)} rows\n" + table(["asked for", "processor time"], rows)


def _interval(wrong: int, done: int) -> tuple[float, float]:
    """Clopper and Pearson's 95 % interval of a share, in percent."""
    low = stats.beta.ppf(0.025, wrong, done - wrong + 1) if wrong else 0.0
    high = stats.beta.ppf(0.975, wrong + 1, done - wrong) if wrong < done else 1.0
    return 100 * float(low), 100 * float(high)


def main() -> None:
    """Measures and prints a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("what", choices=("healthy", "planted", "time"))
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--rls", action="store_true", help="also of rls, which takes longer")
    parser.add_argument(
        "--only", action="append", default=[], choices=list(PLANTS), help="of the plants; repeat for more"
    )
    parser.add_argument("--seconds", type=float, default=600.0, help="length of the drive that is timed (s)")
    given = parser.parse_args()
    warnings.simplefilter("ignore", DataWarning)
    if given.what == "healthy":
        print(healthy(given.seed, given.count, given.rls))
    elif given.what == "planted":
        print(planted(given.seed, given.count, given.only))
    else:
        print(times(given.seconds))


if __name__ == "__main__":
    main()
