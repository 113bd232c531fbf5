"""Bags: all ways in which one can be stored are read alike, and what is written is read back."""

from __future__ import annotations

import random
import sqlite3
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dynssm_ros.errors import BagError, UserError
from dynssm_ros.files import protecting
from dynssm_ros.signals import messages
from dynssm_ros.signals.bags import BagMessage, copy_topics, open_bag, write_bag

ODOMETRY, FEEDBACK, COMMAND = messages.ODOMETRY_TOPIC, messages.FEEDBACK_TOPIC, messages.COMMAND_TOPIC
TOPICS = [ODOMETRY, FEEDBACK, COMMAND]


def read(path: Path) -> tuple[list[BagMessage], list[str]]:
    with open_bag(path) as bag:
        return list(bag.messages(TOPICS)), bag.notes


def storage(bag: Path) -> Path:
    (file,) = (file for file in bag.iterdir() if file.name != "metadata.yaml")
    return file


# --- whole bags ---------------------------------------------------------------------------------


def test_every_form_of_storage_gives_the_same_messages(
    make_bag: Any, drive: Any, typestore: Any, form: str, tmp_path: Path
) -> None:
    records = drive(30)
    bag = make_bag(records, "bag", form)
    expected = [(t, log, bytes(typestore.serialize_cdr(m, kind))) for t, kind, log, m in records]
    found, notes = read(bag)
    assert found == expected
    assert notes == []
    (bag / "metadata.yaml").unlink()
    found, notes = read(bag)
    assert found == expected
    assert notes == ["bag: read file by file (there is no metadata.yaml)"]
    assert read(storage(bag)) == (expected, [])


def test_a_bag_tells_its_topics_types_and_counts(make_bag: Any, drive: Any) -> None:
    with open_bag(make_bag(drive(10))) as bag:
        assert bag.types == {
            ODOMETRY: "nav_msgs/msg/Odometry",
            FEEDBACK: "sensor_msgs/msg/JointState",
            COMMAND: "sensor_msgs/msg/JointState",
        }
        assert bag.counts == dict.fromkeys(TOPICS, 10)
        assert [m.topic for m in bag.messages([FEEDBACK])] == [FEEDBACK] * 10
        assert list(bag.messages(["/other"])) == []
        message = bag.decode(ODOMETRY, next(iter(bag.messages([ODOMETRY]))).raw)
        assert message.twist.twist.linear.x == 10.0


def test_messages_come_in_the_order_of_their_log_times(make_bag: Any, drive: Any) -> None:
    records = drive(40)
    random.Random(1).shuffle(records)
    for form in ("mcap", "sqlite"):
        found, _ = read(make_bag(records, form, form))
        assert [m.log_time for m in found] == sorted(r[2] for r in records)


@pytest.mark.parametrize("form", ["mcap", "sqlite"])
def test_types_that_only_the_bag_describes_are_decoded(make_bag: Any, typestore: Any, form: str) -> None:
    header = messages.joint_state(5, {}).header
    pedals = typestore.types["team_msgs/msg/Pedals"](header, 42.5, np.array([1.0, 2.5]))
    with open_bag(make_bag([("/pedals", "team_msgs/msg/Pedals", 5, pedals)], form=form)) as bag:
        bag.require("/pedals", "team_msgs/msg/Pedals")
        found = bag.decode("/pedals", next(iter(bag.messages(["/pedals"]))).raw)
    assert found.throttle_percent == 42.5
    assert found.brake_kpa.tolist() == [1.0, 2.5]


@pytest.mark.parametrize("form", ["mcap", "sqlite"])
def test_an_empty_bag_has_no_messages(make_bag: Any, form: str) -> None:
    assert read(make_bag([], form=form)) == ([], [])
    with open_bag(make_bag([], "topic", form, topics={ODOMETRY: messages.ODOMETRY})) as bag:
        assert bag.counts == {ODOMETRY: 0}
        assert list(bag.messages([ODOMETRY])) == []


def test_what_is_asked_of_a_bag_must_be_there(make_bag: Any, drive: Any) -> None:
    bag_path = make_bag(drive(2))
    with open_bag(bag_path) as bag:
        bag.require(ODOMETRY, messages.ODOMETRY)
        with pytest.raises(BagError, match=rf"^{bag_path}: topic /speed is missing; the bag has /vehicle/actuator_c"):
            bag.require("/speed", "std_msgs/msg/Float64")
        with pytest.raises(BagError, match=rf"topic {ODOMETRY} has type nav_msgs/msg/Odometry; .* expects a/msg/B"):
            bag.require(ODOMETRY, "a/msg/B")
        for raw in (b"", b"\x00\x01\x00\x00", b"\xff" * 50):
            with pytest.raises(BagError, match=rf"topic {ODOMETRY}: a message is not a nav_msgs/msg/Odometry"):
                bag.decode(ODOMETRY, raw)
    with open_bag(make_bag([], "none")) as bag, pytest.raises(BagError, match="the bag has no topics"):
        bag.require(ODOMETRY, messages.ODOMETRY)


def without_definitions(bag: Path) -> Path:
    """The bag as an older recorder would have written it, without message definitions."""
    with sqlite3.connect(storage(bag)) as database:
        database.execute("DELETE FROM message_definitions")
    return storage(bag)


def test_common_types_are_known_also_where_the_bag_does_not_describe_them(make_bag: Any, drive: Any) -> None:
    with open_bag(without_definitions(make_bag(drive(3), form="sqlite"))) as bag:
        bag.require(ODOMETRY, messages.ODOMETRY)
        first = next(iter(bag.messages([ODOMETRY])))
        assert bag.decode(ODOMETRY, first.raw).twist.twist.linear.x == 10.0


def test_a_type_that_nobody_describes_is_told(make_bag: Any, typestore: Any) -> None:
    wheel = typestore.types["team_msgs/msg/Wheel"](3.0, "")
    path = without_definitions(make_bag([("/wheel", "team_msgs/msg/Wheel", 5, wheel)], form="sqlite"))
    with open_bag(path) as bag, pytest.raises(BagError, match="the bag does not describe team_msgs/msg/Wheel"):
        bag.require("/wheel", "team_msgs/msg/Wheel")


@pytest.mark.parametrize("name", ["run#4", "50%20", "why?", "with space", "ümlaut"])
@pytest.mark.parametrize("form", ["mcap", "sqlite"])
def test_a_bag_may_have_any_name(make_bag: Any, drive: Any, form: str, name: str) -> None:
    bag = make_bag(drive(3), "bag", form).rename(tmp := make_bag([], "x").parent / name)
    assert bag == tmp
    found, notes = read(bag)
    assert len(found) == 9
    assert not any("cut off" in note for note in notes)


def test_reading_leaves_a_read_only_folder_as_it_is(make_bag: Any, drive: Any, form: str) -> None:
    bag = make_bag(drive(60), "bag", form)
    before = {file.name: file.read_bytes() for file in bag.iterdir()}
    bag.chmod(0o555)
    assert len(read(bag)[0]) == 180
    file = storage(bag)
    file.write_bytes(before[file.name][: len(before[file.name]) // 2])
    with suppress(BagError):
        assert read(bag)[1]
    assert {f.name for f in bag.iterdir()} == set(before)
    bag.chmod(0o755)


# --- writing ------------------------------------------------------------------------------------


def write(path: Path, records: list[Any], then: Callable[[], None] = lambda: None) -> None:
    with write_bag(path) as bag:
        for topic in TOPICS:
            bag.add_topic(topic, messages.ODOMETRY if topic == ODOMETRY else messages.JOINT_STATE)
        for topic, _, log_time, message in records:
            bag.write(topic, log_time, message)
        then()


def test_what_is_written_is_read_back(tmp_path: Path, drive: Any, typestore: Any) -> None:
    records = drive(20)
    write(tmp_path / "deep" / "bag", records)
    found, notes = read(tmp_path / "deep" / "bag")
    assert found == [(t, log, bytes(typestore.serialize_cdr(m, kind))) for t, kind, log, m in records]
    assert notes == []
    assert sorted(f.name for f in (tmp_path / "deep").rglob("*")) == ["bag", "bag.mcap", "metadata.yaml"]


def test_a_bag_is_replaced_but_nothing_else_is(tmp_path: Path, drive: Any) -> None:
    write(tmp_path / "bag", drive(5))
    write(tmp_path / "bag", drive(7))
    assert len(read(tmp_path / "bag")[0]) == 21
    precious = tmp_path / "thesis"
    precious.mkdir()
    (precious / "chapter1.txt").write_text("long")
    with pytest.raises(UserError, match="thesis: exists and is not a bag that dynssm wrote; not replaced"):
        write(precious, drive(5))
    assert (precious / "chapter1.txt").read_text() == "long"
    raw = tmp_path / "bag" / "metadata.yaml"
    raw.write_text(raw.read_text().replace("dynssm_ros", "recorder"))
    with pytest.raises(UserError, match="bag: exists and is not a bag that dynssm wrote"):
        write(tmp_path / "bag", drive(5))
    with protecting([], force=True):
        write(tmp_path / "bag", drive(5))
    assert len(read(tmp_path / "bag")[0]) == 15


def test_a_bag_whose_writing_fails_leaves_the_older_one(tmp_path: Path, drive: Any) -> None:
    write(tmp_path / "bag", drive(5))

    def fail() -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write(tmp_path / "bag", drive(50), fail)
    assert len(read(tmp_path / "bag")[0]) == 15
    assert [f.name for f in tmp_path.iterdir()] == ["bag"]


def test_topics_are_copied_with_the_types_that_the_bag_describes(
    make_bag: Any, typestore: Any, tmp_path: Path, drive: Any
) -> None:
    wheel = typestore.types["team_msgs/msg/Wheel"](3.0, "left")
    source_path = make_bag([("/wheel", "team_msgs/msg/Wheel", 5, wheel), *drive(3)], form="sqlite")
    with open_bag(source_path) as source, write_bag(tmp_path / "copy") as sink:
        copy_topics(source, sink)
        for message in source.messages(list(source.types)):
            sink.write_raw(message.topic, message.log_time, message.raw)
    with open_bag(tmp_path / "copy") as copy:
        found = list(copy.messages(["/wheel"]))
        assert copy.decode("/wheel", found[0].raw).note == "left"
        assert copy.counts == {"/wheel": 1} | dict.fromkeys(TOPICS, 3)


def test_a_folder_named_like_a_ros_1_bag_is_read_without_a_note(tmp_path: Path, drive: Any) -> None:
    write(tmp_path / "run.bag", drive(5))
    with open_bag(tmp_path / "run.bag") as bag:
        assert bag.notes == []
        assert len(list(bag.messages(TOPICS))) == 15
