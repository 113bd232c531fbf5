"""Cases with a hidden cause: simulated laps whose car has effects that the vehicle file does not know.

In every case the nominal values of the file are off by about 2 %, the sensors are noisy, driver and track differ, and the
plant integrates in steps of 1 ms or has four wheels. ``python -m dynssm_ros.diagnosis.battery --out DIR`` runs them all,
continues after a kill, and writes the rates, the confusion matrix and a page that shows both.

Sizes. An effect is just noticeable where its estimate stands seven standard deviations from neutral on the reference
drive: 90 s of the road course at 25 Hz in moderate style, the noise of ``NOISE``, and nominal values free as far as the
file says that they are known. Twice the log-likelihood then falls by 49. Sizes are drawn evenly in their logarithm from
there (rounded) to what a car shows that is badly set up and can still be driven. With a gentler driver or more noise the
least of them are harder than that.
"""

from __future__ import annotations

import argparse
import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import joblib
import numpy as np
import numpy.typing as npt
from scipy.stats import binomtest

from dynssm_ros.diagnosis.diagnose import Cause, diagnose
from dynssm_ros.diagnosis.figures import confusion
from dynssm_ros.errors import UserError
from dynssm_ros.files import replacing, write_json
from dynssm_ros.signals.recording import Recording, RecordingInfo
from dynssm_ros.simulation.driver import Style
from dynssm_ros.simulation.laps import SimulationError, simulate
from dynssm_ros.simulation.plant import PlantKind
from dynssm_ros.simulation.tracks import Track, load_track
from dynssm_ros.vehicle import COEFFICIENTS, Vehicle, load_vehicle
from dynssm_ros.vehicle.effects import EFFECTS

Hidden = dict[str, dict[str, float]]

SIZES: dict[str, dict[str, tuple[float, float]]] = {
    "steering_offset": {"offset": (0.004, 0.02)},
    "steering_gain": {"factor": (0.015, 0.2)},
    "steering_lag": {"time_constant": (0.015, 0.2)},
    "throttle_lag": {"time_constant": (0.012, 0.4)},
    "drag": {"coefficient": (0.12, 0.6)},
    "rolling_resistance": {"coefficient": (0.005, 0.04)},
    "drive_gain": {"factor": (0.12, 0.25)},
    "mass": {"factor": (0.11, 0.2)},
    "yaw_inertia": {"factor": (0.2, 0.5)},
    "front_grip": {"factor": (0.1, 0.25)},
    "rear_grip": {"factor": (0.06, 0.2)},
    "downforce": {"coefficient": (0.25, 2.0)},
    "load_transfer": {"factor": (0.12, 2.0)},
    "tire_relaxation": {"length": (0.35, 1.2)},
    "combined_slip": {"strength": (0.35, 1.0)},
    "road_bank": {"angle": (0.015, 0.1)},
    "road_grade": {"angle": (0.005, 0.05)},
    "crosswind": {"speed": (0.7, 12.0)},
    "grip_drift": {"rate": (0.0003, 0.002)},
    "grip_patch": {"factor": (0.035, 0.4)},
    "locked_differential": {"stiffness": (2.0, 30.0)},
    "odometry_lever_arm": {"x": (0.08, 2.0)},
    "odometry_misalignment": {"angle": (0.003, 0.04)},
    "odometry_delay": {"delay": (0.008, 0.16)},
    "yaw_rate_bias": {"bias": (0.003, 0.03)},
    "yaw_rate_lag": {"time_constant": (0.013, 0.25)},
}
"""How far each effect is off neutral, from just noticeable to large, in the units of its parameters."""

NOISE = (0.02, 0.02, 0.003)  # m/s, m/s, rad/s: a good odometry
OFF = 0.02  # of the nominal values
TRACKS = {"road_course": 1.0, "club": 140.0, "club_b": 110.0}
"""Tracks with the factor by which they are enlarged for a full-size car; the clubs are tracks for 1:43 cars."""
GOALS = {"named_first": 0.95, "right_size": 0.95, "both_found": 0.85, "false_alarms": 0.05}
_IN_WORDS = {
    "named_first": "the hidden effect, or an alternative reported with it, is named first",
    "right_size": "parameters of what was found are within 15 % or two standard deviations",
    "both_found": "both effects of a pair are found",
    "false_alarms": "something is named where nothing is hidden",
    "more_named": "more is named than the one effect that is hidden",
}
_RATES = (0.04, 0.04, 0.04, 0.02)  # s: sampling times, drawn with equal chance
_KNOWN = 0.02  # how well the vehicle file says that they are known
_SHIFTS = {"S_hf": 0.0007, "S_hr": 0.0007, "S_vf": 40.0, "S_vr": 40.0}  # rad, N: the same for values around 0
_ONE_WAY = {"rear_grip": -1.0, "grip_drift": -1.0, "grip_patch": -1.0, "load_transfer": 1.0}  # a car that can be driven
_TRIES = 6
_ROUND = 13  # cases, of which two have a pair of effects and two none
_PAIRS, _NONE = (4, 10), (6, 12)
_DPI = 130
_PAGE, _FIGURE = "diagnose_battery.md", "diagnose_battery_confusion.png"


@dataclass(frozen=True)
class Case:
    """A hidden cause.

    Attributes:
        hidden: effects of the simulated car, by name and parameter.
        seed: of everything random.
        plant: how the car was simulated.
        duration: of the recording (s).
        track: name of the track.
        sampling_time: of the recording (s).
    """

    hidden: Hidden
    seed: int
    plant: PlantKind = "rk4"
    duration: float = 120.0
    track: str = "road_course"
    sampling_time: float = 0.04

    @property
    def name(self) -> str:
        """For humans."""
        where = f"{self.plant}/{self.track}/{1 / self.sampling_time:.0f}Hz"
        return f"{'+'.join(self.hidden) or 'none'}/{where}/{self.seed}"

    @property
    def road(self) -> Track:
        """The track as it is driven."""
        return load_track(self.track).scaled(TRACKS[self.track])


def size(effect: str, rng: np.random.Generator) -> dict[str, float]:
    """Random parameters of an effect, between just noticeable and large."""
    ((low, high),) = SIZES[effect].values()
    return sized(effect, float(np.exp(rng.uniform(np.log(low), np.log(high)))), rng)


def sized(effect: str, amount: float, rng: np.random.Generator) -> dict[str, float]:
    """Parameters of an effect that is ``amount`` off neutral, to a random side, direction and place."""
    (name,) = SIZES[effect]
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
    """``count`` cases: every effect in turn, with pairs and with none in between; every fourth on four wheels."""
    rng = np.random.default_rng(seed)
    turn = 0
    for k in range(count):
        kind = k % _ROUND
        if kind in _NONE:
            names: list[str] = []
        elif kind in _PAIRS:
            names = [effects[i] for i in rng.choice(len(effects), 2, replace=False)]
        else:
            names, turn = [effects[turn % len(effects)]], turn + 1
        yield Case(
            {name: size(name, rng) for name in names},
            seed + k,
            "double_track" if k % 4 == 1 else "rk4",
            track=str(rng.choice(list(TRACKS))),
            sampling_time=float(rng.choice(_RATES)),
        )


def record(case: Case) -> tuple[Recording, Vehicle]:
    """Drives a case: the recording, and the vehicle file that does not know what is hidden.

    Raises:
        SimulationError: the car cannot be driven with what is hidden, however gently.
    """
    true, nominal = _cars(case)
    rng = np.random.default_rng([case.seed, 7])
    aggressiveness, variation = float(rng.uniform(0.6, 0.85)), float(rng.uniform(0.4, 0.9))
    noise = [std * float(rng.uniform(0.5, 1.5)) for std in NOISE]
    for attempt in range(_TRIES):
        style = Style(aggressiveness * 0.9**attempt, variation)
        try:
            run = simulate(
                true, case.road, duration=case.duration, plant=case.plant, seed=case.seed, style=style,
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
    info = RecordingInfo(sampling_time=case.sampling_time, commands="topics", source=(case.name,))
    return Recording(info, run.time, np.zeros(len(run.time), dtype=np.int32), columns), nominal


def _cars(case: Case) -> tuple[Vehicle, Vehicle]:
    """The car that is driven, and the vehicle file."""
    known = load_vehicle("av21").model_copy(update={"sampling_time": case.sampling_time})
    true = known
    for name, values in case.hidden.items():
        true = true.with_effect(name, values)
    return true, off(known, np.random.default_rng([case.seed, 8]))


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
        values: what was hidden, with its parameters.
        found: what was named, with its parameters.
        alternatives: what is reported as explaining the data as well, by what was named.
    """

    case: str
    hidden: tuple[str, ...]
    named: tuple[str, ...]
    first: bool
    all: bool
    sized: bool | None
    values: Hidden = field(default_factory=dict)
    found: Hidden = field(default_factory=dict)
    alternatives: dict[str, tuple[str, ...]] = field(default_factory=dict)

    @property
    def right(self) -> bool:
        """Whether nothing is missing that counts."""
        return self.all if len(self.hidden) > 1 else self.first


def judge(case: Case, causes: Sequence[Cause]) -> Outcome:
    """Compares what was found with what was hidden."""
    hidden = set(case.hidden)
    reach = [{cause.effect, *cause.alternatives} for cause in causes]
    first = bool(reach and reach[0] & hidden) if hidden else not causes
    complete = all(any(name in names for names in reach) for name in hidden) if hidden else not causes
    right = [_right_size(cause, case.hidden[cause.effect]) for cause in causes if cause.effect in hidden]
    return Outcome(
        case.name,
        tuple(case.hidden),
        tuple(cause.effect for cause in causes),
        first,
        complete,
        all(right) if right else None,
        case.hidden,
        {cause.effect: dict(cause.values) for cause in causes},
        {cause.effect: tuple(cause.alternatives) for cause in causes},
    )


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


def run_case(case: Case, folder: Path) -> Outcome | None:
    """Drives and diagnoses a case, as far as ``folder`` has not its drive or its outcome; ``None``: cannot be driven."""
    name = case.name.replace("/", "_")
    done = folder / f"outcomes-{_digest('diagnosis', 'evaluation', 'simulation', 'vehicle')}" / f"{name}.json"
    if done.exists():
        content = json.loads(done.read_text(encoding="utf-8"))["outcome"]
        return None if content is None else _outcome(content)
    drive = folder / f"drives-{_digest('simulation', 'vehicle')}" / f"{name}.parquet"
    try:
        if not drive.exists():
            record(case)[0].save(drive)
        outcome = judge(case, diagnose(Recording.load(drive), _cars(case)[1], line=case.road.centre).causes)
    except SimulationError:
        outcome = None
    write_json(done, {"outcome": None if outcome is None else asdict(outcome)})
    return outcome


def _outcome(content: dict[str, Any]) -> Outcome:
    lists = {key: tuple(content[key]) for key in ("hidden", "named")}
    alternatives = {name: tuple(others) for name, others in content["alternatives"].items()}
    return Outcome(**content | lists | {"alternatives": alternatives})


@cache
def _digest(*rooms: str) -> str:
    """Names the code of some rooms of the package, so that what other code made is made anew."""
    total = hashlib.sha256()
    for room in rooms:
        for file in sorted((Path(__file__).parents[1] / room).rglob("*.py")):
            total.update(file.read_bytes())
    return total.hexdigest()[:10]


def rates(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Shares of the cases that came out right, with their 95 % intervals (Wilson)."""
    one = [o for o in outcomes if len(o.hidden) == 1]
    two = [o for o in outcomes if len(o.hidden) == 2]
    none = [o for o in outcomes if not o.hidden]
    return {
        "cases": len(outcomes),
        "named_first": _share([o.first for o in one]),
        "right_size": _share([o.sized for o in outcomes if o.sized is not None]),
        "both_found": _share([o.all for o in two]),
        "false_alarms": _share([not o.first for o in none]),
        "more_named": _share([len(o.named) > 1 for o in one]),
    }


def _share(right: Sequence[bool]) -> dict[str, Any]:
    count, of = sum(right), len(right)
    if not of:
        return {"of": 0, "share": None, "interval_95": None}
    interval = binomtest(count, of).proportion_ci(method="wilson")
    return {"of": of, "share": count / of, "interval_95": [float(interval.low), float(interval.high)]}


def matrix(outcomes: Sequence[Outcome]) -> tuple[list[str], list[str], npt.NDArray[np.intp]]:
    """Cases of one effect or none, by what was hidden and what was named first."""
    labels = [*EFFECTS, "none"]
    count = np.zeros((len(labels), len(labels)), dtype=np.intp)
    for outcome in outcomes:
        if len(outcome.hidden) < 2:
            hidden = outcome.hidden[0] if outcome.hidden else "none"
            named = outcome.named[0] if outcome.named else "none"
            count[labels.index(hidden), labels.index(hidden if outcome.first else named)] += 1
    return labels, labels, count


def page(outcomes: Sequence[Outcome], seed: int, undriven: int) -> str:
    """The results as Markdown.

    Args:
        outcomes: of the cases.
        seed: of the first case; the others' count on from it.
        undriven: cases whose car could not be driven.
    """
    return "\n".join(_lines(outcomes, seed, undriven)) + "\n"


def _lines(outcomes: Sequence[Outcome], seed: int, undriven: int) -> Iterator[str]:
    yield "# Hidden causes"
    yield ""
    yield (
        f"Made by `python -m dynssm_ros.diagnosis.battery`: {len(outcomes)} simulated drives with hidden effects, seeds "
        f"{seed} to {seed + len(outcomes) + undriven - 1}"
        + (f", without {undriven} whose car could not be driven" if undriven else "")
        + ". How they are drawn and what counts as just noticeable: the command's `--help`."
    )
    yield ""
    yield "| rate | cases | share | 95 % interval | goal |"
    yield "| --- | --- | --- | --- | --- |"
    for name, words in _IN_WORDS.items():
        rate = rates(outcomes)[name]
        if rate["of"]:
            low, high = rate["interval_95"]
            goal = "" if name not in GOALS else f"{'<=' if name == 'false_alarms' else '>='} {100 * GOALS[name]:.0f} %"
            yield (
                f"| {words} | {rate['of']} | {100 * rate['share']:.0f} % | {100 * low:.0f} to {100 * high:.0f} % | {goal} |"
            )
    yield ""
    yield f"![What was hidden and what was named first]({_FIGURE})"
    yield ""
    yield "Cases of one effect or none; an alternative that is reported counts as named."
    wrong = [o for o in outcomes if not o.right or o.sized is False]
    if wrong:
        yield ""
        yield "## What came out wrong"
        yield ""
        yield "| case | hidden | named |"
        yield "| --- | --- | --- |"
        for o in wrong:
            yield f"| `{o.case}` | {_with_values(o.values)} | {_with_values(o.found)} |"


def _with_values(effects: Hidden) -> str:
    return "; ".join(
        f"{name} " + ", ".join(f"{key} {value:.3g}" for key, value in values.items())
        for name, values in effects.items()
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the battery; writes the rates, the figure and the page."""
    parser = argparse.ArgumentParser(
        prog="python -m dynssm_ros.diagnosis.battery",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--out", type=Path, required=True, help="folder for drives, outcomes and battery.json")
    parser.add_argument("--page", type=Path, help=f"folder for {_PAGE} and its figure; --out if not given")
    parser.add_argument("--count", type=int, default=130, help="number of cases")
    parser.add_argument("--seed", type=int, default=0, help="of the first case")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    options = parser.parse_args(arguments)
    listed = list(cases(options.seed, options.count))
    running = joblib.Parallel(n_jobs=options.jobs, return_as="generator")(
        joblib.delayed(run_case)(case, options.out) for case in listed
    )
    outcomes: list[Outcome] = []
    for k, (case, outcome) in enumerate(zip(listed, running, strict=True), start=1):
        if outcome is None:
            words = "cannot be driven"
        else:
            outcomes.append(outcome)
            words = f"{', '.join(outcome.named) or 'none'}: {'right' if outcome.right else 'WRONG'}"
        print(f"[{k}/{len(listed)}] {case.name} -> {words}", flush=True)
    if not outcomes:
        raise UserError(f"--count {options.count}: no case could be driven")
    undriven = len(listed) - len(outcomes)
    about = {"seed": options.seed, "undriven": undriven, **rates(outcomes)}
    write_json(options.out / "battery.json", about | {"outcomes": [asdict(outcome) for outcome in outcomes]})
    folder = options.page or options.out
    with replacing(folder / _FIGURE) as aside:
        confusion(*matrix(outcomes)).savefig(aside, format="png", dpi=_DPI, metadata={"Software": None})
    with replacing(folder / _PAGE) as aside:
        aside.write_text(page(outcomes, options.seed, undriven), encoding="utf-8")
    for name, value in about.items():
        print(f"{name}: {value}")


if __name__ == "__main__":
    main()
