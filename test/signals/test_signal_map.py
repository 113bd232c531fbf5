"""Signal maps: the shipped ones, what is refused, and field paths on messages."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml

from dynssm_ros.configuration import config_root
from dynssm_ros.errors import ConfigurationError
from dynssm_ros.signals.messages import joint_state, odometry
from dynssm_ros.signals.signal_map import COMMAND_SIGNALS, SIGNALS, compile_field, load_signal_map


def changed(path: str, value: Any) -> dict[str, Any]:
    """The default map with the field at a path set to ``value``, or left out where that is ``...``."""
    whole: dict[str, Any] = yaml.safe_load((config_root() / "signals" / "default.yaml").read_text(encoding="utf-8"))
    *parents, last = path.split(".")
    place = whole
    for parent in parents:
        place = place[parent]
    if value is ...:
        del place[last]
    else:
        place[last] = value
    return whole


@pytest.mark.parametrize("name", ["default", "av21"])
def test_shipped_maps_load(name: str) -> None:
    signal_map = load_signal_map(name)
    assert signal_map.name == name
    assert set(signal_map.signals) <= set(SIGNALS)
    assert signal_map.max_gap_ns == 250_000_000


def test_the_default_map_is_that_of_the_contracts() -> None:
    signal_map = load_signal_map("default")
    assert signal_map.odometry_topic == "/vehicle/odometry"
    assert not any(s.topic.startswith("/") for s in signal_map.signals.values()), "in the namespace of a node"
    assert {s.recorded for s in signal_map.signals.values()} == {
        "/vehicle/odometry",
        "/vehicle/actuator_feedback",
        "/vehicle/actuator_command",
    }
    assert signal_map.commands == "topics"


def test_the_av21_scales_turn_wheel_degrees_and_kilopascals_into_radians_and_fractions() -> None:
    signals = load_signal_map("av21").signals
    assert signals["steering_feedback"].scale == pytest.approx(0.0545 * np.pi / 180, rel=1e-15)
    assert signals["brake_feedback"].scale == pytest.approx(1 / 2757.9, rel=1e-15)
    assert signals["throttle_feedback"].scale == 0.01


@pytest.mark.parametrize(
    ("path", "value", "expected"),
    [
        ("signals.v_x", ..., ["missing v_x"]),
        ("signals.steering_command", ..., ["missing steering_command", "commands: topics"]),
        ("signals.speed", {"topic": "/a", "type": "b/msg/C", "field": "d"}, ["unknown 'speed'", "v_x"]),
        ("signals.v_x.topic", "odo metry", ["signals.v_x.topic", "'odo metry'"]),
        ("signals.v_x.topic", "//odometry", ["signals.v_x.topic", "'//odometry'"]),
        ("signals.v_x.topic", "/odometry/", ["signals.v_x.topic", "'/odometry/'"]),
        ("signals.v_x.type", "nav_msgs/Odometry", ["signals.v_x.type", "'nav_msgs/Odometry'"]),
        ("signals.v_x.type", "std_msgs/msg/Float64", ["topic vehicle/odometry is given two types"]),
        ("signals.v_x.field", "twist..x", ["signals.v_x.field", "dotted path", "'twist..x'"]),
        ("signals.v_x.field", "position[", ["signals.v_x.field", "'position['"]),
        ("signals.v_x.field", "yaw(pose", ["signals.v_x.field", "'yaw(pose'"]),
        ("signals.v_x.field", "x\n", ["signals.v_x.field"]),
        ("signals.v_x.field", "a + b *", ["signals.v_x.field", "sum", "'a + b *'"]),
        ("signals.v_x.scale", float("nan"), ["signals.v_x.scale", "nan"]),
        ("signals.v_x.curve", [[0.0, 1.0]], ["signals.v_x.curve"]),
        ("signals.v_x.curve", [[0.0, 1.0], [0.0, 2.0]], ["signals.v_x.curve", "rising field values"]),
        ("signals.v_x.hold", "second", ["signals.v_x.hold", "'second'"]),
        ("signals.v_x.delay", 0.1, ["signals.v_x.delay", "expected none"]),
        ("signals.steering_feedback.delay", -100.0, ["signals.steering_feedback.delay", "-100"]),
        ("signals.v_x.gain", 2.0, ["signals.v_x.gain", "2.0"]),
        ("signals.v_x.field", ..., ["signals.v_x", "field is missing"]),
        ("commands", "telepathy", ["commands", "'telepathy'", "lookahead"]),
        ("max_gap", 0.0, ["max_gap", "0.0"]),
        ("max_gap", -1.0, ["max_gap", "-1.0"]),
        ("max_gap", float("inf"), ["max_gap", "inf"]),
    ],
)
def test_a_wrong_map_names_file_field_and_value(tmp_path: Path, path: str, value: Any, expected: list[str]) -> None:
    file = tmp_path / "map.yaml"
    file.write_text(yaml.safe_dump(changed(path, value)), encoding="utf-8")
    with pytest.raises(ConfigurationError) as caught:
        load_signal_map(file)
    message = str(caught.value)
    assert message.startswith(f"{file}: ")
    assert "\n" not in message
    for part in expected:
        assert part in message


def test_another_source_of_commands_decides_which_topics_are_read() -> None:
    default = load_signal_map("default")
    assert default.with_commands(None) is default
    assert set(COMMAND_SIGNALS) <= set(default.active_signals())
    for commands in ("lookahead", "none"):
        other = default.with_commands(commands)
        assert other.commands == commands
        assert not set(COMMAND_SIGNALS) & set(other.active_signals())


def test_command_topics_cannot_be_asked_of_a_map_without_them() -> None:
    with pytest.raises(ConfigurationError, match=r"av21.*missing throttle_command, steering_command"):
        load_signal_map("av21").with_commands("topics")


@pytest.mark.parametrize(
    ("field", "expected"),
    [
        ("twist.twist.linear.x", 3.0),
        ("pose.pose.position.y", 2.0),
        ("header.stamp.sec", 5.0),
        ("yaw(pose.pose.orientation)", 0.7),
        ("twist.covariance[35]", 1e6),
    ],
)
def test_dotted_paths_reach_into_a_message(field: str, expected: float) -> None:
    message = odometry(5_000_000_000, (1.0, 2.0, 0.7), (3.0, 0.0, 0.0))
    assert compile_field(field)(message) == pytest.approx(expected, abs=1e-15)


@pytest.mark.parametrize(
    ("field", "expected"),
    [("position[steering]", 0.2), ("position[1]", 0.2), ("position[brake]", None), ("position[2]", None)],
)
def test_joints_are_picked_by_name_or_index_and_may_be_absent(field: str, expected: float | None) -> None:
    message = joint_state(0, {"throttle": 0.1, "steering": 0.2})
    assert compile_field(field)(message) == expected


def test_a_joint_that_is_named_but_has_no_value_is_absent() -> None:
    message = SimpleNamespace(name=["throttle", "steering"], position=[0.1])
    assert compile_field("position[steering]")(message) is None


@pytest.mark.parametrize("name", ["front-left", "axle/steer", "lenk winkel", "7"])
def test_joint_names_may_hold_what_urdf_allows(name: str) -> None:
    message = SimpleNamespace(name=["0", "1", "2", "3", "4", "5", "6", name], position=[*range(8)])
    assert compile_field(f"position[{name}]")(message) == 7.0


@pytest.mark.parametrize(
    ("field", "expected"),
    [
        ("torque[0] + torque[1]", 5.0),
        ("torque[0]+torque[1] * gear + bias", 2.0 + 3.0 * 4.0 - 1.0),
        ("torque[0] * gear", 8.0),
        ("position[a + b] + bias", 9.0),
        ("torque[0] + torque[7]", None),
    ],
)
def test_fields_may_be_sums_of_products(field: str, expected: float | None) -> None:
    message = SimpleNamespace(torque=[2.0, 3.0], gear=4.0, bias=-1.0, name=["a + b"], position=[10.0])
    assert compile_field(field)(message) == expected


def test_elements_of_nested_messages_are_reached_by_index() -> None:
    message = SimpleNamespace(wheels=[SimpleNamespace(speed=1.0), SimpleNamespace(speed=2.0)])
    assert compile_field("wheels[1].speed")(message) == 2.0
    assert compile_field("wheels[2].speed")(message) is None
    assert compile_field("yaw(wheels[2])")(message) is None


@pytest.mark.parametrize("length", [1.0, 0.97, 1.01])
def test_yaw_is_the_heading_of_a_quaternion_that_is_not_quite_unit(length: float) -> None:
    roll, pitch, yaw = 0.2, -0.3, 2.5
    (cr, sr), (cp, sp), (cy, sy) = ((np.cos(a / 2), np.sin(a / 2)) for a in (roll, pitch, yaw))
    q = SimpleNamespace(
        w=length * (cr * cp * cy + sr * sp * sy),
        x=length * (sr * cp * cy - cr * sp * sy),
        y=length * (cr * sp * cy + sr * cp * sy),
        z=length * (cr * cp * sy - sr * sp * cy),
    )
    assert compile_field("yaw(q)")(SimpleNamespace(q=q)) == pytest.approx(yaw, abs=1e-14)


@pytest.mark.parametrize("length", [0.0, 0.5, 2.0, math.nan])
def test_a_quaternion_that_nobody_filled_in_has_no_heading(length: float) -> None:
    message = SimpleNamespace(q=SimpleNamespace(w=length, x=0.0, y=0.0, z=0.0))
    assert math.isnan(compile_field("yaw(q)")(message))


def test_a_path_that_is_none_cannot_be_compiled() -> None:
    with pytest.raises(ValueError, match="not a field path: a b"):
        compile_field("a b")
