"""The shipped signal maps of stacks whose messages are not of the default topics extract bags of these stacks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.interfaces import Nodetype
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from dynssm_ros.signals.extraction import extract
from dynssm_ros.signals.signal_map import SignalMap, load_signal_map

START = 1_700_000_000_000_000_000
TYPES = {
    "ackermann_msgs/msg/AckermannDrive": "float32 steering_angle\nfloat32 steering_angle_velocity\nfloat32 speed\n",
    "ackermann_msgs/msg/AckermannDriveStamped": "std_msgs/Header header\nackermann_msgs/AckermannDrive drive\n",
    "vesc_msgs/msg/VescState": "float64 speed\nfloat64 duty_cycle\n",
    "vesc_msgs/msg/VescStateStamped": "std_msgs/Header header\nvesc_msgs/VescState state\n",
    "autoware_vehicle_msgs/msg/VelocityReport": "std_msgs/Header header\nfloat32 longitudinal_velocity\n"
    "float32 lateral_velocity\nfloat32 heading_rate\n",
    "autoware_vehicle_msgs/msg/SteeringReport": "builtin_interfaces/Time stamp\nfloat32 steering_tire_angle\n",
    "autoware_control_msgs/msg/Lateral": "builtin_interfaces/Time stamp\nfloat32 steering_tire_angle\n",
    "autoware_control_msgs/msg/Control": "builtin_interfaces/Time stamp\nautoware_control_msgs/Lateral lateral\n",
    "tier4_vehicle_msgs/msg/ActuationStatus": "float64 accel_status\nfloat64 brake_status\nfloat64 steer_status\n",
    "tier4_vehicle_msgs/msg/ActuationStatusStamped": "std_msgs/Header header\ntier4_vehicle_msgs/ActuationStatus status\n",
    "tier4_vehicle_msgs/msg/ActuationCommand": "float64 accel_cmd\nfloat64 brake_cmd\nfloat64 steer_cmd\n",
    "tier4_vehicle_msgs/msg/ActuationCommandStamped": "std_msgs/Header header\n"
    "tier4_vehicle_msgs/ActuationCommand actuation\n",
}


@pytest.fixture(scope="module")
def store() -> Any:
    types: dict[str, Any] = {}
    for name, text in TYPES.items():
        types |= get_types_from_msg(text, name)
    found = get_typestore(Stores.ROS2_JAZZY)
    found.register(types)
    return found


def message(store: Any, name: str, stamp: int, values: dict[str, float], path: str = "") -> Any:
    """A message with its stamps and the given fields, zeros elsewhere."""
    if name == "builtin_interfaces/msg/Time":
        return store.types[name](*divmod(stamp, 1_000_000_000))
    parts = []
    for part, (kind, described) in store.fielddefs[name][1]:
        at = f"{path}{part}"
        if kind == Nodetype.NAME:
            parts.append(message(store, described, stamp, values, f"{at}."))
        elif kind == Nodetype.BASE:
            parts.append("odom" if described[0] == "string" else values.get(at, 0.0))
        else:
            parts.append(np.zeros(described[1]))
    return store.types[name](*parts)


def write(store: Any, path: Path, signal_map: SignalMap, without: tuple[str, ...] = ()) -> Path:
    """Three seconds at 50 Hz of each topic of the map, whose fields rise by 1 a second; quaternions are of no turn."""
    topics = {s.recorded: s.type for s in signal_map.signals.values() if s.recorded not in without}
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connections = {topic: writer.add_connection(topic, kind, typestore=store) for topic, kind in topics.items()}
        for k in range(150):
            for topic, kind in topics.items():
                fields = [s.field for s in signal_map.signals.values() if s.recorded == topic]
                values = {f"{f[4:-1]}.w" if f.startswith("yaw(") else f: 1.0 if "yaw" in f else k / 50 for f in fields}
                stamp = START + k * 20_000_000
                raw = bytes(store.serialize_cdr(message(store, kind, stamp, values), kind))
                writer.write(connections[topic], stamp + 1000, raw)
    return path


@pytest.mark.parametrize("name", ["f1tenth", "vesc", "autoware"])
def test_a_bag_of_the_stack_is_extracted_with_its_map(store: Any, tmp_path: Path, name: str) -> None:
    signal_map = load_signal_map(name)
    recording = extract([write(store, tmp_path / "bag", signal_map)], signal_map, 25.0)
    t = (recording.time - START) / 1e9
    source = signal_map.signals["steering_feedback"]
    np.testing.assert_allclose(recording["delta_fb"], source.scale * t + source.offset, atol=1e-4)
    np.testing.assert_allclose(recording["v_x"], np.ones(len(t)) if name in ("vesc", "f1tenth") else t, atol=1e-4)
    assert recording.has_pose
    by = {"f1tenth": "header", "vesc": "log time", "autoware": "stamp"}[name]
    assert recording.info.stamped["steering_feedback"] == by


@pytest.mark.parametrize(
    "without",
    [("/control/command/control_cmd",), ("/control/command/actuation_cmd",)],
)
def test_without_one_of_the_command_topics_there_are_no_commands_and_a_note(
    store: Any, tmp_path: Path, without: tuple[str, ...]
) -> None:
    signal_map = load_signal_map("autoware")
    info = extract([write(store, tmp_path / "bag", signal_map, without)], signal_map, 25.0).info
    assert info.commands == "none"
    assert info.notes[-1] == f"no commands in the log (topic {without[0]}); commands: none"


def test_a_map_that_names_no_command_has_none() -> None:
    content = load_signal_map("default").model_dump()
    del content["commands"]
    assert SignalMap.model_validate(content).commands == "topics"
    for name in ("throttle_command", "steering_command"):
        del content["signals"][name]
    assert SignalMap.model_validate(content).commands == "none"
