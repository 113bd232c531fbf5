"""ROS 1 bags: the same recordings as rosbag2, under any name, and one line for what cannot be read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag1 import Writer

from dynssm_ros.errors import BagError
from dynssm_ros.signals import messages
from dynssm_ros.signals.bags import copy_topics, open_bag, write_bag
from dynssm_ros.signals.decoding import header_stamp_ns
from dynssm_ros.signals.extraction import extract
from dynssm_ros.signals.inspection import inspect
from dynssm_ros.signals.signal_map import load_signal_map

START = 1_700_000_000_123_456_789
DEFAULT = load_signal_map("default")


@pytest.mark.parametrize("compression", [None, Writer.CompressionFormat.BZ2, Writer.CompressionFormat.LZ4])
def test_the_recording_is_that_of_the_same_messages_in_a_rosbag2(
    make_bag: Any, make_ros1_bag: Any, drive: Any, compression: Any
) -> None:
    ours, theirs = (extract([make(drive(50))], DEFAULT, 40.0) for make in (make_bag, make_ros1_bag))
    again = extract([make_ros1_bag(drive(50), compression=compression)], DEFAULT, 40.0)
    for found in (theirs, again):
        np.testing.assert_array_equal(found.matrix, ours.matrix)
        np.testing.assert_array_equal(found.time, ours.time)


@pytest.mark.parametrize("name", ["log", "log.mcap", "drive 7.csv", "a#b?.db3"])
def test_what_a_file_is_follows_from_its_content(make_ros1_bag: Any, drive: Any, name: str) -> None:
    found = inspect(make_ros1_bag(drive(20), name))
    assert found.name == name
    assert found.missing == ()


@pytest.mark.parametrize("name", ["log", "run.bag", "log.csv"])
def test_a_rosbag2_file_may_have_any_name_too(make_bag: Any, drive: Any, tmp_path: Path, name: str) -> None:
    (stored,) = make_bag(drive(20)).glob("*.mcap")
    whole, cut = stored.rename(tmp_path / name), tmp_path / f"cut_{name}"
    cut.write_bytes(whole.read_bytes()[:-200])
    assert inspect(whole).notes == ()
    assert all(str(whole.parent) not in note for note in inspect(cut).notes)


def test_headers_lose_their_seq_and_copies_are_of_ros_2(make_ros1_bag: Any, drive: Any, tmp_path: Path) -> None:
    with open_bag(make_ros1_bag(drive(3))) as bag, write_bag(tmp_path / "copy") as sink:
        copy_topics(bag, sink)
        for message in bag.messages(list(bag.types)):
            sink.write_raw(*message)
    with open_bag(tmp_path / "copy") as copy:
        decoded = [copy.decode(topic, raw) for topic, _, raw in copy.messages([messages.ODOMETRY_TOPIC])]
    assert [header_stamp_ns(one) for one in decoded] == [START + k * 10_000_000 for k in range(3)]
    assert not hasattr(decoded[0].header, "seq")


def test_types_of_a_team_are_those_that_the_bag_describes(make_ros1_bag: Any, typestore: Any) -> None:
    wheel = typestore.types["team_msgs/msg/Wheel"](angle_deg=7.5, note="x")
    with open_bag(make_ros1_bag([("/wheel", "team_msgs/msg/Wheel", 5, wheel)])) as bag:
        ((topic, log_time, raw),) = bag.messages(["/wheel"])
        assert (log_time, bag.decode(topic, raw).angle_deg) == (5, 7.5)


def test_a_message_that_is_none_is_told_with_its_topic(make_ros1_bag: Any, drive: Any) -> None:
    path = make_ros1_bag([*drive(2), (messages.ODOMETRY_TOPIC, messages.ODOMETRY, START + 10**8, b"abc")])
    with pytest.raises(BagError, match=r"run.bag: topic /vehicle/odometry: a message is not a nav_msgs/msg/Odometry"):
        extract([path], DEFAULT, 40.0)


@pytest.mark.parametrize("compression", [Writer.CompressionFormat.BZ2, Writer.CompressionFormat.LZ4])
def test_chunks_that_unpack_to_far_more_than_their_size_are_refused(
    make_ros1_bag: Any, monkeypatch: pytest.MonkeyPatch, compression: Any
) -> None:
    path = make_ros1_bag([("/camera", "sensor_msgs/msg/Image", START, bytes(3_000_000))], compression=compression)
    assert inspect(path).topics["/camera"].count == 1
    monkeypatch.setattr("dynssm_ros.signals.recover._UNPACKED", 1 << 20)
    with pytest.raises(
        BagError, match=r"run.bag: damaged, reading stopped \(unpacks to more than|a ROS 1 bag that cannot"
    ):
        inspect(path)


@pytest.mark.parametrize("left", [10, 100, 5000, -100])
def test_a_bag_that_was_cut_off_ends_in_one_line(make_ros1_bag: Any, drive: Any, tmp_path: Path, left: int) -> None:
    cut = tmp_path / "cut.bag"
    cut.write_bytes(make_ros1_bag(drive(20)).read_bytes()[:left])
    with pytest.raises(BagError, match=r"cut.bag: a ROS 1 bag that cannot be read .*rosbag reindex"):
        extract([cut], DEFAULT, 40.0)
