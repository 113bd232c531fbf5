"""Cases with a hidden cause: simulated laps whose car has effects that the vehicle file does not know.

In every case the nominal values of the file are off by about 2 %, the sensors are noisy, the driver differs, and the
plant integrates finely or has four wheels. ``python -m dynssm_ros.diagnosis.battery --out DIR`` runs them all and draws
the confusion matrix.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import joblib
import numpy as np

from dynssm_ros.diagnosis.diagnose import Cause, diagnose
from dynssm_ros.diagnosis.figures import confusion
from dynssm_ros.errors import UserError
from dynssm_ros.files import replacing, write_json
from dynssm_ros.signals.recording import Recording, RecordingInfo
from dynssm_ros.simulation.driver import Style
from dynssm_ros.simulation.laps import SimulationError, simulate
from dynssm_ros.simulation.plant import PlantKind
from dynssm_ros.simulation.tracks import load_track
from dynssm_ros.vehicle import COEFFICIENTS, Vehicle, load_vehicle
from dynssm_ros.vehicle.effects import EFFECTS

Hidden = dict[str, dict[str, float]]

SIZES: dict[str, dict[str, tuple[float, float]]] = {
    "steering_offset": {"offset": (0.004, 0.02)},
    "steering_gain": {"factor": (0.05, 0.2)},
    "steering_lag": {"time_constant": (0.04, 0.2)},
    "throttle_lag": {"time_constant": (0.1, 0.4)},
    "drag": {"coefficient": (0.15, 0.6)},
    "rolling_resistance": {"coefficient": (0.01, 0.04)},
    "drive_gain": {"factor": (0.08, 0.25)},
    "mass": {"factor": (0.06, 0.2)},
    "yaw_inertia": {"factor": (0.15, 0.5)},
    "front_grip": {"factor": (0.08, 0.25)},
    "rear_grip": {"factor": (0.08, 0.2)},
    "downforce": {"coefficient": (0.5, 2.0)},
    "load_transfer": {"factor": (0.7, 2.0)},
    "tire_relaxation": {"length": (0.4, 1.2)},
    "combined_slip": {"strength": (0.5, 1.0)},
    "road_bank": {"angle": (0.03, 0.1)},
    "road_grade": {"angle": (0.012, 0.05)},
    "crosswind": {"speed": (5.0, 12.0)},
    "grip_drift": {"rate": (0.0008, 0.002)},
    "grip_patch": {"factor": (0.15, 0.4)},
    "locked_differential": {"stiffness": (6.0, 30.0)},
    "odometry_lever_arm": {"x": (0.3, 2.0)},
    "odometry_misalignment": {"angle": (0.01, 0.04)},
    "odometry_delay": {"delay": (0.04, 0.16)},
    "yaw_rate_bias": {"bias": (0.005, 0.03)},
    "yaw_rate_lag": {"time_constant": (0.06, 0.25)},
}
"""How far each effect is off neutral, from just noticeable to large, in the units of its parameters."""

NOISE = (0.02, 0.02, 0.003)  # m/s, m/s, rad/s: a good odometry
OFF = 0.02  # of the nominal values
_KNOWN = 0.02  # how well the vehicle file says that they are known
_SHIFTS = {"S_hf": 0.0007, "S_hr": 0.0007, "S_vf": 40.0, "S_vr": 40.0}  # rad, N: the same for values around 0
_ONE_WAY = {"rear_grip": -1.0, "grip_drift": -1.0, "grip_patch": -1.0, "load_transfer": 1.0}  # a car that can be driven
_TRIES = 6


@dataclass(frozen=True)
class Case:
    """A hidden cause.

    Attributes:
        hidden: effects of the simulated car, by name and parameter.
        seed: of everything random.
        plant: how the car was simulated.
        duration: of the recording (s).
    """

    hidden: Hidden
    seed: int
    plant: PlantKind = "rk4"
    duration: float = 120.0

    @property
    def name(self) -> str:
        """For humans."""
        return f"{'+'.join(self.hidden) or 'none'}/{self.plant}/{self.seed}"


def size(effect: str, rng: np.random.Generator) -> dict[str, float]:
    """Random parameters of an effect, between just noticeable and large."""
    ((name, (low, high)),) = SIZES[effect].items()
    amount = float(np.exp(rng.uniform(np.log(low), np.log(high))))
    if effect == "crosswind":
        direction = float(rng.uniform(0, 2 * np.pi))
        return {"x": amount * float(np.cos(direction)), "y": amount * float(np.sin(direction))}
    about = EFFECTS[effect].PARAMETERS[name]
    either = about.lower < about.neutral and effect not in ("downforce", "rolling_resistance", "drag")
    sign = _ONE_WAY.get(effect, float(rng.choice([-1.0, 1.0])) if either else 1.0)
    values = {name: about.neutral + sign * amount}
    if effect == "grip_patch":
        values |= {"centre": float(rng.uniform(0.1, 0.9)), "length": float(rng.uniform(0.12, 0.3))}
    return values


def cases(seed: int, count: int, effects: Sequence[str] = tuple(EFFECTS)) -> Iterator[Case]:
    """``count`` cases: every effect in turn, with none and with two in between."""
    rng = np.random.default_rng(seed)
    for k in range(count):
        plant: PlantKind = "double_track" if k % 8 == 5 else "rk4"
        kind = k % 10
        if kind == 9:
            yield Case({}, seed + k, "rk4")
        elif kind == 4:
            pair = rng.choice(len(effects), 2, replace=False)
            yield Case({effects[i]: size(effects[i], rng) for i in pair}, seed + k, "rk4")
        else:
            name = effects[(k - k // 5) % len(effects)]
            yield Case({name: size(name, rng)}, seed + k, plant)


def record(case: Case, vehicle: str = "av21", track: str = "road_course") -> tuple[Recording, Vehicle]:
    """Drives a case: the recording, and the vehicle file that does not know what is hidden.

    Raises:
        SimulationError: the car cannot be driven with what is hidden, however gently.
    """
    nominal = load_vehicle(vehicle)
    rng = np.random.default_rng([case.seed, 7])
    true = nominal
    for name, values in case.hidden.items():
        true = true.with_effect(name, values)
    aggressiveness, variation = float(rng.uniform(0.6, 0.85)), float(rng.uniform(0.4, 0.9))
    noise = tuple(std * float(rng.uniform(0.5, 1.5)) for std in NOISE)
    for attempt in range(_TRIES):
        style = Style(aggressiveness * 0.9**attempt, variation)
        try:
            run = simulate(
                true, load_track(track), duration=case.duration, plant=case.plant, seed=case.seed, style=style,
                noise=(noise[0], noise[1], noise[2]),
            )  # fmt: skip
            break
        except SimulationError:
            if attempt == _TRIES - 1:
                raise
    columns = dict(
        zip(
            ("v_x", "v_y", "omega", "r_fb", "delta_fb", "r_cmd", "delta_cmd", "x", "y", "theta"),
            (*run.measured.T, *run.feedback.T, *(run.command - run.feedback).T, *run.pose.T),
            strict=True,
        )
    )
    info = RecordingInfo(sampling_time=nominal.sampling_time, commands="topics", source=(case.name,))
    return Recording(info, run.time, np.zeros(len(run.time), dtype=np.int32), columns), off(nominal, rng)


def off(vehicle: Vehicle, rng: np.random.Generator) -> Vehicle:
    """The vehicle file of somebody who knows the nominal values to about 2 %."""
    spread = np.array([_SHIFTS.get(c, _KNOWN * abs(v)) for c, v in zip(COEFFICIENTS, vehicle.nominal, strict=True)])
    wrong = vehicle.nominal + rng.standard_normal(len(spread)) * spread * OFF / _KNOWN
    return vehicle.with_nominal(np.clip(wrong, vehicle.lower, vehicle.upper), spread)


@dataclass(frozen=True)
class Outcome:
    """What became of a case.

    Attributes:
        case: its name.
        hidden: effects that were hidden.
        named: effects that were named, the strongest first.
        first: whether the first one named, or an alternative to it, was hidden; without effects, whether none was named.
        all: whether each hidden effect was named, or is an alternative to one that was.
        sized: whether the parameters of those named are within 15 % or two standard deviations; ``None`` if none was
            found.
    """

    case: str
    hidden: tuple[str, ...]
    named: tuple[str, ...]
    first: bool
    all: bool
    sized: bool | None


def judge(case: Case, causes: Sequence[Cause]) -> Outcome:
    """Compares what was found with what was hidden."""
    hidden = set(case.hidden)
    reach = [{cause.effect, *cause.alternatives} for cause in causes]
    first = bool(reach and reach[0] & hidden) if hidden else not causes
    complete = all(any(name in names for names in reach) for name in hidden) if hidden else not causes
    sized = [_right_size(cause, case.hidden[cause.effect]) for cause in causes if cause.effect in hidden]
    named = tuple(cause.effect for cause in causes)
    return Outcome(case.name, tuple(case.hidden), named, first, complete, all(sized) if sized else None)


def _right_size(cause: Cause, true: dict[str, float]) -> bool:
    """Whether each parameter is within 15 % of what was hidden, or two standard deviations."""
    for name, value in true.items():
        about = EFFECTS[cause.effect].PARAMETERS[name]
        if about.shape:
            continue
        room = max(0.15 * abs(value - about.neutral), 2 * cause.std.get(name, 0.0))
        if abs(cause.values.get(name, about.neutral) - value) > room:
            return False
    return True


def run_case(case: Case, vehicle: str = "av21", track: str = "road_course") -> Outcome | None:
    """Drives and diagnoses a case; ``None`` if its car cannot be driven."""
    try:
        recording, nominal = record(case, vehicle, track)
    except SimulationError:
        return None
    return judge(case, diagnose(recording, nominal, line=load_track(track).centre).causes)


def rates(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Shares of the cases that came out right."""
    one = [o for o in outcomes if len(o.hidden) == 1]
    two = [o for o in outcomes if len(o.hidden) == 2]
    none = [o for o in outcomes if not o.hidden]
    sized = [o for o in outcomes if o.sized is not None]
    return {
        "cases": len(outcomes),
        "named_first": {"of": len(one), "share": _share([o.first for o in one])},
        "both_found": {"of": len(two), "share": _share([o.all for o in two])},
        "false_alarms": {"of": len(none), "share": _share([not o.first for o in none])},
        "right_size": {"of": len(sized), "share": _share([bool(o.sized) for o in sized])},
    }


def _share(right: Sequence[bool]) -> float | None:
    return sum(right) / len(right) if right else None


def matrix(outcomes: Sequence[Outcome]) -> tuple[list[str], list[str], np.ndarray[Any, np.dtype[np.intp]]]:
    """Cases of one effect or none, by what was hidden and what was named first."""
    labels = [*EFFECTS, "none"]
    count = np.zeros((len(labels), len(labels)), dtype=np.intp)
    for outcome in outcomes:
        if len(outcome.hidden) < 2:
            hidden = outcome.hidden[0] if outcome.hidden else "none"
            named = outcome.named[0] if outcome.named else "none"
            count[labels.index(hidden), labels.index(hidden if outcome.first else named)] += 1
    return labels, labels, count


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the battery; writes ``battery.json`` and ``confusion.svg``."""
    parser = argparse.ArgumentParser(prog="python -m dynssm_ros.diagnosis.battery", description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder for battery.json and confusion.svg")
    parser.add_argument("--count", type=int, default=130, help="number of cases")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    options = parser.parse_args(arguments)
    ran = joblib.Parallel(n_jobs=options.jobs, verbose=5)(
        joblib.delayed(run_case)(case) for case in cases(options.seed, options.count)
    )
    outcomes = [outcome for outcome in ran if outcome is not None]
    if not outcomes:
        raise UserError(f"--count {options.count}: no case could be driven")
    summary = rates(outcomes)
    write_json(options.out / "battery.json", summary | {"outcomes": [asdict(outcome) for outcome in outcomes]})
    with replacing(options.out / "confusion.svg") as aside:
        confusion(*matrix(outcomes)).savefig(aside, format="svg")
    for name, value in summary.items():
        print(f"{name}: {value}")


if __name__ == "__main__":
    main()
