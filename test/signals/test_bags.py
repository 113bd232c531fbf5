"""Bags: all ways in which one can be stored are read alike, and all ways in which one can be broken say so."""

from __future__ import annotations

import os
import random
import shutil
import sqlite3
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from dynssm_ros.errors import BagError
from dynssm_ros.signals import messages
from dynssm_ros.signals.bags import BagMessage, copy_topics, open_bag, write_bag

MCAP, SQLITE3 = StoragePlugin.MCAP, StoragePlugin.SQLITE3
ODOMETRY, FEEDBACK, COMMAND = messages.ODOMETRY_TOPIC, messages.FEEDBACK_TOPIC, messages.COMMAND_TOPIC
TOPICS = [ODOMETRY, FEEDBACK, COMMAND]
STORED = {
    "sqlite": (SQLITE3, CompressionMode.NONE),
    "mcap": (MCAP, CompressionMode.NONE),
    "mcap, zstd chunks": (MCAP, CompressionMode.STORAGE),
    "sqlite, zstd file": (SQLITE3, CompressionMode.FILE),
    "mcap, zstd file": (MCAP, CompressionMode.FILE),
    "sqlite, zstd messages": (SQLITE3, CompressionMode.MESSAGE),
    "mcap, zstd messages": (MCAP, CompressionMode.MESSAGE),
}


@pytest.fixture(autouse=True)
def scratch(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Everything temporary goes here, and nothing may be left of it."""
    folder = tmp_path_factory.mktemp("scratch")
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    yield folder
    assert list(folder.iterdir()) == []


def read(path: Path) -> tuple[list[BagMessage], list[str]]:
    with open_bag(path) as bag:
        return list(bag.messages(TOPICS)), bag.notes


def read_or_refused(path: Path, decode: bool = False) -> tuple[list[BagMessage], list[str]]:
    """Messages and notes, or none and the error's line."""
    try:
        with open_bag(path) as bag:
            found = list(bag.messages(TOPICS))
            for message in found if decode else ():
                bag.decode(message.topic, message.raw)
            return found, bag.notes
    except BagError as error:
        return [], [str(error)]


def outcome(file: Path, count: int) -> list[str]:
    """What is said of a cut before the first message, between messages, or through the index behind them."""
    if count == 0:
        return [f"{file.name} holds nothing: not a bag, or cut off before its first message"]
    return [f"recovered {count} messages up to the cut", f"its {count} ROS messages were copied"]


def storage(bag: Path) -> Path:
    (file,) = (file for file in bag.iterdir() if file.name != "metadata.yaml")
    return file


def write_mcap(path: Path, typestore: Any, records: list[Any], profile: str = "ros2", **options: Any) -> Path:
    """An MCAP file by the reference library, which can leave out what rosbags always writes."""
    path.parent.mkdir(exist_ok=True)
    with path.open("wb") as stream:
        writer = McapWriter(stream, **options)
        writer.start(profile=profile)
        channels: dict[str, int] = {}
        for topic, msgtype, log_time, message in records:
            if topic not in channels:
                encoding, text = "protobuf", "none of ours"
                if msgtype in typestore.types:
                    encoding, text = "ros2msg", typestore.generate_msgdef(msgtype, ros_version=2)[0]
                schema = writer.register_schema(msgtype, encoding, text.encode())
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            raw = message if isinstance(message, bytes) else bytes(typestore.serialize_cdr(message, msgtype))
            writer.add_message(channels[topic], log_time, raw, log_time)
        writer.finish()
    return path


# --- whole bags ---------------------------------------------------------------------------------


@pytest.mark.parametrize("form", STORED)
def test_every_form_of_storage_gives_the_same_messages(
    make_bag: Any, drive: Any, typestore: Any, form: str, tmp_path: Path
) -> None:
    records = drive(30)
    bag = make_bag(records, "bag", *STORED[form])
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
    for plugin in (MCAP, SQLITE3):
        found, _ = read(make_bag(records, plugin.name, plugin))
        assert [m.log_time for m in found] == sorted(r[2] for r in records)


@pytest.mark.parametrize("plugin", [MCAP, SQLITE3])
def test_types_that_only_the_bag_describes_are_decoded(make_bag: Any, typestore: Any, plugin: StoragePlugin) -> None:
    header = messages.joint_state(5, {}).header
    pedals = typestore.types["team_msgs/msg/Pedals"](header, 42.5, np.array([1.0, 2.5]))
    with open_bag(make_bag([("/pedals", "team_msgs/msg/Pedals", 5, pedals)], plugin=plugin)) as bag:
        bag.require("/pedals", "team_msgs/msg/Pedals")
        found = bag.decode("/pedals", next(iter(bag.messages(["/pedals"]))).raw)
    assert found.throttle_percent == 42.5
    assert found.brake_kpa.tolist() == [1.0, 2.5]


@pytest.mark.parametrize("plugin", [MCAP, SQLITE3])
def test_an_empty_bag_has_no_messages(make_bag: Any, plugin: StoragePlugin) -> None:
    assert read(make_bag([], plugin=plugin)) == ([], [])
    with open_bag(make_bag([], "topic", plugin, topics={ODOMETRY: messages.ODOMETRY})) as bag:
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
    with open_bag(without_definitions(make_bag(drive(3), plugin=SQLITE3))) as bag:
        bag.require(ODOMETRY, messages.ODOMETRY)
        first = next(iter(bag.messages([ODOMETRY])))
        assert bag.decode(ODOMETRY, first.raw).twist.twist.linear.x == 10.0


def test_a_type_that_nobody_describes_is_told(make_bag: Any, typestore: Any) -> None:
    wheel = typestore.types["team_msgs/msg/Wheel"](3.0, "")
    path = without_definitions(make_bag([("/wheel", "team_msgs/msg/Wheel", 5, wheel)], plugin=SQLITE3))
    with open_bag(path) as bag, pytest.raises(BagError, match="the bag does not describe team_msgs/msg/Wheel"):
        bag.require("/wheel", "team_msgs/msg/Wheel")


@pytest.mark.parametrize("name", ["run#4", "50%20", "why?", "with space", "ümlaut"])
@pytest.mark.parametrize("plugin", [MCAP, SQLITE3])
def test_a_bag_may_have_any_name(make_bag: Any, drive: Any, plugin: StoragePlugin, name: str) -> None:
    bag = make_bag(drive(3), "bag", plugin).rename(tmp := make_bag([], "x").parent / name)
    assert bag == tmp
    found, notes = read(bag)
    assert len(found) == 9
    assert not any("cut off" in note for note in notes)


@pytest.mark.parametrize("form", STORED)
def test_reading_leaves_a_read_only_folder_as_it_is(make_bag: Any, drive: Any, form: str) -> None:
    bag = make_bag(drive(60), "bag", *STORED[form])
    before = {file.name: file.read_bytes() for file in bag.iterdir()}
    bag.chmod(0o555)
    assert len(read(bag)[0]) == 180
    file = storage(bag)
    file.write_bytes(before[file.name][: len(before[file.name]) // 2])
    with suppress(BagError):
        assert read(bag)[1]
    assert {f.name for f in bag.iterdir()} == set(before)
    bag.chmod(0o755)


# --- what is cut off ----------------------------------------------------------------------------


@pytest.mark.parametrize("metadata", [True, False])
@pytest.mark.parametrize("form", STORED)
def test_wherever_a_file_is_cut_the_messages_before_the_cut_are_recovered(
    make_bag: Any, drive: Any, form: str, metadata: bool
) -> None:
    bag = make_bag(drive(150), "bag", *STORED[form])
    if not metadata:
        (bag / "metadata.yaml").unlink()
    whole, file, counts = read(bag)[0], storage(bag), []
    content = file.read_bytes()
    for share in np.linspace(0.0, 0.995, 5 if metadata else 26):
        file.write_bytes(content[: int(share * len(content))])
        found, notes = read_or_refused(bag)
        assert any(said in notes[-1] for said in outcome(file, len(found)))
        assert found == whole[: len(found)], "what is recovered is the beginning"
        counts.append(len(found))
    assert counts == sorted(counts)
    assert counts[0] == 0
    if "file" not in form:  # zstd gives back whole blocks of 128 kB, and this is all in one
        assert counts[len(counts) // 2] > (0 if "chunks" in form else 100)
        assert counts[-1] > 400


@pytest.mark.parametrize("form", ["sqlite, zstd file", "mcap, zstd file"])
def test_a_packed_file_is_recovered_block_by_block(make_bag: Any, drive: Any, form: str) -> None:
    bag = make_bag(drive(600), "bag", *STORED[form])
    whole, file = read(bag)[0], storage(bag)
    content = file.read_bytes()
    for share in (0.4, 0.7, 0.95):
        file.write_bytes(content[: int(share * len(content))])
        found, notes = read(bag)
        assert found == whole[: len(found)]
        assert len(found) > (share - 0.3) * len(whole)
        assert any(said in notes[-1] for said in outcome(file, len(found)))


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("chunks", [True, False])
def test_any_mcap_writer_can_be_cut_off(
    tmp_path: Path, typestore: Any, drive: Any, compression: CompressionType, chunks: bool
) -> None:
    path = tmp_path / "bag.mcap"
    write_mcap(path, typestore, drive(100), compression=compression, use_chunking=chunks, chunk_size=20_000)
    whole, content = read(path)[0], path.read_bytes()
    assert len(whole) == 300
    for share in (0.3, 0.5, 0.7, 0.9):
        path.write_bytes(content[: int(share * len(content))])
        found, notes = read(path)
        assert found == whole[: len(found)]
        assert len(found) > 0.5 * share * len(whole)
        assert any(said in notes[-1] for said in outcome(path, len(found)))


@pytest.mark.parametrize("plugin", [MCAP, SQLITE3])
def test_a_file_that_the_power_cut_filled_with_zeros_is_recovered(make_bag: Any, drive: Any, plugin: Any) -> None:
    bag = make_bag(drive(150), "bag", plugin)
    whole, file = read(bag)[0], storage(bag)
    half = file.stat().st_size // 2
    file.write_bytes(file.read_bytes()[:half] + bytes(half))
    found, notes = read(bag)
    assert found == whole[: len(found)]
    assert len(found) > 150
    assert f"recovered {len(found)} messages up to the cut" in notes[-1]


def split(make_bag: Any, drive: Any, form: str) -> tuple[Path, list[BagMessage]]:
    """A bag of three files, without metadata as after a kill."""
    folder = make_bag([], "split")
    shutil.rmtree(folder)
    folder.mkdir()
    whole: list[BagMessage] = []
    for number in range(3):
        part = make_bag(drive(80, start=10**18 + number * 10**9), f"part{number}", *STORED[form])
        whole += read(part)[0]
        file = storage(part)
        file.rename(folder / f"split_{number}{''.join(file.suffixes)}")
    return folder, whole


@pytest.mark.parametrize("form", ["sqlite", "mcap", "mcap, zstd messages"])
def test_a_cut_off_split_bag_keeps_its_whole_files_and_the_beginning_of_the_last(
    make_bag: Any, drive: Any, form: str
) -> None:
    folder, whole = split(make_bag, drive, form)
    found, notes = read(folder)
    assert (found, len(notes)) == (whole, 1)
    last = sorted(folder.iterdir())[-1]
    last.write_bytes(last.read_bytes()[: int(0.8 * last.stat().st_size)])
    found, notes = read(folder)
    assert found == whole[: len(found)]
    assert 480 < len(found) < 720
    assert f"{last.name} is cut off" in notes[1]
    last.write_bytes(b"")
    found, notes = read(folder)
    assert found == whole[:480]
    assert f"{last.name} holds nothing: not a bag, or cut off before its first message" in notes[1]


def test_what_a_killed_sqlite_recorder_left_in_its_log_is_read(make_bag: Any, drive: Any, tmp_path: Path) -> None:
    records = drive(40)
    whole = read(make_bag(records, "bag", SQLITE3))[0]
    file = storage(tmp_path / "bag")
    killed = tmp_path / "killed"
    killed.mkdir()
    database = sqlite3.connect(file)
    database.execute("PRAGMA journal_mode = WAL")
    database.execute("PRAGMA wal_autocheckpoint = 0")
    rows = database.execute("SELECT * FROM messages WHERE id > 60").fetchall()
    database.execute("DELETE FROM messages WHERE id > 60")
    database.commit()
    database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    database.executemany("INSERT INTO messages VALUES (?, ?, ?, ?)", rows)
    database.commit()
    for name in (file.name, f"{file.name}-wal"):
        shutil.copy(file.parent / name, killed)
    database.close()
    found, notes = read(killed)
    assert found == whole
    assert notes[1:] == [f"{file.name}: its recorder was killed; merged with the log that it left"]
    assert {f.name for f in killed.iterdir()} == {file.name, f"{file.name}-wal"}


def test_a_full_disk_is_not_taken_for_the_cut(make_bag: Any, drive: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    bag = make_bag(drive(20))
    file = storage(bag)
    file.write_bytes(file.read_bytes()[:-100])

    def fail(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(McapWriter, "add_message", fail)
    with pytest.raises(BagError, match=r"cannot be read .*No space left on device"):
        read(bag)


# --- what is without index, metadata or sense ---------------------------------------------------


def test_an_mcap_without_chunks_is_read_in_the_order_of_time(tmp_path: Path, typestore: Any, drive: Any) -> None:
    """The recorder's `fastwrite` preset leaves such files, whose messages are in the order of their arrival."""
    records = drive(30)
    records[10], records[30] = records[30], records[10]
    path = write_mcap(tmp_path / "bag.mcap", typestore, records, use_chunking=False)
    found, notes = read(path)
    assert [m.log_time for m in found] == sorted(r[2] for r in records)
    assert notes == []


@pytest.mark.parametrize(
    "options",
    [
        {"index_types": IndexType.CHUNK},
        {"index_types": IndexType.NONE},
        {"use_statistics": False},
        {"use_summary_offsets": False},
        {"repeat_channels": False, "repeat_schemas": False},
        {"use_chunking": False, "use_statistics": False, "repeat_channels": False, "repeat_schemas": False},
    ],
    ids=str,
)
def test_an_mcap_is_read_whatever_its_writer_left_out(
    tmp_path: Path, typestore: Any, drive: Any, options: dict[str, Any]
) -> None:
    path = write_mcap(tmp_path / "bag.mcap", typestore, drive(50), chunk_size=10_000, **options)
    found, notes = read(path)
    assert len(found) == 150
    assert notes == []


def test_an_mcap_without_index_that_is_damaged_inside_says_so(tmp_path: Path, typestore: Any, drive: Any) -> None:
    path = write_mcap(tmp_path / "bag.mcap", typestore, drive(50), use_chunking=False)
    content = bytearray(path.read_bytes())
    content[len(content) // 2 :: 1000] = b"\xff" * len(content[len(content) // 2 :: 1000])
    path.write_bytes(content)
    found, notes = read_or_refused(path)
    assert len(found) == 150 or "recovered" in notes[-1] or "damaged" in notes[-1]


def test_topics_that_are_not_of_ros_do_not_hide_those_that_are(tmp_path: Path, typestore: Any, drive: Any) -> None:
    foreign = [("/scene", "foxglove.SceneUpdate", 10**18, b"proto")]
    path = write_mcap(tmp_path / "bag.mcap", typestore, foreign + drive(20))
    found, notes = read(path)
    assert len(found) == 60
    assert "its 60 ROS messages were copied" in notes[-1]


def test_a_file_without_the_ros_profile_is_read(tmp_path: Path, typestore: Any, drive: Any) -> None:
    found, notes = read(write_mcap(tmp_path / "bag.mcap", typestore, drive(20), profile=""))
    assert len(found) == 60
    assert "bag.mcap cannot be read as it is (Profile is not ros2.): its 60 ROS messages were copied" in notes


@pytest.mark.parametrize("plugin", [MCAP, SQLITE3])
@pytest.mark.parametrize(
    "metadata",
    ["", "nonsense", "{", "rosbag2_bagfile_information:\n  version: 99\n", "\xff\xfe", "a: &a [*a]\n", "- 1\n"],
)
def test_metadata_that_is_garbage_is_done_without(make_bag: Any, drive: Any, plugin: Any, metadata: str) -> None:
    bag = make_bag(drive(10), "bag", plugin)
    (bag / "metadata.yaml").write_text(metadata, encoding="latin-1")
    found, notes = read(bag)
    assert len(found) == 30
    assert notes[0].startswith("bag: read file by file (")
    assert "\n" not in notes[0]


def test_metadata_that_names_more_files_than_there_are_is_told(make_bag: Any, drive: Any) -> None:
    bag = make_bag(drive(10))
    text = (bag / "metadata.yaml").read_text()
    (bag / "metadata.yaml").write_text(text.replace("- bag.mcap", "- bag.mcap\n  - bag_1.mcap"))
    found, notes = read(bag)
    assert len(found) == 30
    assert "Some database files are missing" in notes[0]
    assert "bag_1.mcap" in notes[0]


def not_bags(folder: Path, typestore: Any) -> dict[str, Path]:
    noise, found = random.Random(5).randbytes(5000), {}
    for name, content in {
        "noise.mcap": noise,
        "noise.db3": noise,
        "noise.bag": noise,
        "noise.mcap.zstd": noise,
        "noise.db3.zstd": noise,
        "empty.mcap": b"",
        "empty.db3": b"",
        "magic.mcap": b"\x89MCAP0\r\n",
        "magic noise.mcap": b"\x89MCAP0\r\n" + noise,
        "magic.db3": b"SQLite format 3\x00",
        "magic noise.db3": b"SQLite format 3\x00" + noise,
        "text.txt": b"hello\n",
        "text.mcap": b"hello\n" * 100,
        "text.db3": b"hello\n" * 100,
    }.items():
        found[name] = folder / name
        found[name].write_bytes(content)
    for name in ("empty folder", "folder of text", "folder of noise"):
        found[name] = folder / name
        found[name].mkdir()
    (found["folder of text"] / "notes.txt").write_text("hello")
    (found["folder of noise"] / "a.mcap").write_bytes(noise)
    (found["folder of noise"] / "b.db3").write_bytes(noise)
    found["other.db3"] = folder / "other.db3"
    with sqlite3.connect(found["other.db3"]) as database:
        database.execute("CREATE TABLE messages (id INTEGER PRIMARY KEY, text TEXT)")
    found["only metadata"] = folder / "only metadata"
    found["only metadata"].mkdir()
    (found["only metadata"] / "metadata.yaml").write_text("rosbag2_bagfile_information: {}\n")
    found["schemaless.mcap"] = write_mcap(folder / "schemaless.mcap", typestore, [("/a", "protobuf", 5, b"x")])
    return found


def test_what_is_not_a_bag_is_told_in_one_line(tmp_path: Path, typestore: Any) -> None:
    for name, path in not_bags(tmp_path, typestore).items():
        with pytest.raises(BagError) as caught:
            read(path)
        assert str(caught.value).startswith(f"{path}: "), name
        assert "not a bag" in str(caught.value) or "cannot be read" in str(caught.value), name
        assert "\n" not in str(caught.value), name
        assert tempfile.gettempdir() not in str(caught.value), name


def test_a_bag_that_is_not_there_is_told(tmp_path: Path) -> None:
    with pytest.raises(BagError, match="nowhere: no such bag"):
        read(tmp_path / "nowhere")


@pytest.mark.parametrize("form", STORED)
def test_flipped_bytes_never_raise_anything_but_a_bag_error(make_bag: Any, drive: Any, form: str) -> None:
    bag = make_bag(drive(25), "bag", *STORED[form])
    file, chance = storage(bag), random.Random(11)
    content = file.read_bytes()
    for _ in range(15):
        damaged = bytearray(content)
        for _ in range(chance.choice([1, 1, 3, 30])):
            damaged[chance.randrange(len(damaged))] = chance.randrange(256)
        file.write_bytes(damaged)
        assert "\n" not in "".join(read_or_refused(bag, decode=True)[1])


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
@pytest.mark.parametrize("plugin", [MCAP, SQLITE3])
def test_a_file_that_may_not_be_read_is_told(make_bag: Any, drive: Any, plugin: StoragePlugin) -> None:
    bag = make_bag(drive(3), "bag", plugin)
    storage(bag).chmod(0)
    with pytest.raises(BagError, match="cannot be read"):
        read(bag)


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
    with pytest.raises(BagError, match="thesis: exists and is not a rosbag2 folder; not replaced"):
        write(precious, drive(5))
    assert (precious / "chapter1.txt").read_text() == "long"


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
    source_path = make_bag([("/wheel", "team_msgs/msg/Wheel", 5, wheel), *drive(3)], plugin=SQLITE3)
    with open_bag(source_path) as source, write_bag(tmp_path / "copy") as sink:
        copy_topics(source, sink)
        for message in source.messages(list(source.types)):
            sink.write_raw(message.topic, message.log_time, message.raw)
    with open_bag(tmp_path / "copy") as copy:
        found = list(copy.messages(["/wheel"]))
        assert copy.decode("/wheel", found[0].raw).note == "left"
        assert copy.counts == {"/wheel": 1} | dict.fromkeys(TOPICS, 3)
