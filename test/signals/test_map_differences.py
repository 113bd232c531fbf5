"""Logs of one car for which different signal maps are suggested."""

from __future__ import annotations

from typing import Any

import pytest

from dynssm_ros.signals.map_differences import differences
from dynssm_ros.signals.signal_map import REQUIRED_SIGNALS, SignalMap

ODOMETRY = "nav_msgs/msg/Odometry"


def signal_map(**changed: dict[str, Any]) -> SignalMap:
    """A map of one topic, with some sources changed."""
    signals = {
        name: {"topic": "/car", "type": ODOMETRY, "field": name} | changed.get(name, {}) for name in REQUIRED_SIGNALS
    }
    return SignalMap.model_validate({"name": "own", "commands": "none", "signals": signals})


@pytest.mark.parametrize(
    ("changed", "here", "there"),
    [
        ({"scale": 4.2}, "scale 4.2", "scale 1"),
        ({"scale": -1.0}, "scale -1", "scale 1"),
        ({"unit": "deg"}, "unit deg, scale 1", "scale 1"),
        ({"offset": -0.53}, "scale 1, offset -0.53", "scale 1"),
        ({"field": "other"}, "/car other", "/car steering_feedback"),
    ],
)
def test_what_another_log_suggests_is_told_with_both(changed: dict[str, Any], here: str, there: str) -> None:
    assert [*differences(signal_map(), signal_map(steering_feedback=changed))] == [("steering_feedback", here, there)]


@pytest.mark.parametrize("changed", [{}, {"scale": 1.3}, {"offset": -0.03}, {"unit": "deg", "scale": 57.0}])
def test_numbers_that_are_nearly_the_same_are(changed: dict[str, Any]) -> None:
    assert [*differences(signal_map(), signal_map(steering_feedback=changed))] == []
