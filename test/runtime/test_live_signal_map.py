"""The signals that a deployed model waits for."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from dynssm_ros.runtime.predictor import live_signal_map
from dynssm_ros.signals.signal_map import SignalMap, load_signal_map
from dynssm_ros.vehicle import load_vehicle


def test_no_prediction_waits_for_gear_or_engine_speed() -> None:
    default = load_signal_map("default")
    model: Any = SimpleNamespace(vehicle=load_vehicle("orca"), commands="topics")
    with_gear = default.model_dump()
    with_gear["signals"]["gear"] = {"topic": "/gear", "type": "std_msgs/msg/Int8", "field": "data"}
    assert live_signal_map(model, SignalMap.model_validate(with_gear)).signals == default.signals
