"""Broken bags: what lies before a cut is recovered, what lacks is done without, and the rest is told in one line."""

from __future__ import annotations

import random
import shutil
import sqlite3
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter

from dynssm_ros.errors import BagError
from dynssm_ros.signals import messages
from dynssm_ros.signals.bags import BagMessage, open_bag

ODOMETRY, FEEDBACK, COMMAND = messages.ODOMETRY_TOPIC, messages.FEEDBACK_TOPIC, messages.COMMAND_TOPIC
TOPICS = [ODOMETRY, FEEDBACK, COMMAND]


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


# --- what is cut off ----------------------------------------------------------------------------


@pytest.mark.parametrize("metadata", [True, False])
def test_wherever_a_file_is_cut_the_messages_before_the_cut_are_recovered(
    make_bag: Any, drive: Any, form: str, metadata: bool
) -> None:
    bag = make_bag(drive(150), "bag", form)
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
    bag = make_bag(drive(600), "bag", form)
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


@pytest.mark.parametrize("form", ["mcap", "sqlite"])
def test_a_file_that_the_power_cut_filled_with_zeros_is_recovered(make_bag: Any, drive: Any, form: str) -> None:
    bag = make_bag(drive(150), "bag", form)
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
        part = make_bag(drive(80, start=10**18 + number * 10**9), f"part{number}", form)
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
    whole = read(make_bag(records, "bag", "sqlite"))[0]
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


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("place", [0.0, 0.5, 0.9])
def test_a_bad_chunk_costs_its_own_messages_alone(
    tmp_path: Path, typestore: Any, drive: Any, compression: CompressionType, place: float
) -> None:
    path = write_mcap(tmp_path / "bag.mcap", typestore, drive(300), chunk_size=10_000, compression=compression)
    whole, _ = read(path)
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    chunks = sorted(summary.chunk_indexes, key=lambda chunk: chunk.chunk_start_offset)
    chunk = chunks[int(place * len(chunks))]
    content = bytearray(path.read_bytes())
    content[chunk.chunk_start_offset + chunk.chunk_length - 20] ^= 0xFF
    path.write_bytes(content)
    found, notes = read(path)
    lost = [m for m in whole if chunk.message_start_time <= m.log_time <= chunk.message_end_time]
    assert [m for m in whole if m not in lost] == [
        m for m in found if not chunk.message_start_time <= m.log_time <= chunk.message_end_time
    ]
    assert 0 < len(whole) - len(found) <= len(lost) < len(whole) / 2
    assert notes == [
        "bag.mcap is damaged (1 of its chunks is not what the checksum says): "
        f"recovered {len(found)} messages of the other chunks"
    ]


def test_topics_that_are_not_of_ros_do_not_hide_those_that_are(tmp_path: Path, typestore: Any, drive: Any) -> None:
    foreign = [("/scene", "foxglove.SceneUpdate", 10**18, b"proto")]
    path = write_mcap(tmp_path / "bag.mcap", typestore, foreign + drive(20))
    found, notes = read(path)
    assert len(found) == 60
    assert "its 60 ROS messages were copied" in notes[-1]


def test_messages_of_ros_1_in_mcap_are_told(tmp_path: Path) -> None:
    """As `mcap convert` makes them of a ROS 1 bag."""
    with (tmp_path / "old.mcap").open("wb") as stream:
        writer = McapWriter(stream)
        writer.start(profile="ros1")
        schema = writer.register_schema("std_msgs/Float64", "ros1msg", b"float64 data")
        writer.add_message(writer.register_channel("/a", "ros1", schema), 1, bytes(8), 1)
        writer.finish()
    with pytest.raises(BagError, match=r"old.mcap holds messages of ROS 1: take the .bag that it was made of"):
        read(tmp_path / "old.mcap")


def test_a_file_without_the_ros_profile_is_read(tmp_path: Path, typestore: Any, drive: Any) -> None:
    found, notes = read(write_mcap(tmp_path / "bag.mcap", typestore, drive(20), profile=""))
    assert len(found) == 60
    assert "bag.mcap cannot be read as it is (Profile is not ros2.): its 60 ROS messages were copied" in notes


@pytest.mark.parametrize("form", ["mcap", "sqlite"])
@pytest.mark.parametrize(
    "metadata",
    ["", "nonsense", "{", "rosbag2_bagfile_information:\n  version: 99\n", "\xff\xfe", "a: &a [*a]\n", "- 1\n"],
)
def test_metadata_that_is_garbage_is_done_without(make_bag: Any, drive: Any, form: str, metadata: str) -> None:
    bag = make_bag(drive(10), "bag", form)
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
    with pytest.raises(BagError, match="nowhere: no such file"):
        read(tmp_path / "nowhere")


def test_flipped_bytes_never_raise_anything_but_a_bag_error(make_bag: Any, drive: Any, form: str) -> None:
    bag = make_bag(drive(25), "bag", form)
    file, chance = storage(bag), random.Random(11)
    content = file.read_bytes()
    for _ in range(15):
        damaged = bytearray(content)
        for _ in range(chance.choice([1, 1, 3, 30])):
            damaged[chance.randrange(len(damaged))] = chance.randrange(256)
        file.write_bytes(damaged)
        assert "\n" not in "".join(read_or_refused(bag, decode=True)[1])


@pytest.mark.parametrize("form", ["mcap", "sqlite"])
def test_what_may_not_be_read_is_told(make_bag: Any, drive: Any, form: str, monkeypatch: pytest.MonkeyPatch) -> None:
    bag = make_bag(drive(3), "bag", form)

    def forbid(path: Path, *_: Any, **__: Any) -> Any:
        raise PermissionError(13, "Permission denied", str(path))

    for method in ("open", "iterdir"):
        with monkeypatch.context() as forbidden:
            forbidden.setattr(Path, method, forbid)
            _, said = read_or_refused(bag)
        assert said[-1].startswith(f"{bag}: cannot be read ([Errno 13] Permission denied")
