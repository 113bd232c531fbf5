"""What can be read of a storage file that a killed recorder, an interrupted copy or a bad disk left behind.

A file that was cut off has no index, or one that points behind the cut, so its records are found one by one and copied
to a new file. What the cut goes through is left out, and so is a chunk that is not what its checksum says.
"""

from __future__ import annotations

import io
import mmap
import os
import shutil
import sqlite3
import struct
import zlib
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path
from typing import IO, Any, NamedTuple, TypeVar
from urllib.parse import quote

import pyarrow as pa
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel, DataEnd, Message, Schema
from mcap.summary import Summary
from mcap.writer import Writer as McapWriter

SQLITE_LOGS = ("-wal", "-journal")
_HEAD = 9  # bytes in front of an MCAP record: what it is, and its length
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_ROS1_CODECS = {b"BZh": "bz2", b"\x04\x22\x4d\x18": "lz4"}
_UNPACKED, _RATIO = 64 << 20, 100  # bytes that may always be unpacked, and times the packed size
_CELL_BYTES = 8  # of a column of a table in memory, however it is packed
_ROS_ENCODINGS = ("ros2msg", "ros2idl", "omgidl", "")
_RECORDS: dict[int, Any] = {Opcode.SCHEMA: Schema, Opcode.CHANNEL: Channel, Opcode.DATA_END: DataEnd}
_TABLE_LEAF = 0x0D
_TABLES = ("schema", "metadata", "topics", "message_definitions", "messages")
_T = TypeVar("_T")


class Recovered(NamedTuple):
    """How many messages were copied, whether the end was reached without meeting a cut, and chunks that were left out."""

    messages: int
    complete: bool
    bad_chunks: int = 0


_McapRecord = Schema | Channel | Message | DataEnd | None
"""``None`` stands for a chunk that is left out."""


def recover(damaged: Path, recovered: Path) -> Recovered:
    """Copies the ROS messages before the cut of a ``.mcap`` or ``.db3`` file to ``recovered``, with an index.

    Raises:
        OSError: ``damaged`` cannot be read or ``recovered`` not be written.
    """
    return _recover_mcap(damaged, recovered) if damaged.suffix == ".mcap" else _recover_sqlite(damaged, recovered)


def bad_chunks(file: Path) -> int:
    """How many chunks of an indexed MCAP file are not what their checksums say."""
    if file.suffix != ".mcap" or (summary := _index(file)) is None:
        return 0
    with file.open("rb") as source:
        return sum(content is None for content in _chunks(source, summary))


def is_unindexed(file: Path) -> bool:
    """Whether ``file`` is a whole MCAP file without the index that reading in the order of time needs."""
    if file.suffix != ".mcap":
        return False
    try:
        summary = _read_summary(file)
    except Exception:  # damaged, which its reader will say better
        return False
    if summary is None:
        return True
    empty = summary.statistics is not None and summary.statistics.message_count == 0
    return not empty and not (summary.chunk_indexes and all(c.message_index_offsets for c in summary.chunk_indexes))


def has_vast_chunk(file: Path) -> bool:
    """Whether an indexed MCAP file says of a chunk that it unpacks to far more than a log's can."""
    summary = _index(file) if file.suffix == ".mcap" else None
    chunks = [] if summary is None else summary.chunk_indexes
    return any(chunk.uncompressed_size > largest_unpacked(chunk.compressed_size) for chunk in chunks)


def is_short(file: Path) -> bool:
    """Whether a SQLite file is shorter than its header says, which SQLite may notice only in the middle of reading."""
    if file.suffix != ".db3":
        return False
    with file.open("rb") as stream:
        header = stream.read(100)
    pages = int.from_bytes(header[28:32], "big") if header[24:28] == header[92:96] else 0
    return header.startswith(b"SQLite format 3\0") and file.stat().st_size < pages * _page_size(header)


def log_left(file: Path) -> bool:
    """Whether a killed recorder left a SQLite log beside ``file`` that holds what is not yet in it."""
    logs = (Path(f"{file}{suffix}") for suffix in SQLITE_LOGS)
    return file.suffix == ".db3" and any(os.path.isfile(log) and log.stat().st_size > 0 for log in logs)


def merge_log(file: Path, merged: Path) -> None:
    """Copies a SQLite file with the logs beside it, and merges them; a log that is damaged itself is left out.

    Raises:
        OSError: cannot be copied.
    """
    for suffix in ("", *SQLITE_LOGS):
        if os.path.isfile(f"{file}{suffix}"):
            shutil.copyfile(f"{file}{suffix}", f"{merged}{suffix}")
    with closing(sqlite3.connect(merged)) as database, suppress(sqlite3.DatabaseError):
        database.execute("PRAGMA journal_mode = DELETE")


def unpack(compressed: Path, unpacked: Path) -> None:
    """Unpacks a zstd file as far as it goes.

    Raises:
        OSError: ``compressed`` cannot be read or ``unpacked`` not be written, or it would be far larger than a log can be,
            or than the disk.
    """
    room = min(largest_unpacked(compressed.stat().st_size), shutil.disk_usage(unpacked.parent).free)
    with compressed.open("rb") as source, unpacked.open("wb") as sink:
        for piece in _bounded(_pieces(source, "zstd"), room):
            sink.write(piece)


def unpacked_message(raw: bytes) -> bytes:
    """A message as its publisher serialised it, also from a bag with compressed messages; CDR never looks like zstd.

    Raises:
        OSError: it would be far larger than a message can be.
    """
    if not raw.startswith(_ZSTD_MAGIC):
        return raw
    return b"".join(_bounded(_pieces(io.BytesIO(raw), "zstd"), largest_unpacked(len(raw))))


def unpacked_chunk(raw: bytes) -> bytes:
    """A chunk of a ROS 1 bag, whose first record is far shorter than the magic numbers of its codecs would say.

    Raises:
        OSError: it would be far larger than a chunk can be.
    """
    codec = next((name for magic, name in _ROS1_CODECS.items() if raw.startswith(magic)), None)
    if codec is None:
        return raw
    return b"".join(_bounded(_pieces(io.BytesIO(raw), codec), largest_unpacked(len(raw))))


def unpacked_to(codec: str, raw: bytes, size: int) -> bytes:
    """What is said to unpack to ``size`` bytes; less where it is damaged.

    Raises:
        OSError: it would be larger.
    """
    return b"".join(_bounded(_pieces(io.BytesIO(raw), codec), size))


def largest_unpacked(packed: int) -> int:
    """Bytes that so many ``packed`` ones may unpack to."""
    return max(_UNPACKED, _RATIO * packed)


def vast_table(file: Path, footer: Any) -> str:
    """What is wrong with a Parquet file whose ``footer`` says that it unpacks to far more than a log can; else nothing."""
    groups = (footer.row_group(k).total_byte_size for k in range(footer.num_row_groups))
    size = max(sum(groups), _CELL_BYTES * footer.num_rows)
    vast = size > largest_unpacked(file.stat().st_size)
    return f"unpacks to {size >> 20} MB; expected at most {_RATIO} times its size" if vast else ""


def _bounded(pieces: Iterator[bytes], room: int) -> Iterator[bytes]:
    """Yields pieces as long as there is room (bytes).

    Raises:
        OSError: there is not.
    """
    left = room
    for piece in pieces:
        left -= len(piece)
        if left < 0:
            raise OSError(f"unpacks to more than {room} bytes; expected what it says, or what a log can")
        yield piece


def _until_cut(records: Iterator[_T]) -> Iterator[_T]:
    """Yields records up to the first that cannot be read; an error of the one who takes them is not held back."""
    with suppress(Exception):  # a cut surfaces as any error of the decoders: struct, index, unicode, codec, SQLite
        yield from records


def _pieces(source: IO[bytes], codec: str) -> Iterator[bytes]:
    stream = pa.CompressedInputStream(source, codec)
    return _until_cut(iter(lambda: stream.read(1 << 16), b""))


def _read_summary(file: Path) -> Summary | None:
    with file.open("rb") as stream:
        return make_reader(stream).get_summary()


def _index(file: Path) -> Summary | None:
    """The summary of an MCAP file that says where its chunks are; ``None`` without one, or if it is damaged."""
    with suppress(Exception):
        summary = _read_summary(file)
        return summary if summary is not None and summary.chunk_indexes else None
    return None


def _recover_mcap(damaged: Path, recovered: Path) -> Recovered:
    messages, complete, bad = 0, False, 0
    summary = _index(damaged)
    with damaged.open("rb") as source, recovered.open("wb") as sink:
        writer = McapWriter(sink)
        writer.start(profile="ros2")
        schemas: dict[int, int] = {0: 0}
        channels: dict[int, int] = {}
        source.seek(len(b"\x89MCAP0\r\n"))
        in_order = _until_cut(_mcap_records(source, damaged.stat().st_size))
        for r in in_order if summary is None else _indexed_records(source, summary):
            if r is None:
                bad += 1
            elif isinstance(r, Schema) and r.id not in schemas and r.encoding in _ROS_ENCODINGS:
                schemas[r.id] = writer.register_schema(r.name, r.encoding, r.data)
            elif isinstance(r, Channel) and r.id not in channels and r.schema_id in schemas:
                channels[r.id] = writer.register_channel(r.topic, r.message_encoding, schemas[r.schema_id], r.metadata)
            elif isinstance(r, Message) and r.channel_id in channels:
                writer.add_message(channels[r.channel_id], r.log_time, r.data, r.publish_time, r.sequence)
                messages += 1
            elif isinstance(r, DataEnd):
                complete = True
        writer.finish()  # type: ignore[no-untyped-call]
    return Recovered(messages, complete or summary is not None, bad)


def _chunks(source: IO[bytes], summary: Summary) -> Iterator[bytes | None]:
    """Yields the content of each chunk of an indexed file, ``None`` for a bad one, which hides none of those behind it."""
    for index in sorted(summary.chunk_indexes, key=lambda index: index.chunk_start_offset):
        source.seek(index.chunk_start_offset)
        yield _intact_content(source.read(index.chunk_length)[_HEAD:])


def _indexed_records(source: IO[bytes], summary: Summary) -> Iterator[_McapRecord]:
    """Yields the records of an indexed file; schemas and channels are those of its index."""
    yield from summary.schemas.values()
    yield from summary.channels.values()
    for content in _chunks(source, summary):
        yield from _chunk_records(content)


def _chunk_records(content: bytes | None) -> Iterator[_McapRecord]:
    yield from [None] if content is None else _until_cut(_mcap_records(io.BytesIO(content), len(content)))


def _mcap_records(source: IO[bytes], size: int) -> Iterator[_McapRecord]:
    """Yields the records of a stream of ``size`` bytes, also out of the chunk that the cut goes through."""
    last: _McapRecord | None = None
    while len(head := source.read(_HEAD)) == _HEAD and head[0] != 0:
        if last is not None:
            yield last
            last = None
        opcode, length = struct.unpack("<BQ", head)
        body = source.read(min(length, size - source.tell()))
        if opcode == Opcode.CHUNK:
            cut = len(body) < length or body.endswith(bytes(8))  # zeros: by a power cut
            content = _chunk_content(body) if cut else _intact_content(body)  # its beginning is as good as it was
            yield from _chunk_records(content)
        if len(body) < length:
            return
        stream = ReadDataStream(io.BytesIO(body))
        if opcode == Opcode.MESSAGE:
            last = Message.read(stream, length)
        elif opcode in _RECORDS:
            last = _RECORDS[opcode].read(stream)
    if last is not None and not head.startswith(b"\0"):  # zeros are what a power cut fills a file, and records, up with
        yield last


def _chunk_content(body: bytes) -> bytes:
    """What is left of a chunk's records: start, end, size and checksum, then the codec's name, then the data."""
    (length,) = struct.unpack_from("<I", body, 28)
    codec, data = body[32 : 32 + length].decode(), body[40 + length :]
    return b"".join(_bounded(_pieces(io.BytesIO(data), codec), largest_unpacked(len(data)))) if codec else data


def _intact_content(body: bytes) -> bytes | None:
    """The records of a chunk; ``None`` if they are not what its size and checksum say."""
    with suppress(Exception):  # the decoders raise as they like
        size, checksum = struct.unpack_from("<QI", body, 16)
        content = _chunk_content(body)
        if len(content) == size and checksum in (0, zlib.crc32(content)):
            return content
    return None


def _recover_sqlite(damaged: Path, recovered: Path) -> Recovered:
    """Copies the small tables, which lie at the front, by SQLite, and the messages page by page.

    SQLite finds messages from the root of their tree, whose branches move towards the end of the file as it grows: in a
    file cut at two thirds it would find none.
    """
    address = f"file:{quote(str(damaged))}?mode=ro&immutable=1"
    with closing(sqlite3.connect(address, uri=True)) as source, closing(sqlite3.connect(recovered)) as sink:
        tables = dict(_until_cut(_definitions(source)))
        if "messages" not in tables or "topics" not in tables:
            return Recovered(0, False)
        for table, statement in tables.items():
            sink.execute(statement)
            row: tuple[object, ...]
            for row in _until_cut(_message_rows(damaged) if table == "messages" else _rows(source, table)):
                sink.execute(f"INSERT OR IGNORE INTO {table} VALUES ({','.join('?' * len(row))})", row)  # noqa: S608
        sink.execute("CREATE INDEX timestamp_idx ON messages (timestamp ASC)")
        sink.commit()
        ((count,),) = sink.execute("SELECT count(*) FROM messages JOIN topics ON messages.topic_id = topics.id")
    return Recovered(int(count), False)


def _definitions(source: sqlite3.Connection) -> Iterator[tuple[str, str]]:
    """Name and definition of the tables of a bag; SQLite fills with zeros what the cut took from them."""
    source.execute("PRAGMA writable_schema = ON")  # else a file shorter than its header says is refused altogether
    names = ",".join(f"'{table}'" for table in _TABLES)
    query = f"SELECT name, sql FROM sqlite_master WHERE type = 'table' AND name IN ({names})"  # noqa: S608
    yield from ((name, statement) for name, statement in source.execute(query) if "\0" not in statement)


def _rows(source: sqlite3.Connection, table: str) -> Iterator[tuple[object, ...]]:
    yield from source.execute(f"SELECT * FROM {table}")  # noqa: S608 - one of _TABLES


def _message_rows(file: Path) -> Iterator[tuple[int, int, int, bytes]]:
    """Yields ``id, topic_id, timestamp, data`` from all pages that hold rows of that shape.

    The layout of pages, cells and records is that of SQLite's file format documentation.
    """
    with file.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as content:
        size = _page_size(content)
        pages = _Pages(content, size, size - content[20])
        for start in range(0, len(content) - size + 1, size):
            head = start + (100 if start == 0 else 0)
            if content[head] != _TABLE_LEAF:
                continue
            cells = int.from_bytes(content[head + 3 : head + 5], "big")
            for (offset,) in struct.iter_unpack(">H", content[head + 8 : head + 8 + 2 * cells]):
                row = pages.message(start + offset)
                if row is not None:
                    yield row


class _Pages(NamedTuple):
    """A SQLite file: its bytes, the size of a page, and how much of a page is in use."""

    content: mmap.mmap
    size: int
    usable: int

    def message(self, at: int) -> tuple[int, int, int, bytes] | None:
        """The row in the cell at offset ``at``; ``None`` if it is of another table or runs past the end."""
        length, at = _varint(self.content, at)
        rowid, at = _varint(self.content, at)
        payload = self._payload(at, length)
        end, position = _varint(payload, 0)
        kinds = []
        while position < end:
            kind, position = _varint(payload, position)
            kinds.append(kind)
        if len(payload) < length or len(kinds) != 4 or kinds[0] != 0 or kinds[3] < 12 or kinds[3] % 2 or rowid >> 63:
            return None
        topic, position = _integer(payload, end, kinds[1])
        stamp, position = _integer(payload, position, kinds[2])
        return rowid, topic, stamp, payload[position : position + (kinds[3] - 12) // 2]

    def _payload(self, at: int, length: int) -> bytes:
        """A cell's content, what overflows its page included; shorter than ``length`` where pages are missing."""
        most = self.usable - 35
        if length <= most:
            return self.content[at : at + length]
        least = (self.usable - 12) * 32 // 255 - 23
        here = least + (length - least) % (self.usable - 4)
        here = here if here <= most else least
        parts = [self.content[at : at + here]]
        page = int.from_bytes(self.content[at + here : at + here + 4], "big")
        left = length - here
        while left > 0 and 0 < page * self.size <= len(self.content):
            start = (page - 1) * self.size
            parts.append(self.content[start + 4 : start + 4 + min(left, self.usable - 4)])
            left -= len(parts[-1])
            page = int.from_bytes(self.content[start : start + 4], "big")
        return b"".join(parts)


def _page_size(header: mmap.mmap | bytes) -> int:
    size = int.from_bytes(header[16:18], "big")
    return 65536 if size == 1 else size


def _integer(payload: bytes, at: int, kind: int) -> tuple[int, int]:
    """The integer of a serial type at ``at``, and the offset behind it."""
    size = (0, 1, 2, 3, 4, 6, 8, 8, 0, 0)[kind]
    value = kind - 8 if kind in (8, 9) else int.from_bytes(payload[at : at + size], "big", signed=True)
    return value, at + size


def _varint(content: mmap.mmap | bytes, at: int) -> tuple[int, int]:
    """SQLite's variable-length integer at ``at``, and the offset behind it."""
    value = 0
    for k in range(8):
        byte = content[at + k]
        value = value << 7 | byte & 0x7F
        if byte < 0x80:
            return value, at + k + 1
    return value << 8 | content[at + 8], at + 9
