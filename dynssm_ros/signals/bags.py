"""rosbag2 folders and single files (MCAP and SQLite3), any message type that the bag describes.

Reading is rosbags' work. What is added here: one clear error per kind of damage, and the rescue of bags that were cut
off while being written - a killed recorder leaves no metadata and no index, and what lies before the cut is still good.
"""

from __future__ import annotations

import sqlite3
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import apsw
from mcap.reader import NonSeekingReader
from mcap.writer import Writer as McapFileWriter
from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.interfaces import Connection
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from dynssm_ros.errors import BagError
from dynssm_ros.files import replacing

STORAGE_SUFFIXES = (".mcap", ".db3")
_TYPESTORE = get_typestore(Stores.ROS2_JAZZY)


class BagMessage(NamedTuple):
    """One serialised message as it was recorded."""

    topic: str
    log_time: int  # ns
    raw: bytes


@dataclass
class Bag:
    """An open bag. Use :func:`open_bag`."""

    path: Path
    reader: AnyReader
    notes: list[str] = field(default_factory=list)

    @property
    def types(self) -> dict[str, str]:
        """Message type of each topic."""
        return {c.topic: c.msgtype for c in self.reader.connections}

    @property
    def counts(self) -> dict[str, int]:
        """Number of messages of each topic."""
        counts: dict[str, int] = {}
        for c in self.reader.connections:
            counts[c.topic] = counts.get(c.topic, 0) + c.msgcount
        return counts

    def require(self, topic: str, msgtype: str) -> None:
        """Checks that ``topic`` is in the bag with ``msgtype``.

        Raises:
            BagError: it is not; names what is there.
        """
        types = self.types
        if topic not in types:
            raise BagError(
                f"{self.path}: topic {topic} is missing; the bag has {', '.join(sorted(types)) or 'no topics'}"
            )
        if types[topic] != msgtype:
            raise BagError(f"{self.path}: topic {topic} has type {types[topic]}; the signal map expects {msgtype}")

    def messages(self, topics: Sequence[str]) -> Iterator[BagMessage]:
        """Yields the messages of ``topics`` in the order in which they were recorded.

        Raises:
            BagError: the storage is damaged in the middle.
        """
        wanted = [c for c in self.reader.connections if c.topic in topics]
        if not wanted:
            return
        try:
            for connection, log_time, raw in self.reader.messages(wanted):
                yield BagMessage(connection.topic, log_time, bytes(raw))
        except (AnyReaderError, apsw.Error, ValueError, EOFError, AssertionError) as error:
            raise BagError(f"{self.path}: damaged, reading stopped ({_one_line(error)})") from error

    def decode(self, topic: str, raw: bytes) -> Any:
        """Deserialises a message of ``topic``.

        Raises:
            BagError: the bytes are not such a message.
        """
        msgtype = self.types[topic]
        try:
            return self.reader.deserialize(raw, msgtype)
        except Exception as error:  # rosbags raises struct, index, key and unicode errors here
            raise BagError(f"{self.path}: topic {topic}: a message is not a {msgtype} ({_one_line(error)})") from error


@contextmanager
def open_bag(path: str | Path) -> Iterator[Bag]:
    """Opens a rosbag2 folder or storage file; cut-off files are recovered up to the cut and ``notes`` says so.

    Raises:
        BagError: nothing there, not a bag, or nothing to recover.
    """
    path = Path(path)
    if not path.exists():
        raise BagError(f"{path}: no such bag")
    with ExitStack() as stack:
        notes: list[str] = []
        reader = _try_open(path)
        if reader is None:
            scratch = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="dynssm-")))
            reader = _open_files(path, scratch, notes)
        stack.callback(reader.close)
        yield Bag(path, reader, notes)


def _try_open(path: Path) -> AnyReader | None:
    """Opens an undamaged bag, else ``None``."""
    if path.is_dir() and not (path / "metadata.yaml").is_file():
        return None
    try:
        reader = AnyReader([path], default_typestore=_TYPESTORE)
        reader.open()
    except (AnyReaderError, OSError, apsw.Error, ValueError, KeyError, AssertionError, EOFError):
        return None
    return reader


def _open_files(path: Path, scratch: Path, notes: list[str]) -> AnyReader:
    """Opens the storage files one by one, rescuing those that were cut off."""
    files = sorted(p for p in path.iterdir() if p.suffix in STORAGE_SUFFIXES) if path.is_dir() else [path]
    if not files or files[0].suffix not in STORAGE_SUFFIXES:
        raise BagError(f"{path}: not a bag; expected a rosbag2 folder, or a .mcap or .db3 file")
    good: list[Path] = []
    for file in files:
        if _readable(file):
            good.append(file)
            continue
        rescued = scratch / file.name
        count = _rescue_mcap(file, rescued) if file.suffix == ".mcap" else _rescue_sqlite(file, rescued)
        if count == 0 or not _readable(rescued):
            raise BagError(f"{file}: not a bag, or cut off before its first message; nothing could be recovered")
        notes.append(f"{file.name} is cut off: recovered {count} messages up to the cut")
        good.append(rescued)
    if path.is_dir() and not (path / "metadata.yaml").is_file():
        notes.append(f"{path.name} has no metadata.yaml: its storage files were read directly")
    try:
        reader = AnyReader(good, default_typestore=_TYPESTORE)
        reader.open()
    except AnyReaderError as error:
        raise BagError(f"{path}: cannot be read ({_one_line(error)})") from error
    return reader


def _readable(file: Path) -> bool:
    reader = _try_open(file)
    if reader is None:
        return False
    reader.close()
    return True


def _rescue_mcap(damaged: Path, rescued: Path) -> int:
    """Copies the messages before the cut to a new file; returns their number."""
    count = 0
    with damaged.open("rb") as source, rescued.open("wb") as sink:
        writer = McapFileWriter(sink)
        writer.start(profile="ros2")
        schemas: dict[int, int] = {}
        channels: dict[int, int] = {}
        with suppress(Exception):  # the cut may surface as any decoder's error (struct, zstd, lz4, MCAP); stop there
            for schema, channel, message in NonSeekingReader(source).iter_messages(log_time_order=False):
                if channel.id not in channels:
                    if schema is not None and schema.id not in schemas:
                        schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
                    channels[channel.id] = writer.register_channel(
                        channel.topic,
                        channel.message_encoding,
                        schemas[schema.id] if schema is not None else 0,
                        channel.metadata,
                    )
                writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
                count += 1
        writer.finish()  # type: ignore[no-untyped-call]
    return count


def _rescue_sqlite(damaged: Path, rescued: Path) -> int:
    """Copies the rows before the cut to a new database; returns the number of messages."""
    count = 0
    source = sqlite3.connect(f"file:{damaged}?immutable=1", uri=True)
    sink = sqlite3.connect(rescued)
    try:
        # SQLite refuses a file shorter than its header says, except with a writable schema
        source.execute("PRAGMA writable_schema = ON")
        for (statement,) in source.execute(
            "SELECT sql FROM sqlite_master WHERE type = 'table' AND name NOT LIKE 'sqlite_%'"
        ):
            sink.execute(statement)
        for table in ("schema", "metadata", "topics", "message_definitions", "messages"):
            with suppress(sqlite3.Error):  # older schemas lack some tables; the cut ends one of them
                for row in source.execute(f"SELECT * FROM {table}"):  # noqa: S608 - fixed names
                    sink.execute(f"INSERT INTO {table} VALUES ({','.join('?' * len(row))})", row)  # noqa: S608
                    count += table == "messages"
    except sqlite3.Error:
        count = 0
    finally:
        sink.commit()
        sink.close()
        source.close()
    return count


@contextmanager
def write_bag(path: str | Path) -> Iterator[BagWriter]:
    """Writes a rosbag2 folder (MCAP, zstd-free so that any reader opens it), atomically.

    Raises:
        BagError: ``path`` exists and is not a bag folder, which would be replaced.
    """
    path = Path(path)
    if path.exists() and not (path / "metadata.yaml").is_file():
        raise BagError(f"{path}: exists and is not a rosbag2 folder; not replaced")
    with replacing(path) as aside, Writer(aside, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        yield BagWriter(writer)


class BagWriter:
    """Serialises messages of the shipped types into a bag. Use :func:`write_bag`."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._connections: dict[str, Connection] = {}

    def add_topic(self, topic: str, msgtype: str, typestore: Any = None) -> None:
        """Declares a topic; ``typestore`` describes types that are not common to ROS 2 Jazzy."""
        self._connections[topic] = self._writer.add_connection(topic, msgtype, typestore=typestore or _TYPESTORE)

    def write(self, topic: str, log_time: int, message: Any) -> None:
        """Writes a message of a declared topic at ``log_time`` (ns)."""
        connection = self._connections[topic]
        self.write_raw(topic, log_time, bytes(_TYPESTORE.serialize_cdr(message, connection.msgtype)))

    def write_raw(self, topic: str, log_time: int, raw: bytes) -> None:
        """Writes an already serialised message of a declared topic at ``log_time`` (ns)."""
        self._writer.write(self._connections[topic], log_time, raw)


def copy_topics(source: Bag, sink: BagWriter) -> None:
    """Declares all topics of ``source`` in ``sink`` with the types that the bag describes."""
    for topic, msgtype in source.types.items():
        sink.add_topic(topic, msgtype, source.reader.typestore)


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
