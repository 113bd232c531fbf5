"""What an inspection says of a log: regularity, clocks, a signal map that can be used, and what it cannot know."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from dynssm_ros.errors import BagError
from dynssm_ros.signals import messages
from dynssm_ros.signals.extraction import extract
from dynssm_ros.signals.inspection import Inspection, inspect
from dynssm_ros.signals.signal_map import UNITS, SignalMap, load_signal_map
from dynssm_ros.vehicle import Vehicle

START = 1_700_000_000_000_000_000
ODOMETRY, FEEDBACK = messages.ODOMETRY_TOPIC, messages.FEEDBACK_TOPIC
WHEELBASE = 0.3
STAMPED = "geometry_msgs/msg/TwistStamped"


def suggested(found: Inspection) -> SignalMap:
    """The signal map, read back."""
    return SignalMap.model_validate(yaml.safe_load(found.signal_map()))


def bends(
    joints: str = "steering",
    scale: float = 1.0,
    late: float = 0.0,
    topic: str = FEEDBACK,
    rate: float = 50.0,
    straight: float = 0.0,
) -> list[Any]:
    """20 s of bends without slip; the joints say ``straight`` and ``scale`` times the road-wheel angle, ``late`` by another
    clock (s).
    """
    records = []
    for t in np.arange(0.0, 20.0, 1 / rate):
        stamp, delta, v_x = START + round(t * 1e9), 0.2 * np.sin(t), 3.0 + np.sin(0.3 * t)
        omega = v_x * np.tan(delta) / WHEELBASE
        moved = messages.odometry(stamp, (t, 0.1 * t, 0.0), (v_x, 0.01 * np.sin(t), omega))
        values = messages.joint_state(
            stamp - round(late * 1e9), {"throttle": 0.4 + 0.1 * np.sin(t), joints: straight + scale * delta}
        )
        records.append((ODOMETRY, messages.ODOMETRY, stamp, moved))
        records.append((topic, messages.JOINT_STATE, stamp, values))
    return records


def test_a_log_on_the_default_topics_gives_their_signal_map(laps_bag: Path, orca: Vehicle) -> None:
    found = inspect(laps_bag, orca.constants.l_f + orca.constants.l_r)
    assert (found.missing, found.notes) == ((), ())
    default = load_signal_map("default")
    expected = {name: (one.recorded, one.field, one.scale) for name, one in default.signals.items()}
    mapped = suggested(found)
    assert {name: (one.recorded, one.field, one.scale) for name, one in mapped.signals.items()} == expected
    assert mapped.commands == "topics"
    np.testing.assert_array_equal(extract([laps_bag], mapped, 50.0).matrix, extract([laps_bag], default, 50.0).matrix)


@pytest.mark.parametrize("rate", [20.0, 50.0])
def test_rates_gaps_and_what_is_in_the_topics_are_told(make_bag: Any, rate: float) -> None:
    records = [one for one in bends(rate=rate) if not 5.0 < (one[2] - START) / 1e9 < 8.0]
    topic = inspect(make_bag(records)).topics[FEEDBACK]
    assert topic.rate == pytest.approx(rate, rel=1e-6)
    assert topic.longest_gap == pytest.approx(3.0, abs=2 / rate)
    assert topic.count == len(records) / 2
    assert topic.lateness == pytest.approx(0.0, abs=1e-6)
    assert {"position[steering]", "position[throttle]"} <= set(topic.values)


@pytest.mark.parametrize(("scale", "unit"), [(180 / np.pi, np.pi / 180), (-1.0, -1.0), (14.0, 1 / 14.0)])
def test_degrees_swapped_signs_and_steering_wheels_are_seen_by_the_curvature(
    make_bag: Any, scale: float, unit: float
) -> None:
    bag = make_bag(bends(scale=scale))
    found = inspect(bag, WHEELBASE).signals["steering_feedback"]
    assert found.scale * UNITS[found.unit] == pytest.approx(unit, rel=0.05)
    assert "curvature" in found.note
    unknown = inspect(bag).signals["steering_feedback"]
    assert (unknown.scale, "times the wheelbase" in unknown.note) == (1.0, True)


@pytest.mark.parametrize(
    ("scale", "straight", "offset"),
    [
        (-1.2135, 0.5304, 0.5304),
        (1.0, -0.1, 0.1),
        (1.0, 0.02, 0.0),
        (180 / np.pi, 20.0, -np.radians(20.0)),
        (14.0, 7.0, -0.5),
    ],
)
def test_a_servo_whose_position_is_not_0_straight_ahead_gets_an_offset(
    make_bag: Any, scale: float, straight: float, offset: float
) -> None:
    """As of F1TENTH cars, whose servo is at 0.53 then and turns to the right."""
    bag = make_bag(bends(scale=scale, straight=straight))
    found = inspect(bag, WHEELBASE)
    one = found.signals["steering_feedback"]
    assert one.offset == pytest.approx(offset, abs=0.03)
    assert ("goes straight at" in one.note) == (offset != 0.0)
    assert not [each for each in found.findings if each.what.startswith("steering")]
    recording = extract([bag], suggested(found), 50.0)
    ahead = np.abs(recording["omega"]) < 0.05 * np.abs(recording["omega"]).max()
    assert np.median(recording["delta_fb"][ahead]) == pytest.approx(0.0, abs=0.03)


def moved(change: Any) -> list[Any]:
    """Bends whose odometry a function of the message changes."""
    return [(*one[:3], change(one[3]) or one[3]) if one[0] == ODOMETRY else one for one in bends()]


def to_the_right(message: Any) -> None:
    """The odometry with y to the right."""
    message.twist.twist.linear.y *= -1
    message.twist.twist.angular.z *= -1
    message.pose.pose.position.y *= -1


def in_km_h(message: Any) -> None:
    """The velocity in km/h, and a pose that says so."""
    message.twist.twist.linear.x *= 3.6
    message.twist.twist.linear.y *= 3.6


@pytest.fixture
def driven_bag(make_bag: Any) -> Any:
    """Makes a bag of bends with poses that are integrated, its odometry changed."""

    def make(change: Any) -> Path:
        records, place, theta = bends(), 0j, 0.0
        for _, _, _, message in records[::2]:
            twist, pose = message.twist.twist, message.pose.pose
            pose.position.x, pose.position.y = place.real, place.imag
            pose.orientation.z, pose.orientation.w = np.sin(theta / 2), np.cos(theta / 2)
            place += complex(twist.linear.x, twist.linear.y) * np.exp(1j * theta) / 50
            theta += twist.angular.z / 50
            change(message)
        return Path(make_bag(records))

    return make


def test_opposite_signs_are_turned_without_a_scale_and_both_remedies_told(make_bag: Any) -> None:
    found = inspect(make_bag(moved(to_the_right)), WHEELBASE).signals["steering_feedback"]
    assert (found.scale, found.unit) == (-1.0, "1")
    assert "unless omega, v_y, y and theta count to the right" in found.note


def test_a_speed_of_another_unit_is_a_finding_and_no_scale_of_the_steering(driven_bag: Any) -> None:
    found = inspect(driven_bag(in_km_h), WHEELBASE)
    assert [each.what for each in found.findings] == ["pose_speed"]
    assert found.signals["steering_feedback"].scale == 1.0


def test_a_twist_beside_a_pose_is_taken_and_a_commanded_one_is_not(make_bag: Any, typestore: Any) -> None:
    types, records = typestore.types, []
    for one in bends():
        if one[0] != ODOMETRY:
            records.append(one)
            continue
        head, twist = one[3].header, one[3].twist.twist
        records.append(("/car/twist", STAMPED, one[2], types[STAMPED](head, twist)))
        records.append(("/cmd_vel_stamped", STAMPED, one[2], types[STAMPED](head, twist)))
        records.append(
            (
                "/pose",
                "geometry_msgs/msg/PoseStamped",
                one[2],
                types["geometry_msgs/msg/PoseStamped"](head, one[3].pose.pose),
            )
        )
    found = inspect(make_bag(records))
    assert found.missing == ()
    assert {name: found.signals[name].topic.name for name in ("v_x", "omega", "x")} == {
        "v_x": "/car/twist", "omega": "/car/twist", "x": "/pose",
    }  # fmt: skip


def test_an_odometry_that_knows_how_the_car_slides_is_taken_before_a_faster_one(make_bag: Any) -> None:
    records = bends()
    for _, _, stamp, message in bends(rate=100.0)[::2]:
        twist = message.twist.twist
        moved = messages.odometry(stamp, (0.1, 0.2, 0.0), (twist.linear.x, 0.0, twist.angular.z))
        records.append(("/wheel_odom", messages.ODOMETRY, stamp, moved))
    found = inspect(make_bag(records))
    assert found.signals["v_y"].topic.name == ODOMETRY
    assert any("several odometries move: " in note for note in found.notes)


def test_gear_and_engine_speed_are_suggested_where_they_change(make_bag: Any) -> None:
    joints = [
        ("/can", messages.JOINT_STATE, stamp, messages.joint_state(stamp, {"gear": 1.0 + k // 500, "engine_rpm": 900.0 + k}))
        for k, (_, _, stamp, _) in enumerate(bends()[::2])
    ]  # fmt: skip
    bag = make_bag([*bends(), *joints])
    mapped = suggested(inspect(bag))
    assert (mapped.signals["gear"].field, mapped.signals["engine_speed"].unit) == ("position[gear]", "rpm")
    assert set(extract([bag], mapped, 50.0)["gear"]) == {1.0, 2.0}


def test_a_road_wheel_angle_in_rad_is_taken_as_it_is(make_bag: Any) -> None:
    assert inspect(make_bag(bends()), WHEELBASE).signals["steering_feedback"].scale == 1.0


def test_another_clock_is_told(make_bag: Any) -> None:
    (note,) = inspect(make_bag(bends(late=3.0))).notes
    assert f"{FEEDBACK} is stamped 3 s before {ODOMETRY}: another clock?" in note
    assert inspect(make_bag(bends(late=0.1), "early")).notes == ()


def test_a_command_is_taken_where_nothing_is_measured(make_bag: Any) -> None:
    found = inspect(make_bag(bends(topic="/drive_cmd")))
    assert found.signals["throttle_feedback"].topic.name == "/drive_cmd"
    assert "the command is taken" in found.signals["throttle_feedback"].note
    assert found.missing == ()


def test_what_is_not_there_stands_in_the_map_as_a_comment(make_bag: Any) -> None:
    records = [one for one in bends(joints="wiper") if one[0] != ODOMETRY]
    found = inspect(make_bag(records))
    assert found.missing == ("v_x", "v_y", "omega", "steering_feedback")
    assert all(f"# {name}: nothing found" in found.signal_map() for name in found.missing)
    assert any("nothing tells where the car is" in note for note in found.notes)


def test_where_velocities_are_missing_they_follow_from_poses(make_bag: Any) -> None:
    records = [
        (ODOMETRY, messages.ODOMETRY, one[2], messages.odometry(one[2], (k * 0.1, 0.0, 0.0), (0.0, 0.0, 0.0)))
        if one[0] == ODOMETRY
        else one
        for k, one in enumerate(bends())
    ]
    bag = make_bag(records)
    found = inspect(bag)
    assert found.notes == (f"no topic has velocities; they follow from the poses of {ODOMETRY}",)
    assert found.missing == ()
    mapped = suggested(found)
    assert mapped.velocities is not None
    np.testing.assert_allclose(extract([bag], mapped, 50.0)["v_x"], 10.0, atol=1e-6)


def test_a_topic_that_cannot_be_read_is_listed_with_its_reason(make_bag: Any) -> None:
    found = inspect(make_bag([*bends(), ("/imu", "sensor_msgs/msg/Imu", START, b"\0\1\0\0abc")]))
    assert found.missing == ()
    assert found.topics["/imu"].reason.startswith("a message is not a sensor_msgs/msg/Imu (")
    assert found.notes == (f"/imu: {found.topics['/imu'].reason}",)


def test_an_empty_log_is_refused(make_bag: Any) -> None:
    with pytest.raises(BagError, match="holds no messages"):
        inspect(make_bag([]))


def test_the_race_log_gives_its_signals(putnam: Path) -> None:
    found = inspect(putnam, 2.9718)
    fields = {name: one.field for name, one in found.signals.items()}
    assert fields["steering_feedback"] == "steering_wheel_angle"
    assert fields["throttle_feedback"] == "pedal_output"
    assert fields["brake_feedback"] == "front_brake_pressure"
    assert found.signals["steering_feedback"].scale == pytest.approx(0.0545 * np.pi / 180, rel=0.2)
    assert suggested(found).commands == "none"
