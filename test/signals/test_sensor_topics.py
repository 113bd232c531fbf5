"""What a car without odometry has, IMU, wheel speed and GNSS, is suggested for the estimator, and nothing else is."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from dynssm_ros.signals import messages
from dynssm_ros.signals.extraction import extract
from dynssm_ros.signals.inspection import inspect
from dynssm_ros.signals.signal_map import load_signal_map

START = 1_700_000_000_000_000_000


def records(
    typestore: Any, *, speed: str = "/wheel_speed", fixes: bool = True, accelerations: bool = True
) -> list[Any]:
    """20 s of a car that turns and accelerates."""
    types, found = typestore.types, []
    vector, nine = types["geometry_msgs/msg/Vector3"], np.zeros(9)
    turn = types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
    status = types["sensor_msgs/msg/NavSatStatus"](status=0, service=1)
    for k in range(1000):
        stamp, t = START + k * 20_000_000, k / 50
        v_x, omega = 15 + 4 * np.sin(t / 3), 0.5 * np.sin(t)
        head = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](stamp // 10**9, stamp % 10**9), "imu")
        forces = vector(x=4 / 3 * np.cos(t / 3), y=v_x * omega, z=9.8) if accelerations else vector(x=0.0, y=0.0, z=0.0)
        imu = types["sensor_msgs/msg/Imu"](head, turn, nine, vector(x=0.0, y=0.0, z=omega), nine, forces, nine)
        found.append(("/imu/data", "sensor_msgs/msg/Imu", stamp, imu))
        found.append((speed, "std_msgs/msg/Float64", stamp, types["std_msgs/msg/Float64"](v_x)))
        inputs = messages.joint_state(stamp, {"throttle": 0.5 * np.sin(t), "steering": 0.1 * np.sin(t)})
        found.append((messages.FEEDBACK_TOPIC, messages.JOINT_STATE, stamp, inputs))
        if fixes and k % 5 == 0:
            fix = types["sensor_msgs/msg/NavSatFix"](head, status, 48.0 + 1e-4 * t, 11.0 + 1e-4 * t, 0.0, nine, 0)
            found.append(("/gps/fix", "sensor_msgs/msg/NavSatFix", stamp, fix))
    return found


def test_the_estimator_is_suggested_and_the_map_extracts(make_bag: Any, typestore: Any, tmp_path: Path) -> None:
    bag = make_bag(records(typestore))
    found = inspect(bag)
    assert found.missing == ()
    fields = {name: (one.topic.name, one.field) for name, one in found.signals.items()}
    assert fields["v_x"] == ("/wheel_speed", "data")
    assert fields["omega"] == ("/imu/data", "angular_velocity.z")
    assert fields["a_y"] == ("/imu/data", "linear_acceleration.y")
    assert fields["latitude"] == ("/gps/fix", "latitude")
    assert "v_y" not in fields
    assert any(note.startswith("nothing measures v_y; it is estimated from") for note in found.notes)
    (tmp_path / "map.yaml").write_text(found.signal_map(), encoding="utf-8")
    assert yaml.safe_load(found.signal_map())["estimation"] == {"rear_axle": 0.0}
    recording = extract([bag], load_signal_map(tmp_path / "map.yaml"), 50.0)
    assert recording.has_pose
    assert "v_y_std" in recording.columns


def test_without_accelerometers_and_fixes_v_y_is_that_of_a_steady_turn(make_bag: Any, typestore: Any) -> None:
    found = inspect(make_bag(records(typestore, fixes=False, accelerations=False, speed="/can/vehicle_speed")))
    assert set(found.signals) == {"v_x", "omega", "throttle_feedback", "steering_feedback"}
    assert any("it has no accelerometer" in note for note in found.notes)


def test_the_speed_is_the_mean_of_the_rear_wheels(make_bag: Any, typestore: Any, tmp_path: Path) -> None:
    joints, found = typestore.types[messages.JOINT_STATE], []
    names = ["front_left", "front_right", "rear_left", "rear_right"]
    for record in records(typestore, fixes=False):
        topic, _, stamp, message = record
        if topic == "/wheel_speed":
            v, half = message.data, 0.3 * np.sin((stamp - START) / 1e9)
            head = typestore.types["std_msgs/msg/Header"](
                typestore.types["builtin_interfaces/msg/Time"](stamp // 10**9, stamp % 10**9), ""
            )
            wheels = joints(head, names, np.empty(0), np.array([v - half, v + half] * 2), np.empty(0))
            found.append(("/wheel_speeds", messages.JOINT_STATE, stamp, wheels))
        else:
            found.append(record)
    bag = make_bag(found)
    v_x = inspect(bag).signals["v_x"]
    assert (v_x.field, v_x.scale) == ("velocity[rear_left] + velocity[rear_right]", 0.5)
    (tmp_path / "map.yaml").write_text(inspect(bag).signal_map(), encoding="utf-8")
    recording = extract([bag], load_signal_map(tmp_path / "map.yaml"), 50.0)
    t = (recording.time - START) / 1e9
    np.testing.assert_allclose(recording["v_x"], 15 + 4 * np.sin(t / 3), atol=0.1)


@pytest.mark.parametrize("speed", ["/motor/speed", "/wind_speed", "/cmd/speed"])
def test_other_speeds_are_not_taken(make_bag: Any, typestore: Any, speed: str) -> None:
    found = inspect(make_bag(records(typestore, speed=speed)))
    assert "v_x" not in found.signals


@pytest.mark.parametrize(
    ("heads", "units", "expected"),
    [
        (("v_x", "yaw_rate", "ax", "ay", "lat", "lon"), (1, 1, 1, 1), {}),
        (
            (
                "WheelSpeedRL [km/h]",
                "GyroZ [deg/s]",
                "G Long [g]",
                "G Lat [g]",
                "GPS Latitude [deg]",
                "GPS Longitude [deg]",
            ),
            (3.6, np.degrees(1), 1 / 9.80665, 1 / 9.80665),
            {"v_x": "km/h", "omega": "deg/s", "a_x": "g", "a_y": "g"},
        ),
    ],
)
def test_columns_of_a_data_logger_are_suggested(
    tmp_path: Path, heads: tuple[str, ...], units: tuple[float, ...], expected: dict[str, str]
) -> None:
    t = np.arange(0.0, 20.0, 0.02)
    v_x, omega = 15 + 4 * np.sin(t / 3), 0.5 * np.sin(t)
    motion = np.stack([v_x, omega, 4 / 3 * np.cos(t / 3), v_x * omega], axis=1) * units
    theta = 0.5 * (1 - np.cos(t))
    fixes = 48 + np.cumsum(v_x * np.sin(theta)) * 0.02 / 111_200, 11 + np.cumsum(v_x * np.cos(theta)) * 0.02 / 74_600
    columns = np.column_stack([t, motion, *fixes, 0.1 * np.sin(t), 0.5 + 0.1 * np.cos(t)])
    head = ",".join(["time", *heads, "steering_angle", "throttle"])
    np.savetxt(tmp_path / "log.csv", columns, delimiter=",", header=head, comments="", fmt="%.9f")
    found = inspect(tmp_path / "log.csv")
    assert found.missing == ()
    assert {name: one.unit for name, one in found.signals.items() if one.unit != "1"} == expected
    assert set(found.signals) >= {"v_x", "omega", "a_x", "a_y", "latitude", "longitude"}
    (tmp_path / "map.yaml").write_text(found.signal_map(), encoding="utf-8")
    recording = extract([tmp_path / "log.csv"], load_signal_map(tmp_path / "map.yaml"), 50.0)
    np.testing.assert_allclose(recording["v_x"], 15 + 4 * np.sin(recording.time / 3e9), atol=0.2)
    assert np.abs(recording["v_y"]).max() < 0.5
