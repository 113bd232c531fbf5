"""What an inspection says of a log with a speed set-point: of F1TENTH cars, of topics by other names, of tables."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from rosbags.typesys import get_types_from_msg

from dynssm_ros.signals import messages
from dynssm_ros.signals.extraction import extract
from dynssm_ros.signals.inspection import Inspection, inspect
from dynssm_ros.signals.signal_map import SignalMap
from dynssm_ros.simulation.laps import simulate, write_run
from dynssm_ros.track.driver import Style
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import load_vehicle

START = 1_700_000_000_000_000_000
DRIVE, STAMPED = "ackermann_msgs/msg/AckermannDrive", "ackermann_msgs/msg/AckermannDriveStamped"
TYPES = {
    DRIVE: "float32 steering_angle\nfloat32 steering_angle_velocity\nfloat32 speed\nfloat32 acceleration\nfloat32 jerk\n",
    STAMPED: "std_msgs/Header header\nackermann_msgs/AckermannDrive drive\n",
}
t = np.arange(0.0, 30.0, 0.025)
v_set = 2.5 + np.sign(np.sin(2 * np.pi * t / 8))
delta = 0.2 * np.sin(2 * np.pi * t / 5)
v_x = 2.5 + 0.9 * np.sin(2 * np.pi * t / 8 - 0.4)
omega = v_x * delta / 0.32
theta = np.cumsum(omega) * 0.025
x, y = np.cumsum(v_x * np.cos(theta)) * 0.025, np.cumsum(v_x * np.sin(theta)) * 0.025


@pytest.fixture
def f1tenth_bag(typestore: Any, make_bag: Any) -> Any:
    """A car whose odometry has neither v_y nor, unless ``turns``, omega, with a particle filter; more records if given."""
    types: dict[str, Any] = {}
    for name, text in TYPES.items():
        types |= get_types_from_msg(text, name)
    typestore.register({name: types[name] for name in TYPES if name not in typestore.types})
    made = typestore.types

    def build(topic: str = "/drive", turns: bool = False, also: Any = None, poses_every: int = 1) -> Path:
        records = []
        for k, stamp in enumerate((START + np.round(1e9 * t)).astype(np.int64).tolist()):
            moved = messages.odometry(stamp, (x[k], y[k], theta[k]), (v_x[k], 0.0, omega[k] if turns else 0.0))
            pose = made["geometry_msgs/msg/PoseStamped"](moved.header, moved.pose.pose)
            asked = made[STAMPED](moved.header, made[DRIVE](delta[k], 0.0, v_set[k], 0.0, 0.0))
            records += [("/odom", messages.ODOMETRY, stamp, moved), (topic, STAMPED, stamp, asked)]
            records += [("/pf/pose", "geometry_msgs/msg/PoseStamped", stamp, pose)] if k % poses_every == 0 else []
            records += [] if also is None else [("/duty", messages.JOINT_STATE, stamp, also(stamp, k))]
        return Path(make_bag(records))

    return build


def suggested(found: Inspection) -> SignalMap:
    return SignalMap.model_validate(yaml.safe_load(found.signal_map()))


@pytest.mark.parametrize("topic", ["/drive", "/ackermann_cmd"])
def test_the_set_point_and_the_poses_of_an_f1tenth_car_are_suggested(f1tenth_bag: Any, topic: str) -> None:
    bag = f1tenth_bag(topic)
    found = inspect(bag)
    assert found.notes == (
        "/odom: omega is constant 0 while the car turns; velocities follow from the poses of /pf/pose",
        f"{topic}: drive.speed is a set-point of the speed, no throttle; take a vehicle with inputs.set_point: speed, such "
        "as f1tenth",
    )
    assert found.missing == ()
    mapped = suggested(found)
    assert (mapped.set_point, mapped.commands) == ("speed", "none")
    assert mapped.signals["speed_feedback"].field == "drive.speed"
    assert mapped.signals["x"].topic == "/pf/pose"
    recording = extract([bag], mapped, 40.0)
    rows = np.searchsorted(START + np.round(1e9 * t), recording.time)
    np.testing.assert_allclose(recording["omega"], omega[rows], atol=0.1)
    np.testing.assert_allclose(np.sort(np.unique(recording["r_fb"]))[[0, -1]], [1.5, 3.5])


def test_of_an_odometry_that_knows_no_side_slip_the_localisation_is_taken(f1tenth_bag: Any) -> None:
    found = inspect(f1tenth_bag(turns=True))
    assert found.signals["x"].topic.name == "/pf/pose"
    assert found.notes[0] == (
        "/odom: v_y is constant, so that nothing is known of how the car slides; velocities follow from the poses of /pf/pose"
    )


def test_of_a_slow_localisation_velocities_are_not_made(f1tenth_bag: Any) -> None:
    found = inspect(f1tenth_bag(turns=True, poses_every=4))
    assert found.signals["omega"].topic.name == "/odom"
    assert found.notes[0] == (
        "/odom: v_y is constant, so that nothing is known of how the car slides (leave v_y out and write `estimation: {}` to "
        "have it estimated)"
    )


def test_where_there_is_a_throttle_the_set_point_is_told_alone(f1tenth_bag: Any) -> None:
    bag = f1tenth_bag(also=lambda stamp, k: messages.joint_state(stamp, {"duty_cycle": 0.1 * v_x[k]}))
    found = inspect(bag)
    assert found.signals["throttle_feedback"].field == "position[duty_cycle]"
    assert "speed_feedback" not in found.signals
    assert any(
        "drive.speed is a set-point of the speed, no throttle; for a vehicle with" in note for note in found.notes
    )


def test_our_own_topics_give_both_set_points(tmp_path: Path) -> None:
    car = load_vehicle("f1tenth")
    write_run(
        simulate(car, load_track("club").scaled(10.0), duration=2.0, plant="rk4", style=Style(0.7)), tmp_path / "bag"
    )
    mapped = suggested(inspect(tmp_path / "bag"))
    assert mapped.commands == "topics"
    assert mapped.signals["speed_command"].recorded == messages.COMMAND_TOPIC
    assert mapped.signals["speed_feedback"].recorded == messages.FEEDBACK_TOPIC


@pytest.mark.parametrize("heading", ["speed_cmd", "target_speed", "v_set [m/s]", "Sollgeschwindigkeit [km/h]"])
def test_a_column_of_a_table_is_a_set_point(tmp_path: Path, heading: str) -> None:
    unit = 3.6 if "km/h" in heading else 1.0
    table = np.stack([t, v_x, 0.01 * np.sin(t), omega, delta, unit * v_set], axis=1)
    head = f"time_s,v_x,v_y,omega,steering,{heading}"
    np.savetxt(tmp_path / "log.csv", table, delimiter=",", header=head, comments="", fmt="%.6f")
    found = inspect(tmp_path / "log.csv")
    assert found.signals["v_x"].field == "v_x"
    mapped = suggested(found)
    assert mapped.signals["speed_feedback"].column == heading
    assert mapped.signals["speed_feedback"].factor * unit == pytest.approx(1.0)


def test_a_healthy_car_with_a_throttle_has_no_set_point(laps_bag: Path) -> None:
    assert inspect(laps_bag).notes == ()
