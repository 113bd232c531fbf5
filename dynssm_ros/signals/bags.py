"""rosbag2 folders, single files (MCAP and SQLite3) and ROS 1 bags; any message type that the bag describes.

Reading is rosbags' work. Added here: one clear error per kind of damage, and the way around it where there is one
(:mod:`dynssm_ros.signals.recover`). Messages of ROS 1 become those of ROS 2 as they are read: CDR, headers without ``seq``.
"""

from __future__ import annotations

import os
import sqlite3
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import yaml
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag2 import StoragePlugin, Writer, storage_mcap
from rosbags.typesys import Stores, get_typestore

from dynssm_ros import __version__
from dynssm_ros.errors import BagError
from dynssm_ros.files import real_path, replacing, require_replaceable
from dynssm_ros.signals.recover import (
    bad_chunks,
    has_vast_chunk,
    is_short,
    is_unindexed,
    log_left,
    merge_log,
    recover,
    unpack,
    unpacked_chunk,
    unpacked_message,
    unpacked_to,
)

STORAGE_SUFFIXES = (".mcap", ".db3")
_MAGIC = {b"#ROSBAG V": ".bag", b"\x89MCAP0\r\n": ".mcap", b"SQLite format 3\0": ".db3"}
_HEADER = "std_msgs/msg/Header"
_NO_INDEX = "it has no index"
_LOG_LEFT = "its recorder was killed"
_TYPESTORE = get_typestore(Stores.ROS2_JAZZY)
# rosbags unpacks a chunk whole, whatever its index says of its size
storage_mcap.DECOMPRESSORS |= {codec: partial(unpacked_to, codec) for codec in ("zstd", "lz4")}


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
    mend: Callable[[str], AnyReader]  # a reader of what can be read of a bag in which that damage was met
    mended: list[str] = field(default_factory=list)  # what was recovered
    ros1_types: Any = None  # the types of a ROS 1 bag, with the header of ROS 2

    @cached_property
    def types(self) -> dict[str, str]:
        """Message type of each topic; of several that of most messages, the others are not read."""
        return {topic: max(counts, key=lambda name: counts[name]) for topic, counts in self._counts.items()}

    @property
    def counts(self) -> dict[str, int]:
        """Number of messages of each topic, of its type."""
        return {topic: counts[self.types[topic]] for topic, counts in self._counts.items()}

    @property
    def notes(self) -> list[str]:
        """What was recovered, and which messages are not read as their topic has another type."""
        others = [
            f"topic {topic}: {count} messages of another type, {name}, are left out"
            for topic, counts in self._counts.items()
            for name, count in counts.items()
            if name != self.types[topic] and count
        ]
        return [*self.mended, *others]

    @property
    def _counts(self) -> dict[str, Counter[str]]:
        """Number of messages of each topic by type."""
        counts: dict[str, Counter[str]] = {}
        for c in self.reader.connections:
            counts.setdefault(c.topic, Counter())[c.msgtype] += c.msgcount
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
        if msgtype not in self.typestore(msgtype).types:
            raise BagError(
                f"{self.path}: topic {topic}: the bag does not describe {msgtype}, and it is no common type of ROS 2; "
                f"record it as MCAP, which stores descriptions"
            )

    def typestore(self, msgtype: str) -> Any:
        """The descriptions that hold for ``msgtype``: the bag's own or, where it has none, those of ROS 2 Jazzy."""
        own = self.ros1_types or self.reader.typestore
        return own if msgtype in own.types else _TYPESTORE

    def messages(self, topics: Sequence[str]) -> Iterator[BagMessage]:
        """Yields the messages of ``topics`` in the order in which they were recorded, behind damage too if a reader can
        be made that does.

        Raises:
            BagError: the storage is damaged in the middle.
        """
        given: Counter[str] = Counter()
        try:
            for message in self._stored(topics):
                given[message.topic] += 1
                yield message
            return
        except BagError as damage:
            self.reader = self.mend(_one_line(damage.__cause__ or damage))
        for message in self._stored(topics):
            if given[message.topic] > 0:
                given[message.topic] -= 1
            else:
                yield message

    def _stored(self, topics: Sequence[str]) -> Iterator[BagMessage]:
        wanted = [c for c in self.reader.connections if c.topic in topics and c.msgtype == self.types[c.topic]]
        if not wanted:
            return
        try:
            for connection, log_time, raw in self.reader.messages(wanted):
                yield BagMessage(connection.topic, log_time, self._cdr(connection.msgtype, bytes(raw)))
        except Exception as error:  # rosbags lets through what its decoders raise: struct, codec, SQLite, index errors
            raise BagError(f"{self.path}: damaged, reading stopped ({_one_line(error)})") from error

    def _cdr(self, msgtype: str, raw: bytes) -> bytes:
        """A message as its publisher would serialise it in ROS 2; empty, which no message is, where it is damaged."""
        if self.ros1_types is None:
            return unpacked_message(raw)
        try:
            return bytes(self.ros1_types.ros1_to_cdr(raw, msgtype))
        except Exception:  # rosbags raises struct, index, key and unicode errors here
            return b""

    def decode(self, topic: str, raw: bytes) -> Any:
        """Deserialises a message of ``topic``.

        Raises:
            BagError: the bytes are not such a message.
        """
        msgtype = self.types[topic]
        try:
            return self.typestore(msgtype).deserialize_cdr(raw, msgtype)
        except Exception as error:  # rosbags raises struct, index, key and unicode errors here
            raise BagError(f"{self.path}: topic {topic}: a message is not a {msgtype} ({_one_line(error)})") from error


@contextmanager
def open_bag(path: str | Path) -> Iterator[Bag]:
    """Opens a rosbag2 folder or storage file, or a ROS 1 bag; cut-off files of ROS 2 are recovered up to the cut and
    ``notes`` says so.

    Raises:
        BagError: nothing there, not a bag, or nothing to recover.
    """
    path = Path(path)
    if not os.path.exists(path):  # unlike Path.exists, False where looking is forbidden
        raise BagError(f"{path}: no such file")
    suffix = bag_suffix(path)
    with ExitStack() as stack:
        notes: list[str] = []
        given = path
        if suffix is not None and suffix != path.suffix:  # rosbags goes by the name
            folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="dynssm-"))
            path = Path(folder) / f"{given.name}{suffix}"
            path.symlink_to(real_path(given))
        if suffix == ".bag":
            yield _ros1_bag(given, path, stack)
            return

        def mend(damage: str) -> AnyReader:
            scratch = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="dynssm-")))
            try:
                mended = _open_files(path, scratch, damage, notes)
            except BagError as error:
                raise BagError(str(error).replace(str(path), str(given))) from error
            stack.callback(mended.close)
            return mended

        try:
            reader = _open([path])
            stack.callback(reader.close)
        except BagError as damage:
            reader = mend(str(damage))
        yield Bag(given, reader, mend, notes)


def bag_suffix(path: Path) -> str | None:
    """How the name of a bag's storage file should end by its content: ``.bag`` (ROS 1), ``.mcap``, ``.db3``; ``None`` for
    folders and files of another kind.

    Raises:
        BagError: the file cannot be read.
    """
    if not os.path.isfile(path):
        return None
    try:
        with path.open("rb") as file:
            head = file.read(16)
    except OSError as error:
        raise BagError(f"{path}: cannot be read ({_one_line(error)})") from error
    return next((suffix for magic, suffix in _MAGIC.items() if head.startswith(magic)), None)


def _ros1_bag(path: Path, named: Path, stack: ExitStack) -> Bag:
    """Opens a ROS 1 bag, whose name ends as rosbags expects in ``named``.

    Raises:
        BagError: damaged, without an index, or encrypted.
    """

    def refuse(damage: str) -> NoReturn:
        raise BagError(
            f"{path}: a ROS 1 bag that cannot be read ({damage}); `rosbag reindex` of ROS 1 mends what was cut off"
        )

    try:
        reader = AnyReader([named])
        reader.open()
        stack.callback(reader.close)
        for file in reader.readers:
            assert isinstance(file, Ros1Reader)
            for place, chunk in file.chunks.items():
                file.chunks[place] = chunk._replace(decompressor=unpacked_chunk)  # within limits
        types = dict(reader.typestore.fielddefs)
        if _HEADER in types:
            types[_HEADER] = _TYPESTORE.fielddefs[_HEADER]
        store = get_typestore(Stores.EMPTY)
        store.register(types)
    except Exception as error:  # rosbags lets through what its decoders raise: struct, index, unicode, type errors
        refuse(_one_line(error))
    return Bag(path, reader, refuse, ros1_types=store)


def _open(paths: list[Path]) -> AnyReader:
    """Opens what rosbags reads rightly as it is.

    Raises:
        BagError: there is more to do; says why.
    """
    if any(os.path.isdir(path) and not os.path.isfile(path / "metadata.yaml") for path in paths):
        raise BagError("there is no metadata.yaml")
    try:
        files = [file for path in paths for file in _storage_files(path)]
        if any(log_left(file) for file in files):
            raise BagError(_LOG_LEFT)
        if any(is_unindexed(file) for file in files):
            raise BagError(_NO_INDEX)
        if any(has_vast_chunk(file) for file in files):
            raise BagError("a chunk unpacks to far more than a log's")
        if any(is_short(file) for file in files):
            raise BagError("a file is shorter than its header says")
        reader = AnyReader(paths, default_typestore=_TYPESTORE)
        reader.open()
        if any((type(c.topic), type(c.msgtype), type(c.msgcount)) != (str, str, int) for c in reader.connections):
            raise BagError("its metadata.yaml is damaged")  # which rosbags hands on as it is
    except Exception as error:  # rosbags lets through what its decoders raise: struct, codec, YAML, index, type errors
        raise BagError(_one_line(error)) from error
    return reader


def _storage_files(path: Path) -> list[Path]:
    """The storage files of a folder, or the file itself; what is there packed and unpacked counts once."""
    files = sorted(path.iterdir()) if os.path.isdir(path) else [path]
    return [
        file
        for file in files
        if file.suffix in STORAGE_SUFFIXES
        or (file.suffix == ".zstd" and Path(file.stem).suffix in STORAGE_SUFFIXES and file.with_suffix("") not in files)
    ]


def _open_files(path: Path, scratch: Path, damage: str, notes: list[str]) -> AnyReader:
    """Opens the storage files of a bag one by one and, where one is cut off, what ``scratch`` can hold of it.

    Raises:
        BagError: there are none, or nothing could be recovered.
    """
    try:
        files = _storage_files(path)
        taken_for_ros1 = path.suffix == ".bag"  # rosbags goes by the name, also of a folder; nothing is wrong with it
        if os.path.isdir(path) and damage not in (_NO_INDEX, _LOG_LEFT) and not taken_for_ros1:
            notes.append(f"{path.name}: read file by file ({damage})")
        found = [_usable_file(file, scratch / str(number), notes) for number, file in enumerate(files)]
    except (OSError, sqlite3.Error) as error:
        raise BagError(f"{path}: cannot be read ({_one_line(error)})") from error
    if not files:
        raise BagError(
            f"{path}: not a bag; expected a rosbag2 folder, a .mcap or .db3 file, or a ROS 1 bag ({damage}); `dynssm extract "
            f"--bag` makes one of a table"
        )
    usable = [file for file in found if file is not None]
    if not usable:
        raise BagError(f"{path}: nothing could be recovered; {notes[-1]}")
    try:
        return _open(usable)
    except BagError as error:
        raise BagError(f"{path}: cannot be read ({error})") from error


def _usable_file(file: Path, scratch: Path, notes: list[str]) -> Path | None:
    scratch.mkdir()
    file.open("rb").close()  # what may not be read is not damaged
    if file.suffix == ".zstd":
        source = scratch / f"unpacked{Path(file.stem).suffix}"
        unpack(file, source)
    elif log_left(file):
        source = scratch / "merged.db3"
        merge_log(file, source)
        notes.append(f"{file.name}: its recorder was killed; merged with the log that it left")
    else:
        source = scratch / f"link{file.suffix}"  # SQLite does not find a path with '#', '?' or '%' as rosbags asks
        source.symlink_to(real_path(file))
    damage = _damage(source)
    if damage is None:
        return source
    damage = damage.replace(str(source), file.name)
    recovered = scratch / f"recovered{source.suffix}"
    messages, complete, bad = recover(source, recovered)
    if messages == 0:
        with source.open("rb") as stream:
            of_ros1 = stream.read(25).endswith(b"\4\0\0\0ros1")  # the profile at the beginning of an MCAP file
        told = "messages of ROS 1: take the .bag that it was made of" if of_ros1 else (
            f"nothing: not a bag, or cut off before its first message ({damage})"
        )  # fmt: skip
        notes.append(f"{file.name} holds {told}")
        return None
    if (left := _damage(recovered)) is not None:
        notes.append(f"{file.name} cannot be read ({left.replace(str(recovered), file.name)})")
        return None
    if not complete:
        notes.append(f"{file.name} is cut off ({damage}): recovered {messages} messages up to the cut")
    elif bad:
        notes.append(f"{file.name} is damaged ({damage}): recovered {messages} messages of the other chunks")
    elif damage != _NO_INDEX:
        notes.append(f"{file.name} cannot be read as it is ({damage}): its {messages} ROS messages were copied")
    return recovered


def _damage(file: Path) -> str | None:
    """Why rosbags cannot read a storage file as it is, to its end; ``None`` if it can."""
    try:
        _open([file]).close()
    except BagError as error:
        return str(error)
    bad = bad_chunks(file)
    return f"{bad} of its chunks {'is' if bad == 1 else 'are'} not what the checksum says" if bad else None


_MARK = "dynssm_ros"
"""Key of the custom data in the metadata of bags that are written here."""


@contextmanager
def write_bag(path: str | Path) -> Iterator[BagWriter]:
    """Writes a rosbag2 folder (MCAP, zstd-free so that any reader opens it), atomically.

    Raises:
        UserError: ``path`` exists and is not a bag that was written here.
    """
    path = Path(path)
    require_replaceable(path, _is_ours(path), "a bag that dynssm wrote")
    with replacing(path) as aside, Writer(aside, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        writer.set_custom_data(_MARK, __version__)
        yield BagWriter(writer)


def _is_ours(path: Path) -> bool:
    """Whether a rosbag2 folder has our mark."""
    try:
        content = yaml.safe_load((path / "metadata.yaml").read_text(encoding="utf-8"))
        return _MARK in content["rosbag2_bagfile_information"]["custom_data"]
    except (OSError, ValueError, KeyError, TypeError, yaml.YAMLError):
        return False


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
    """Declares all topics of ``source`` in ``sink`` with the types that the bag describes.

    Raises:
        BagError: a type that the bag does not describe.
    """
    for topic, msgtype in source.types.items():
        source.require(topic, msgtype)
        sink.add_topic(topic, msgtype, source.typestore(msgtype))


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
