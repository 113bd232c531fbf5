"""Predictions that are worse than none are told within a second."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from dynssm_ros.runtime.artifact import open_artifact
from dynssm_ros.runtime.health import Health, Level
from dynssm_ros.runtime.hindsight import Hindsight
from dynssm_ros.runtime.onnx_model import OnnxModel
from dynssm_ros.runtime.predictor import Prediction, Predictor
from dynssm_ros.signals.recording import Recording
from dynssm_ros.signals.signal_map import load_signal_map

T_S = 40_000_000  # ns
SCALE = (0.3, 0.1, 0.2)


def state(seconds: float) -> tuple[float, float, float]:
    """A car that turns to and fro."""
    return 20.0 + math.sin(seconds), 0.5 * math.sin(3 * seconds), 2.0 * math.sin(3 * seconds)


def driven(seconds: float, period: int, *, error: float, still: bool = False) -> Hindsight:
    """After a drive with odometry every ``period`` (ns), each prediction off by ``error`` usual increments."""
    hindsight = Hindsight(SCALE, 5.0)
    for stamp in range(0, round(seconds * 1e9), period):
        now, then = (state(0.0 if still else at / 1e9) for at in (stamp, stamp + T_S))
        hindsight.measured(stamp, now)
        hindsight.predicted(stamp + T_S, [value + error * s for value, s in zip(then, SCALE, strict=True)], now)
    return hindsight


@pytest.mark.parametrize("period", [T_S, T_S // 4, 30_000_000])
def test_the_ratio_is_that_of_the_errors(period: int) -> None:
    assert driven(3.0, period, error=0.5).verdict() == (Level.OK, "")
    level, words = driven(3.0, period, error=20.0).verdict()
    assert level is Level.ERROR
    assert words.startswith("predictions were off by 20 usual steps lately, the state before them by 0.")


def test_bad_predictions_are_told_after_a_second_and_forgotten_after_another() -> None:
    hindsight = driven(3.0, T_S, error=0.2)
    for k in range(55):
        stamp = 3_000_000_000 + k * T_S
        now, then = state(stamp / 1e9), state((stamp + T_S) / 1e9)
        hindsight.measured(stamp, now)
        hindsight.predicted(stamp + T_S, [50.0, *then[1:]] if k < 25 else then, now)
        if k == 25:
            assert hindsight.verdict()[0] is Level.ERROR
    assert hindsight.verdict()[0] is Level.OK


def test_small_errors_of_a_car_that_drives_evenly_are_none() -> None:
    """No prediction at all is exact there."""
    assert driven(3.0, T_S, error=0.9, still=True).verdict()[0] is Level.OK
    assert driven(3.0, T_S, error=1.1, still=True).verdict()[0] is Level.WARN


def test_without_enough_comparisons_nothing_is_said() -> None:
    assert driven(9 * T_S / 1e9, T_S, error=99.0).verdict()[0] is Level.OK


def test_of_a_car_that_stands_nothing_is_said() -> None:
    hindsight = Hindsight(SCALE, 5.0)
    for stamp in range(0, 3_000_000_000, T_S):
        hindsight.measured(stamp, (0.0, 0.0, 0.0))
        hindsight.predicted(stamp + T_S, (9.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    assert hindsight.verdict()[0] is Level.OK


BEGINS, ENDS, SECOND = 300, 420, 50  # rows of 20 ms
Row = dict[str, float]


@pytest.fixture(scope="module")
def laps(four_wheels: Path) -> Recording:
    return Recording.load(four_wheels).select(slice(0, 451))


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        (lambda row, laps, k: {}, False),
        (lambda row, laps, k: {"delta_fb": -row["delta_fb"], "delta_cmd": -row["delta_cmd"]}, True),
        (lambda row, laps, k: {"omega": 0.5 * row["omega"]}, True),
        (lambda row, laps, k: {"v_x": 3.6 * row["v_x"]}, True),
        (lambda row, laps, k: {name: laps.columns[name][k - 15] for name in ("v_x", "v_y", "omega")}, True),
        (lambda row, laps, k: {"r_fb": laps.columns["r_fb"][BEGINS], "r_cmd": 0.0}, False),
        (lambda row, laps, k: {"delta_fb": laps.columns["delta_fb"][BEGINS], "delta_cmd": 0.0}, True),
    ],
    ids=["nothing", "steering sign", "yaw rate halved", "km/h", "0.3 s late", "throttle frozen", "steering frozen"],
)
def test_the_verdict_is_not_ok_while_predictions_are_worse_than_none_for_a_second(
    small_model: Path, laps: Recording, wrong: Callable[[Row, Recording, int], Row], told: bool
) -> None:
    """As of the middle of a drive something is wrong; what is predicted is compared with the car as it truly is."""
    predictor, health = (
        Predictor(OnnxModel(open_artifact(small_model)), load_signal_map("default")),
        Health(("/o",), 9.9),
    )
    scale, errors, alarms = predictor.model.card.normalisation.increment_scale, [], []
    states = np.stack([laps.columns[name] for name in ("v_x", "v_y", "omega")], axis=1)
    for k in range(ENDS):
        row = {name: float(values[k]) for name, values in laps.columns.items()}
        row |= wrong(row, laps, k) if k >= BEGINS else {}
        stamp = 10**12 + k * 20_000_000
        health.arrived("/o", k / 50)
        actuators = {"throttle": row["r_fb"], "steering": row["delta_fb"]}
        predictor.observe(stamp, {f"{name}_feedback": value for name, value in actuators.items()})
        commands = {
            "throttle_command": row["r_fb"] + row["r_cmd"],
            "steering_command": row["delta_fb"] + row["delta_cmd"],
        }
        predictor.observe(stamp, commands)
        outcome = predictor.predict(stamp, {name: row[name] for name in ("v_x", "v_y", "omega", "x", "y", "theta")})
        if isinstance(outcome, Prediction):
            health.predicted(0.001, 0.0)
            both = (outcome.state, states[k])
            errors.append([np.mean(((one - states[k + 1]) / scale) ** 2) for one in both])
        else:
            health.refused(outcome)
        health.hindsight = predictor.hindsight()
        ok = health.verdict(k / 50)[0] is Level.OK
        if k >= BEGINS:
            own, none = np.sum(errors[-SECOND:], axis=0)
            assert not (ok and own > none and k >= BEGINS + SECOND), k
            alarms += [] if ok else [k]
    assert bool(alarms) == told
    assert not told or alarms[0] < BEGINS + SECOND
