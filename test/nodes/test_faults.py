"""The fault matrix over DDS: a car drives laps, something breaks, and is mended again.

For each fault: what the diagnostics say, that nothing is predicted from what is wrong, and after how many good messages the
predictions are back.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from dynssm_ros.runtime.plausibility import ranges
from dynssm_ros.signals.recording import Recording
from dynssm_ros.vehicle import load_vehicle

pytestmark = [pytest.mark.live, pytest.mark.timeout(120)]

PERIOD = 20_000_000  # ns
MAX_AGE = 10  # periods
BEFORE = 30  # good periods
RECOVERED = 10  # good periods within which predictions must be back
H = 5
ORCA = ranges(load_vehicle("orca"))
POSSIBLE = ORCA | {"throttle": ORCA["throttle_feedback"], "steering": ORCA["steering_feedback"]}
Row = dict[str, float]
Send = Callable[[Any, Row], "int | None"]
"""Sends a spoilt period; returns the stamp that a prediction from it would have, which there must not be."""


@pytest.fixture(scope="module")
def laps(four_wheels: Path) -> list[Row]:
    drive = Recording.load(four_wheels)
    columns = {"v_x": "v_x", "v_y": "v_y", "omega": "omega", "throttle": "r_fb", "steering": "delta_fb"}
    return [{name: float(drive[column][k]) for name, column in columns.items()} for k in range(len(drive))]


def send(car: Any, row: Row, actuators_late: int = 0) -> int:
    """Sends a period, its actuators with stamps that are so late (ns); returns the stamp of its prediction."""
    car.stamp -= actuators_late
    car.actuators(throttle=row["throttle"], steering=row["steering"])
    car.stamp += actuators_late
    expected: int = car.odometry(row["v_x"], row["v_y"], row["omega"])
    car.stamp += PERIOD
    return expected


def changed(**factors: float) -> Send:
    """Signals times a factor; a message is known to be wrong where that is beyond what the car can do."""

    def sent(car: Any, row: Row) -> int | None:
        wrong = row | {name: factor * row[name] for name, factor in factors.items()}
        expected = send(car, wrong)
        return None if all(POSSIBLE[n].low <= wrong[n] <= POSSIBLE[n].high for n in factors) else expected

    return sent


def not_used(wrong: Send) -> Send:
    """Wrong actuators are left out: predictions go on with the last good ones for ``max_age``, and then no more."""
    count = [0]

    def sent(car: Any, row: Row) -> int | None:
        count[0] += 1
        expected = wrong(car, row)
        return expected if count[0] > MAX_AGE else None

    return sent


def still(wrong: Send) -> Send:
    """What is wrong cannot be told from one message: predictions go on until it is named."""

    def sent(car: Any, row: Row) -> None:
        wrong(car, row)
        car.answered(car.stamp, 0.05)  # of the message just sent the prediction has this stamp

    return sent


def moved(seconds: float) -> Send:
    """The odometry's stamp is off."""

    def sent(car: Any, row: Row) -> int:
        right, car.stamp = car.stamp, car.stamp + round(1e9 * seconds)
        expected = send(car, row)
        car.stamp = right + PERIOD
        return expected

    return sent


def alternating(seconds: float) -> Send:
    """Every other stamp is off."""
    away, turn = moved(seconds), [False]

    def sent(car: Any, row: Row) -> int | None:
        turn[0] = not turn[0]
        return away(car, row) if turn[0] else still(send)(car, row)

    return sent


def two_publishers(car: Any, row: Row) -> int:
    """Another source says that the car stands."""
    car.answered(send(car, row), 0.05)
    car.stamp -= PERIOD // 2
    expected: int = car.odometry(0.0, 0.0, 0.0)
    car.stamp += PERIOD // 2
    return expected


def repeated(car: Any, row: Row) -> None:
    """The same message again, after it was answered."""
    expected = car.stamp
    car.answered(send(car, row), 0.05)
    now, car.stamp = car.stamp, expected
    car.odometry(row["v_x"], row["v_y"], row["omega"])
    car.stamp = now


def without_actuators(car: Any, row: Row) -> int:
    expected: int = car.odometry(row["v_x"], row["v_y"], row["omega"])
    car.stamp += PERIOD
    return expected


def gap(car: Any, row: Row) -> int:
    """A second without anything."""
    car.stamp += 1_000_000_000
    return send(car, row)


@dataclass(frozen=True)
class Fault:
    name: str
    wrong: Send
    periods: int
    verdict: str
    """Empty: it is over before diagnostics are due."""
    recovered: int = RECOVERED
    """Good periods until there is a prediction, at most."""


BEYOND, NOT_FINITE = "a sample is beyond what the car can do", "a sample is not finite"
SWAPPED = 330  # periods: the wiring check compares six seconds, and says what it found three times
FAULTS = (
    Fault("speed 1e4 m/s", changed(v_x=1e4), 12, BEYOND),
    Fault("yaw rate in degrees per second", changed(omega=57.3), 40, BEYOND),
    Fault("steering in degrees", still(changed(steering=57.3)), 60, BEYOND),
    Fault("not a number", changed(v_y=float("nan")), 12, NOT_FINITE),
    Fault("infinite steering", not_used(changed(steering=float("inf"))), 40, "a signal is older than max_age"),
    Fault("the steering's sign", still(changed(steering=-1.0)), SWAPPED, "the steering's sign is swapped"),
    Fault("the lateral velocity's sign", still(changed(v_y=-1.0)), SWAPPED, "the lateral velocity's sign is swapped"),
    Fault("the yaw rate's sign", still(changed(omega=-1.0)), SWAPPED, "the yaw rate's sign is swapped"),
    Fault(
        "two sources that disagree", two_publishers, 30, "a sample is farther from the last one than the car can move"
    ),
    Fault("messages that come twice", repeated, 30, "a stamp repeats or is older than the newest"),
    Fault("every other stamp 10 s ahead", alternating(10.0), 40, "a stamp is far from the last ones"),
    Fault("actuators on another clock", lambda car, row: send(car, row, 3600 * 10**9), 30, "those of other topics"),
    Fault("no actuators", not_used(without_actuators), 40, "/vehicle/actuator_feedback: silent for"),
    Fault("a second without messages", gap, 1, "", H),
)
ALIKE = (  # faults with the verdict, or the way to it, of another one
    "yaw rate in degrees per second", "steering in degrees", "the lateral velocity's sign", "the yaw rate's sign",
    "infinite steering", "every other stamp 10 s ahead",
)  # fmt: skip


@pytest.mark.parametrize(
    "fault",
    [
        pytest.param(fault, id=fault.name.replace(" ", "_"), marks=pytest.mark.slow if fault.name in ALIKE else ())
        for fault in FAULTS
    ],
)
def test_a_fault_is_named_nothing_is_predicted_from_it_and_predictions_come_back(
    car: Any, laps: list[Row], fault: Fault
) -> None:
    rows = iter(laps)
    good = [send_and_wait(car, row) for row in take(rows, BEFORE)]
    assert all(good[-10:]), "it does not predict to begin with"
    said = len(car.run.diagnostics)

    def is_named() -> bool:
        return any(fault.verdict in words for _, words, _ in car.run.diagnostics[said:])

    bad = [fault.wrong(car, row) for row in take(rows, fault.periods)]
    assert not fault.verdict or car.collector.wait_for(is_named, 2.0), {
        words for _, words, _ in car.run.diagnostics[said:]
    }
    back = next((k for k, row in enumerate(take(rows, RECOVERED), 1) if send_and_wait(car, row)), None)
    assert back is not None, car.run.diagnostics[-1]
    assert back <= fault.recovered
    assert not {stamp for stamp in bad if stamp is not None} & set(car.run.predicted)


def take(rows: Iterator[Row], count: int) -> Iterator[Row]:
    """The next so many."""
    return (next(rows) for _ in range(count))


def send_and_wait(car: Any, row: Row) -> bool:
    """Sends a good period; whether it is answered."""
    answered: bool = car.answered(send(car, row), 0.5)
    return answered
