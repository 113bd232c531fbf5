"""Brakes that do not rest at 0: found as large as planted, and none where 0 is right."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from dynssm_ros.signals import messages
from dynssm_ros.signals.extraction import extract
from dynssm_ros.signals.inspection import inspect
from dynssm_ros.signals.rest_value import rest_value
from dynssm_ros.signals.signal_map import SignalMap, load_signal_map

START = 1_700_000_000_000_000_000
BRAKING = np.maximum(-np.sin(2 * np.pi * np.arange(3000) / 1000), 0.0)
RANDOM = np.random.default_rng(0).normal(size=3000)


@pytest.mark.parametrize(
    ("brake", "rest", "most"),
    [
        ((0.6 + 79 * BRAKING) / 80, 0.0075, 0.0076),  # exact
        (0.05 + 0.9 * BRAKING + 0.004 * RANDOM, 0.05 + 3 * 0.004, 0.05 + 6 * 0.004),  # noisy
        (np.round(400 * (0.05 + 0.9 * BRAKING + 0.001 * RANDOM)) / 400, 0.0525, 0.06),  # of few steps
        (0.9 * BRAKING + 0.01 * RANDOM, 0.02, 0.06),  # around 0
        (np.full(3000, 0.1), 0.1, 0.101),  # never braked
    ],
)
def test_the_rest_value_is_found_with_its_noise(brake: np.ndarray, rest: float, most: float) -> None:
    assert rest <= rest_value(brake) <= most


@pytest.mark.parametrize(
    "brake",
    [
        BRAKING,
        BRAKING - 0.03,
        np.zeros(3000),
        np.linspace(0.1, 1.0, 3000),
        0.6 + 0.4 * BRAKING,
        np.full(20, 0.1),
        np.full(99, np.nan),
    ],
)
def test_there_is_none_where_0_is_right_or_nothing_rests(brake: np.ndarray) -> None:
    assert rest_value(brake) == 0.0


def records(rest: float) -> list[Any]:
    """A car that accelerates and brakes, 20 s at 50 Hz; its brake shows ``rest`` of full where nobody brakes."""
    found: list[Any] = []
    for k in range(1000):
        stamp, pedal = START + k * 20_000_000, float(np.sin(2 * np.pi * k / 500))
        values = {"throttle": max(pedal, 0.0), "steering": 0.1, "brake_pressure": rest + (1 - rest) * max(-pedal, 0.0)}
        inputs = messages.joint_state(stamp, values)
        found.append((messages.FEEDBACK_TOPIC, messages.JOINT_STATE, stamp, inputs))
        motion = messages.odometry(stamp, (0.01 * k, 0.0, 0.0), (1.0 + 0.001 * k, 0.01, 0.1))
        found.append((messages.ODOMETRY_TOPIC, messages.ODOMETRY, stamp, motion))
    return found


def with_brake(offset: float = 0.0) -> SignalMap:
    content = load_signal_map("default").with_commands("none").model_dump()
    brake = content["signals"]["throttle_feedback"] | {"field": "position[brake_pressure]", "offset": offset}
    return SignalMap.model_validate(content | {"signals": content["signals"] | {"brake_feedback": brake}})


def test_the_throttle_counts_though_the_brake_never_shows_0_and_the_map_says_so_live(make_bag: Any) -> None:
    bag = make_bag(records(0.0075))
    recording = extract([bag], with_brake(), 50.0)
    assert recording["r_fb"].max() == pytest.approx(1.0, abs=1e-4)
    assert recording["r_fb"].min() == pytest.approx(-0.9925, abs=1e-4)
    (note,) = [one for one in recording.info.notes if one.startswith("brake_feedback")]
    assert "write offset: -0.007515 in the signal map" in note
    told = extract([bag], with_brake(-0.007515), 50.0)
    assert [one for one in told.info.notes if one.startswith("brake")] == []
    np.testing.assert_allclose(told["r_fb"], recording["r_fb"], atol=1e-9)


def test_inspect_suggests_the_offset(make_bag: Any) -> None:
    found = inspect(make_bag(records(0.0075)))
    assert "offset: -0.007515" in found.signal_map()
    assert inspect(make_bag(records(0.0), "healthy")).signals["brake_feedback"].offset == 0.0
