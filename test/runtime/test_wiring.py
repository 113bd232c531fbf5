"""Wrong wiring is named, and right wiring is not."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dynssm_ros.runtime.wiring import Wiring
from dynssm_ros.signals.recording import Recording
from dynssm_ros.vehicle import COEFFICIENTS, CarModel, State, load_vehicle

ORCA = load_vehicle("orca")
COLUMNS = {"v_x": [0], "v_y": [1], "omega": [2], "steering": [4, 6], "speed": [0, 1], "left": [1, 2]}


@pytest.fixture(scope="module")
def laps(four_wheels: Path) -> Recording:
    return Recording.load(four_wheels).select(slice(0, 1000))


def verdicts(laps: Recording, columns: Sequence[int] = (), factor: float = 1.0, vehicle=ORCA) -> set[str]:
    """What is said second after second."""
    rows = laps.matrix.copy()
    rows[:, list(columns)] *= factor
    wiring, said = Wiring(vehicle, laps.T_s), set()
    for k, (stamp, row) in enumerate(zip(laps.time.tolist(), rows, strict=True)):
        wiring.add(stamp, row)
        if k % 50 == 49:
            said.add(wiring.verdict())
    return said


def test_a_car_that_is_wired_well_is_not_accused(laps) -> None:
    assert verdicts(laps) == {""}


@pytest.mark.parametrize(
    ("what", "factor", "words"),
    [
        ("steering", -1.0, "the steering's sign is swapped"),
        ("omega", -1.0, "the yaw rate's sign is swapped"),
        ("v_y", -1.0, "the lateral velocity's sign is swapped"),
        ("left", -1.0, "left and right are swapped in lateral velocity and yaw rate"),
        ("steering", 180 / np.pi, "the steering is in degrees"),
        ("omega", 180 / np.pi, "the yaw rate is in degrees per second"),
        ("speed", 3.6, "the speed is in km/h"),
    ],
)
def test_what_is_wired_wrongly_is_named(laps, what, factor, words) -> None:
    assert verdicts(laps, COLUMNS[what], factor) == {"", words}


def test_a_wheelbase_that_is_far_off_is_named(laps) -> None:
    constants = ORCA.constants
    wrong = constants.model_copy(update={"l_f": 2.0 * constants.l_f, "l_r": 2.0 * constants.l_r})
    said = verdicts(laps, vehicle=ORCA.model_copy(update={"constants": wrong}))
    assert any("the wheelbase is not 0.124 m" in words for words in said)


def test_nothing_is_said_of_a_straight_or_after_a_gap(laps) -> None:
    wiring = Wiring(ORCA, 0.02)
    for k in range(400):
        wiring.add(k * 20_000_000, np.array([2.0, 0.0, 0.0, 0.2, 0.0, 0.0, 0.0]))
        assert wiring.verdict() == ""
    rows = laps.matrix * np.array([1, 1, 1, 1, -1, 1, -1])
    for k, row in enumerate(rows[:500]):
        wiring.add((k + 1000) * 20_000_000 * 3, row)  # each row after a gap
    assert wiring.verdict() == ""


def test_a_row_waits_for_one_step_of_some_suspicions(laps, monkeypatch: pytest.MonkeyPatch) -> None:
    stepped: list[int] = []

    def step(car: CarModel, state: State, *others: Any) -> Any:
        stepped.append(len(state.v_x))
        return plain(car, state, *others)

    plain = CarModel.step
    monkeypatch.setattr(CarModel, "step", step)
    wiring, most = Wiring(ORCA, laps.T_s), 0
    for stamp, row in zip(laps.time[:600].tolist(), laps.matrix, strict=False):
        wiring.add(stamp, row)
        wiring.verdict()
        assert len(stepped) <= 1
        assert sum(stepped) <= 12
        most += len(stepped)
        stepped.clear()
    assert most > 50


@pytest.mark.parametrize(("front", "rear"), [(1.0, 1.4), (1.4, 1.0), (1.4, 1.4), (0.7, 0.7)])
def test_other_tyres_are_no_wiring(laps, front: float, rear: float) -> None:
    theta = ORCA.nominal.copy()
    theta[COEFFICIENTS.index("D_f")] *= front
    theta[COEFFICIENTS.index("D_r")] *= rear
    others = ORCA.with_nominal(np.clip(theta, ORCA.lower, ORCA.upper))
    assert verdicts(laps, vehicle=others) == {""}
