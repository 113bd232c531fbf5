"""Bags to read: written by rosbags itself, so that nothing here depends on the package's own writer."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from dynssm_ros.signals import messages

START = 1_700_000_000_123_456_789
ROWS = 60  # of a table
FEEDBACK, COMMAND, ODOMETRY = messages.FEEDBACK_TOPIC, messages.COMMAND_TOPIC, messages.ODOMETRY_TOPIC
CUSTOM_TYPES = {
    "team_msgs/msg/Pedals": "std_msgs/Header header\nfloat32 throttle_percent\nfloat64[] brake_kpa\n",
    "team_msgs/msg/Wheel": "float64 angle_deg\nstring note\n",
    "team_msgs/msg/Odd": "float64 header\nfloat64 value\n",
}

FORMS = {
    "sqlite": (StoragePlugin.SQLITE3, CompressionMode.NONE),
    "mcap": (StoragePlugin.MCAP, CompressionMode.NONE),
    "mcap, zstd chunks": (StoragePlugin.MCAP, CompressionMode.STORAGE),
    "sqlite, zstd file": (StoragePlugin.SQLITE3, CompressionMode.FILE),
    "mcap, zstd file": (StoragePlugin.MCAP, CompressionMode.FILE),
    "sqlite, zstd messages": (StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
    "mcap, zstd messages": (StoragePlugin.MCAP, CompressionMode.MESSAGE),
}

Record = tuple[str, str, int, Any]
"""Topic, type, log time (ns) and message."""
MakeBag = Callable[..., Path]


@pytest.fixture(scope="session")
def typestore() -> Any:
    """ROS 2 Jazzy and a team's own types."""
    store = get_typestore(Stores.ROS2_JAZZY)
    types: dict[str, Any] = {}
    for name, text in CUSTOM_TYPES.items():
        types |= get_types_from_msg(text, name)
    store.register(types)
    return store


@pytest.fixture(params=FORMS)
def form(request: pytest.FixtureRequest) -> str:
    """How a bag is stored."""
    return str(request.param)


@pytest.fixture(autouse=True)
def scratch(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Everything temporary goes to a folder of which nothing may be left."""
    folder = tmp_path_factory.mktemp("scratch")
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    yield
    assert list(folder.iterdir()) == []


@pytest.fixture
def make_bag(tmp_path: Path, typestore: Any) -> MakeBag:
    """Writes records as a rosbag2 folder; a message of bytes is written as it is."""

    def make(
        records: Iterable[Record],
        name: str = "bag",
        form: str = "mcap",
        topics: Mapping[str, str] | None = None,
    ) -> Path:
        plugin, compression = FORMS[form]
        writer = Writer(tmp_path / name, version=9, storage_plugin=plugin)
        writer.set_compression(compression, CompressionFormat.ZSTD)
        with writer:
            connections = {
                topic: writer.add_connection(topic, msgtype, typestore=typestore)
                for topic, msgtype in (topics or {}).items()
            }
            for topic, msgtype, log_time, message in records:
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, msgtype, typestore=typestore)
                raw = message if isinstance(message, bytes) else bytes(typestore.serialize_cdr(message, msgtype))
                writer.write(connections[topic], log_time, raw)
        return tmp_path / name

    return make


@pytest.fixture
def make_ros1_bag(tmp_path: Path, typestore: Any) -> MakeBag:
    """Writes records as a ROS 1 bag, whose headers have a ``seq``; a message of bytes is written as it is."""

    def make(records: Iterable[Record], name: str = "run.bag", compression: Any = None) -> Path:
        noetic = get_typestore(Stores.ROS1_NOETIC)
        noetic.register({name: typestore.fielddefs[name] for name in CUSTOM_TYPES})
        connections: dict[str, Any] = {}
        writer = Ros1Writer(tmp_path / "as_written.bag")
        if compression is not None:
            writer.set_compression(compression)
        with writer:
            for topic, msgtype, log_time, message in records:
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, msgtype, typestore=noetic)
                raw = message if isinstance(message, bytes) else typestore.serialize_cdr(message, msgtype)
                raw = raw if isinstance(message, bytes) else typestore.cdr_to_ros1(raw, msgtype)
                writer.write(connections[topic], log_time, bytes(raw))
        return (tmp_path / "as_written.bag").rename(tmp_path / name)

    return make


@pytest.fixture(scope="session")
def drive() -> Callable[..., list[Record]]:
    """Records of a drive on the default topics whose signals are linear in time, ``n`` odometry messages at 100 Hz.

    ``v_x = 10 + t``, ``v_y = 0.1 t``, ``omega = -0.2 t``; feedback 0.5 and 0.01 t, commands 0.05 and 0.002 above it.
    """

    def records(n: int = 200, rate: float = 100.0, start: int = START) -> list[Record]:
        found: list[Record] = []
        for t in np.arange(n) / rate:
            stamp = start + round(t * 1e9)
            pose, state = (float(10 * t), 1.0, 0.3), (10 + t, 0.1 * t, -0.2 * t)
            joints = {"throttle": 0.5, "steering": 0.01 * t}
            wanted = {"throttle": 0.55, "steering": 0.01 * t + 0.002}
            found += [
                (FEEDBACK, messages.JOINT_STATE, stamp + 1000, messages.joint_state(stamp, joints)),
                (COMMAND, messages.JOINT_STATE, stamp + 2000, messages.joint_state(stamp, wanted)),
                (ODOMETRY, messages.ODOMETRY, stamp + 3000, messages.odometry(stamp, pose, state)),
            ]
        return found

    return records


@pytest.fixture
def columns() -> dict[str, np.ndarray]:
    """The drive of the fixture ``drive`` as columns; heading as a quaternion has it."""
    t = np.arange(ROWS) / 100.0
    theta = 2.0 * np.arctan2(np.sin(0.15), np.cos(0.15))
    return {
        "time": START + np.round(t * 1e9).astype(np.int64), "v_x": 10 + t, "v_y": 0.1 * t, "omega": -0.2 * t,
        "x": 10 * t, "y": np.ones(ROWS), "theta": np.full(ROWS, theta), "throttle_feedback": np.full(ROWS, 0.5),
        "steering_feedback": 0.01 * t, "throttle_command": np.full(ROWS, 0.55), "steering_command": 0.01 * t + 0.002,
    }  # fmt: skip
