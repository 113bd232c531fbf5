"""The recover of SQLite pages against SQLite itself, whatever the sizes."""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import storage_mcap

from dynssm_ros.errors import BagError
from dynssm_ros.signals.bags import open_bag
from dynssm_ros.signals.recover import has_vast_chunk, is_unindexed, log_left, recover, unpack, unpacked_message

Row = tuple[int, int, int, bytes]
TABLES = """
CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL);
CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL);
CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL,
                      data BLOB NOT NULL);
CREATE INDEX timestamp_idx ON messages (timestamp ASC);
INSERT INTO schema VALUES (3, 'jazzy');
"""


def make(path: Path, page_size: int, rows: list[Row]) -> None:
    path.unlink(missing_ok=True)
    with closing(sqlite3.connect(path)) as database:
        database.execute(f"PRAGMA page_size = {page_size}")
        database.executescript(TABLES)
        topics = [(number, f"/t{number}", "a/msg/B") for number in {row[1] for row in rows}]
        database.executemany("INSERT INTO topics VALUES (?, ?, ?)", topics)
        database.executemany("INSERT INTO messages VALUES (?, ?, ?, ?)", rows)
        database.commit()


def rows_of(path: Path) -> list[Row]:
    with closing(sqlite3.connect(path)) as database:
        return database.execute("SELECT * FROM messages ORDER BY id").fetchall()


def recovered(path: Path, share: float = 1.0) -> list[Row]:
    cut, saved = path.with_suffix(".cut.db3"), path.with_suffix(".saved.db3")
    content = path.read_bytes()
    cut.write_bytes(content[: int(share * len(content))])
    saved.unlink(missing_ok=True)
    count, complete, _ = recover(cut, saved)
    assert not complete
    found = rows_of(saved) if count else []
    assert len(found) == count
    return found


integers = st.one_of(st.integers(-3, 300), st.integers(-(2**63), 2**63 - 1))


@settings(deadline=None, max_examples=25)
@given(
    st.lists(st.tuples(st.integers(0, 400), integers, st.integers(0, 9000)), min_size=1, max_size=30),
    st.sampled_from([512, 1024, 4096, 65536]),
)
def test_rows_of_any_size_come_out_of_pages_of_any_size(
    tmp_path_factory: pytest.TempPathFactory, drawn: list[tuple[int, int, int]], page_size: int
) -> None:
    path = tmp_path_factory.mktemp("pages") / "bag.db3"
    rows = [
        (number, topic, stamp, bytes(k % 251 for k in range(number, number + size)))
        for number, (topic, stamp, size) in enumerate(drawn, 1)
    ]
    make(path, page_size, rows)
    assert rows_of(path) == rows
    assert recovered(path) == rows


@pytest.mark.parametrize("page_size", [512, 4096])
def test_sizes_around_the_overflow_of_a_page_come_out_whole(tmp_path: Path, page_size: int) -> None:
    path = tmp_path / "bag.db3"
    sizes = [*range(page_size - 60, page_size + 5), *range(page_size * 2 - 30, page_size * 2), 100_000]
    rows = [(number, 1, number, bytes([number % 256]) * size) for number, size in enumerate(sizes, 1)]
    make(path, page_size, rows)
    assert recovered(path) == rows


@pytest.mark.parametrize("size", [60, 700, 9000])
def test_a_cut_leaves_the_beginning_where_the_tree_has_grown_branches(tmp_path: Path, size: int) -> None:
    """With small pages the tree of 3000 rows has several levels, and its upper branches lie behind the cut."""
    path = tmp_path / "bag.db3"
    rows = [(number, 1 + number % 3, 10**18 + number, bytes([number % 256]) * size) for number in range(1, 3001)]
    make(path, 512 if size < 100 else 4096, rows)
    counts = []
    for share in (0.05, 0.25, 0.5, 0.75, 0.95, 1.0):
        found = recovered(path, share)
        assert found == rows[: len(found)]
        counts.append(len(found) / len(rows))
    assert counts[-1] == 1.0
    assert all(count > 0.9 * share - 0.02 for count, share in zip(counts, (0.05, 0.25, 0.5, 0.75, 0.95), strict=False))


def test_other_tables_and_other_databases_give_nothing(tmp_path: Path) -> None:
    path = tmp_path / "bag.db3"
    with closing(sqlite3.connect(path)) as database:
        database.execute("CREATE TABLE messages (id INTEGER PRIMARY KEY, a INTEGER, b INTEGER, c BLOB)")
        database.execute("INSERT INTO messages VALUES (1, 2, 3, x'00')")
        database.commit()
    assert recovered(path) == []


def test_only_mcap_files_can_lack_an_index_and_only_sqlite_leaves_logs(tmp_path: Path) -> None:
    for name in ("a.db3", "a.mcap", "a.db3-wal"):
        (tmp_path / name).write_bytes(b"x")
    assert not is_unindexed(tmp_path / "a.db3")
    assert not is_unindexed(tmp_path / "a.mcap")
    assert log_left(tmp_path / "a.db3")
    assert not log_left(tmp_path / "a.mcap")


def test_messages_that_are_not_compressed_are_left_alone() -> None:
    raw = b"\x00\x01\x00\x00payload"
    assert unpacked_message(raw) is raw


def test_what_unpacks_to_far_more_than_it_is_is_refused_before_it_fills_memory_or_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dynssm_ros.signals.recover._UNPACKED", 1 << 20)
    bomb = bytes(pa.compress(bytes(10 << 20), "zstd"))
    assert len(bomb) < 10_000
    with pytest.raises(OSError, match=f"unpacks to more than {1 << 20} bytes"):
        unpacked_message(bomb)
    assert unpacked_message(bytes(pa.compress(bytes(1 << 20), "zstd"))) == bytes(1 << 20)
    (tmp_path / "log.mcap.zstd").write_bytes(bomb)
    with pytest.raises(OSError, match="unpacks to more"):
        unpack(tmp_path / "log.mcap.zstd", tmp_path / "log.mcap")
    assert (tmp_path / "log.mcap").stat().st_size <= 1 << 20
    with (
        pytest.raises(BagError, match=r"log.mcap.zstd: cannot be read \(unpacks to more"),
        open_bag(tmp_path / "log.mcap.zstd"),
    ):
        pass


@pytest.mark.parametrize("codec", ["zstd", "lz4"])
@pytest.mark.parametrize("said", [1000, 1001])
def test_of_a_chunk_no_more_is_unpacked_than_its_index_says(codec: str, said: int) -> None:
    """Whatever the size in the index is: the content itself is 10 MB, then as long as it says."""
    packed = pa.compress(bytes(10 << 20), codec=codec, asbytes=True)
    with pytest.raises(OSError, match=f"unpacks to more than {said} bytes"):
        storage_mcap.decompress(packed, codec, said, 0)
    packed = pa.compress(bytes(said), codec=codec, asbytes=True)
    assert storage_mcap.decompress(packed, codec, said, 0) == bytes(said)


def test_a_chunk_that_is_larger_than_its_index_says_is_left_out(tmp_path: Path) -> None:
    file = packed_log(tmp_path / "log.mcap", (2000, 1 << 20, 2000))
    content = file.read_bytes()
    size = struct.pack("<Q", 31 + (1 << 20))
    assert content.count(size) == 2
    file.write_bytes(content.replace(size, struct.pack("<Q", 5000)))
    with open_bag(file) as bag:
        assert len(list(bag.messages(["/a"]))) == 2
        assert "recovered 2 messages" in bag.notes[-1]


def packed_log(file: Path, lengths: Sequence[int]) -> Path:
    """Messages of zeros, each in a chunk of its own."""
    with file.open("wb") as sink:
        writer = McapWriter(sink, chunk_size=1000, compression=CompressionType.ZSTD)
        writer.start(profile="ros2")
        channel = writer.register_channel(
            "/a", "cdr", writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        )
        for stamp, length in enumerate(lengths):
            writer.add_message(channel, stamp, bytes(length), stamp)
        writer.finish()
    return file


@pytest.mark.parametrize("indexed", [True, False])
def test_a_chunk_that_unpacks_to_far_more_than_it_is_is_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, indexed: bool
) -> None:
    file = packed_log(tmp_path / "log.mcap", (2000, 10 << 20, 2000))
    assert not has_vast_chunk(file)
    monkeypatch.setattr("dynssm_ros.signals.recover._UNPACKED", 1 << 20)
    assert has_vast_chunk(file)
    if not indexed:
        content = file.read_bytes()
        file.write_bytes(content[: content.rindex(b"/a")])
        assert not has_vast_chunk(file)
    assert recover(file, tmp_path / "mended.mcap").messages == 2
    with open_bag(file) as bag:
        assert "recovered 2 messages" in bag.notes[-1]
