"""When samples were measured: stamps that are believed, clocks that are apart, frames, and rows between slow samples."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dynssm_ros.errors import BagError
from dynssm_ros.signals import messages
from dynssm_ros.signals.bags import open_bag
from dynssm_ros.signals.extraction import extract
from dynssm_ros.signals.inspection import inspect
from dynssm_ros.signals.resampling import Stream
from dynssm_ros.signals.signal_map import SignalMap, load_signal_map
from dynssm_ros.signals.stamps import Lateness, clean, clock_notes, publishers_note

DEFAULT = load_signal_map("default")
START, SECOND = 1_700_000_000_000_000_000, 1_000_000_000
ODOMETRY, FEEDBACK, COMMAND = messages.ODOMETRY_TOPIC, messages.FEEDBACK_TOPIC, messages.COMMAND_TOPIC


def restamped(records: list[Any], topic: str, move: Any) -> list[Any]:
    """The records with the stamps of a topic moved: ``move(k, stamp)`` of its message ``k`` (ns)."""
    count = 0
    for name, _, _, message in records:
        if name == topic:
            stamp = message.header.stamp
            moved = int(move(count, stamp.sec * SECOND + stamp.nanosec))
            stamp.sec, stamp.nanosec = divmod(moved, SECOND)
            count += 1
    return records


# --- stamps that are believed ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("wrong", "kept"),
    [
        ({100: 3600.0}, 2999),  # an hour ahead
        (dict.fromkeys(range(100, 105), 3600.0), 2995),  # five that agree with each other
        ({0: 3600.0}, 2999),
        ({10: 3600.0, 700: 7200.0, 1500: -3600.0}, 2997),
        (dict.fromkeys(range(2000, 3000), 60.0), 3000),  # time that jumps ahead and stays there
        (dict.fromkeys(range(1000, 3000), -60.0), 2000),  # set back: more samples are on the new time
    ],
)
def test_few_stamps_far_ahead_cost_no_others(wrong: dict[int, float], kept: int) -> None:
    stamps = START + np.arange(3000) * 20_000_000
    for k, seconds in wrong.items():
        stamps[k] += round(seconds * SECOND)
    stream = Stream(stamps, np.arange(3000.0))
    if kept < 3000:
        with pytest.raises(BagError, match="--drop-bad"):
            clean(stream, "here", drop_bad=False)
    found, dropped = clean(stream, "here", drop_bad=True)
    assert len(found.stamps) == kept
    assert (np.diff(found.stamps) > 0).all()
    assert "several nodes" not in dropped


@pytest.mark.parametrize("apart", [-0.013, -0.3, 3600.0])
def test_two_publishers_of_one_topic_are_guessed_from_stamps_that_go_back_and_forth(apart: float) -> None:
    stamps = np.repeat(START + np.arange(300) * 20_000_000, 2)
    stamps[1::2] += round(apart * SECOND)
    _, dropped = clean(Stream(stamps, np.arange(600.0)), "here", drop_bad=True)
    assert "do several nodes publish the topic?" in dropped


# --- what stamps a signal -------------------------------------------------------------------------


@pytest.mark.parametrize(("own", "by"), [("stamp", "stamp"), ("timestamp", "timestamp"), ("moment", "log time")])
def test_a_stamp_of_the_message_itself_counts_and_log_time_is_told(
    tmp_path: Path, drive: Any, typestore: Any, own: str, by: str
) -> None:
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    name, store = "car_msgs/msg/Steering", get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(f"builtin_interfaces/Time {own}\nfloat32 angle\n", name))
    late = 80_000_000
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        kinds = {ODOMETRY: messages.ODOMETRY, FEEDBACK: messages.JOINT_STATE, "/steering": name}
        connections = {topic: writer.add_connection(topic, kind, typestore=store) for topic, kind in kinds.items()}
        for k, (topic, kind, log, message) in enumerate(drive(100)):
            if topic == COMMAND:
                continue
            writer.write(connections[topic], log, bytes(store.serialize_cdr(message, kind)))
            if topic == FEEDBACK:
                steering = store.types[name](message.header.stamp, 0.01 * (k // 3) / 100)
                writer.write(connections["/steering"], log + late, bytes(store.serialize_cdr(steering, name)))
    content = DEFAULT.model_dump()
    content["signals"]["steering_feedback"] = {"topic": "/steering", "type": name, "field": "angle"}
    recording = extract([tmp_path / "bag"], SignalMap.model_validate(content), 25.0)
    assert recording.info.stamped["steering_feedback"] == by
    assert recording.info.stamped["v_x"] == "header"
    delay = (recording["v_x"] - 10.0)[10] - recording["delta_fb"][10] / 0.01
    assert delay == pytest.approx(late / 1e9 if by == "log time" else 0.0, abs=1e-3)
    told = [note for note in recording.info.notes if "count by log time" in note]
    assert bool(told) == (by == "log time")
    assert inspect(tmp_path / "bag").topics["/steering"].stamped == by


@pytest.mark.parametrize("unset", ["all", "some"])
def test_stamps_that_nobody_set_are_replaced_by_log_times(make_bag: Any, drive: Any, unset: str) -> None:
    records = restamped(drive(100), FEEDBACK, lambda k, stamp: 0 if unset == "all" or k % 10 == 3 else stamp)
    recording = extract([make_bag(records)], DEFAULT, 25.0)
    count = {"all": 100, "some": 10}[unset]
    assert f"{FEEDBACK}: {count} of 100 messages have the stamp 0; they count by log time" in recording.info.notes
    assert recording.info.stamped["throttle_feedback"] == {"all": "log time", "some": "header"}[unset]
    np.testing.assert_allclose(recording["delta_fb"], 0.01 * (recording["v_x"] - 10.0), atol=1e-6)


# --- clocks and frames ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("ahead", "told"), [(18.0, "GPS time"), (37.0, "TAI"), (0.3, "another clock"), (-2.5, "after")]
)
def test_odometry_on_another_clock_is_told_by_extract_and_inspect(
    make_bag: Any, drive: Any, ahead: float, told: str
) -> None:
    records = restamped(
        drive(450 if abs(ahead) > 2 else 50, rate=10.0), ODOMETRY, lambda _, stamp: stamp + round(ahead * SECOND)
    )
    bag = make_bag(records)
    info = extract([bag], DEFAULT, 25.0).info
    notes = info.notes
    (clock,) = [each for each in info.findings if each.what.endswith("clock")]
    assert (clock.what, clock.size) == ("inputs_clock", pytest.approx(ahead, abs=0.01))
    content = DEFAULT.model_dump()
    for name in ("throttle_feedback", "steering_feedback"):
        content["signals"][name]["delay"] = -ahead
    said = re.search(r"steering_feedback: delay: (\S+)", clock.remedy)
    assert said is not None
    assert float(said[1]) == pytest.approx(-ahead, abs=0.05)
    mended = extract([bag], SignalMap.model_validate(content), 25.0).info
    assert not [each for each in mended.findings if each.what.endswith("clock")]
    assert any(f"{FEEDBACK} is stamped {abs(ahead):.3g} s" in note and told in note for note in notes)
    assert [note for note in inspect(bag).notes if "is stamped" in note] == [
        note for note in notes if "is stamped" in note
    ]


@pytest.mark.parametrize("every", [1, 5])
def test_positions_of_two_publishers_are_told(every: int) -> None:
    """One follows every message of the other, or every fifth, 5 m beside it."""
    t = np.arange(500) / 50
    own = np.stack([10.0 * t, np.sin(t)]) + 0.02 * np.random.default_rng(0).standard_normal((2, len(t)))
    assert publishers_note("/odom", *own) == []
    both = np.insert(own, np.arange(every, len(t), every), own[:, every::every] + 5.0, axis=1)
    (note,) = publishers_note("/odom", *both)
    assert note.startswith("/odom: x, y jump by 7.")
    assert note.endswith("do several nodes publish it?")
    still = 0.01 * np.random.default_rng(1).standard_normal((2, 500))
    assert publishers_note("/odom", *still) == []


def test_a_clock_that_drifts_is_told_and_what_is_measured_late_is_not() -> None:
    time = np.linspace(0.0, 60.0, 600)
    late = np.random.default_rng(0).exponential(0.02, 600)
    same, slow, drifts = Lateness(time, late), Lateness(time, late + 0.1), Lateness(time, late + 0.005 * time)
    none = Lateness(np.empty(0), np.empty(0))
    assert clock_notes({"odometry": same, "camera": slow, "none": none}, "odometry") == []
    (note,) = clock_notes({"odometry": same, "steering": drifts}, "odometry")
    assert "steering is stamped by a clock that drifts by 0.2 s against odometry's" in note
    assert clock_notes({"odometry": none, "steering": drifts}, "odometry") == []


@pytest.mark.parametrize("change", [{"frame_id": "map"}, {"child_frame_id": "imu"}, {"frame_id": ""}])
def test_frames_that_change_within_a_topic_are_told(make_bag: Any, drive: Any, change: dict[str, str]) -> None:
    records = []
    for k, (topic, kind, log, message) in enumerate(drive(60)):
        if topic == ODOMETRY:
            frames = {"frame_id": "odom", "child_frame_id": "base_link"} | (change if k > 150 else {})
            message.header.frame_id, message.child_frame_id = frames["frame_id"], frames["child_frame_id"]
        records.append((topic, kind, log, message))
    bag = make_bag(records)
    for notes in (extract([bag], DEFAULT, 25.0).info.notes, inspect(bag).notes):
        assert any(f"{ODOMETRY}: its messages are in several frames: odom -> base_link (50)" in note for note in notes)


def test_a_topic_of_two_types_is_read_as_the_commoner_one_and_says_so(
    make_bag: Any, drive: Any, tmp_path: Path
) -> None:
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store, twist = get_typestore(Stores.ROS2_JAZZY), "geometry_msgs/msg/TwistStamped"
    with Writer(tmp_path / "two", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        other = writer.add_connection(FEEDBACK, twist, typestore=store)
        connections: dict[str, Any] = {}
        vector = store.types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
        for k, (topic, kind, log, message) in enumerate(drive(100)):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(connections[topic], log, bytes(store.serialize_cdr(message, kind)))
            if k % 50 == 0:
                wrong = store.types[twist](message.header, store.types["geometry_msgs/msg/Twist"](vector, vector))
                writer.write(other, log, bytes(store.serialize_cdr(wrong, twist)))
    told = f"topic {FEEDBACK}: 6 messages of another type, {twist}, are left out"
    with open_bag(tmp_path / "two") as bag:
        assert (bag.types[FEEDBACK], bag.counts[FEEDBACK]) == (messages.JOINT_STATE, 100)
    assert told in extract([tmp_path / "two"], DEFAULT, 25.0).info.notes
    assert told in inspect(tmp_path / "two").notes


# --- rows between slower samples ------------------------------------------------------------------


@pytest.mark.parametrize(
    ("every", "rate", "share", "told"),
    [(10, 50.0, 0.8, "10"), (4, 100.0, 0.75, "25"), (2, 50.0, None, ""), (5, 25.0, None, "")],
)
def test_rows_between_slower_samples_are_counted_and_the_rate_is_named(
    make_bag: Any, drive: Any, every: int, rate: float, share: float | None, told: str
) -> None:
    odometry = [record for record in drive(401) if record[0] == ODOMETRY][::every]
    bag = make_bag(sorted([*odometry, *[r for r in drive(401) if r[0] != ODOMETRY]], key=lambda record: record[2]))
    info = extract([bag], DEFAULT, rate).info
    if share is None:
        assert (info.interpolated, info.notes) == ({}, ())
        return
    assert info.interpolated == dict.fromkeys(
        ("v_x", "v_y", "omega", "x", "y", "theta"), pytest.approx(share, abs=0.01)
    )
    (note,) = info.notes
    assert f"of the rows lie between samples at {told} Hz" in note
    assert f"(--rate {told})" in note


def test_holes_of_a_fast_signal_are_told_as_holes(make_bag: Any, drive: Any) -> None:
    records = [r for r in drive(401) if not (r[0] == ODOMETRY and 0 < (r[2] - drive(1)[0][2]) % 10**9 < 2 * 10**8)]
    (note,) = extract([make_bag(records)], DEFAULT, 50.0).info.notes
    assert "% of the rows lie in holes of 0.21 s between samples" in note
    assert "max_gap" in note
    assert "--rate" not in note
