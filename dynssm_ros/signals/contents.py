"""What is in a log, topic by topic or column by column: how regularly samples come, and the numbers in them."""

from __future__ import annotations

import math
from array import array
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.errors import BagError
from dynssm_ros.progress import Progress
from dynssm_ros.signals.bags import Bag
from dynssm_ros.signals.columns import LogColumn, known_unit
from dynssm_ros.signals.decoding import LOG_TIME, frames_told, header_stamp_ns, stamped_by
from dynssm_ros.signals.signal_map import compile_field
from dynssm_ros.signals.stamps import Lateness, possible
from dynssm_ros.signals.table_clock import Clock
from dynssm_ros.signals.tables import LogTable

ODOMETRY = "nav_msgs/msg/Odometry"
TWISTS = {
    ODOMETRY: "twist.twist",
    "geometry_msgs/msg/TwistWithCovarianceStamped": "twist.twist",
    "geometry_msgs/msg/TwistStamped": "twist",
}
POSES = {
    ODOMETRY: "pose.pose",
    "geometry_msgs/msg/PoseWithCovarianceStamped": "pose.pose",
    "geometry_msgs/msg/PoseStamped": "pose",
}
_SAMPLES = 4000  # messages of a topic that are taken apart, evenly spread
_LARGEST = 65536  # bytes of a message; images and clouds hold no signal
_LONGEST_ARRAY, _DEEPEST = 16, 5


@dataclass(frozen=True)
class TopicContent:
    """One topic of a log, or one column of a table."""

    name: str
    msgtype: str  # of a column what its cells are
    count: int  # number of messages
    rate: float  # median by log time (Hz); NaN with fewer than two messages
    longest_gap: float  # longest time between two messages by log time (s)
    time: Vector = field(repr=False)  # log time of the samples (s since the log's first message), (N,)
    values: dict[str, Vector] = field(repr=False)  # numbers of the samples by field, (N,); NaN where a message lacks it
    unit: str = ""  # of a column, as its heading says
    reason: str = ""  # why its samples, or some of them, cannot be read
    limits: tuple[float, float, float] | None = None  # of all cells of a column: least, largest, share of zeros
    stamped: str = ""  # by what the samples are stamped: header, the name of a field, log time; empty of a column
    late: Lateness = field(default=Lateness(np.empty(0), np.empty(0)), repr=False)  # of the samples that have a stamp
    frames: Mapping[str, int] = field(default_factory=dict, repr=False)  # samples by the frames that they name

    @property
    def lateness(self) -> float:
        """Median of log time less stamp (s); NaN without stamps."""
        return float(np.median(self.late.late)) if len(self.late.late) else math.nan


def contents_of_bag(bag: Bag, progress: Progress | None) -> tuple[dict[str, TopicContent], int, int]:
    """All topics that have messages, with the log's first and last time (ns); one that cannot be read has a reason."""
    counts = {topic: count for topic, count in bag.counts.items() if count}
    times = {topic: array("q") for topic in counts}
    late: dict[str, list[tuple[float, float]]] = {topic: [] for topic in counts}
    frames: dict[str, Counter[str]] = {topic: Counter() for topic in counts}
    stamped = dict.fromkeys(counts, "")
    sampled: dict[str, list[tuple[int, dict[str, float]]]] = {topic: [] for topic in counts}
    described = {topic for topic in counts if bag.types[topic] in bag.typestore(bag.types[topic]).types}
    reasons = {topic: "the log does not describe its type" for topic in counts if topic not in described}
    total = sum(counts.values())
    for done, (topic, log_time, raw) in enumerate(bag.messages(list(counts)), 1):
        step = -(-counts[topic] // _SAMPLES)
        if len(times[topic]) % step == 0 and topic in described and len(raw) <= _LARGEST:
            try:
                message = bag.decode(topic, raw)
                numbers = dict(_numbers(message))
            except BagError as error:
                reasons.setdefault(topic, str(error).rpartition(f"topic {topic}: ")[2])
            else:
                stamp = header_stamp_ns(message)
                stamped[topic] = (stamped[topic] if stamp == 0 else "") or (stamped_by(message) if stamp else LOG_TIME)
                frames[topic][frames_told(message)] += 1
                if stamp:  # 0 is unset
                    late[topic].append((log_time / 1e9, (log_time - stamp) / 1e9))
                sampled[topic].append((log_time, numbers))
        times[topic].append(log_time)
        if progress is not None:
            progress(done, total)
    begin = min((one[0] for one in times.values() if one), default=0)  # a topic may be damaged altogether
    end = max((one[-1] for one in times.values() if one), default=0)
    found = {}
    for topic in sorted(counts):
        apart = np.diff(np.frombuffer(times[topic], np.int64)) / 1e9
        paths = {path: None for _, values in sampled[topic] for path in values}
        found[topic] = TopicContent(
            topic,
            bag.types[topic],
            counts[topic],
            1.0 / max(float(np.median(apart)), 1e-9) if len(apart) else math.nan,
            float(apart.max()) if len(apart) else 0.0,
            np.array([time - begin for time, _ in sampled[topic]]) / 1e9,
            {path: _possible(np.array([values.get(path, math.nan) for _, values in sampled[topic]])) for path in paths},
            reason=reasons.get(topic, ""),
            stamped=stamped[topic],
            late=Lateness(*np.array(late[topic]).reshape(-1, 2).T),
            frames=frames[topic],
        )
    return found, begin, end


def contents_of_table(table: LogTable, clock: Clock) -> tuple[dict[str, TopicContent], int, int]:
    """All columns but that of time, with the table's first and last time (ns); one of no use has a reason."""
    stamps = clock.stamps[clock.known]
    begin, end = int(stamps.min()), int(stamps.max())
    found = {}
    for group in table.groups():
        for name, column in group.items():
            if name != clock.column:
                found[name] = _column_content(name, table.headings[name].unit, column, clock, begin)
    return found, begin, end


def _column_content(name: str, unit: str, column: LogColumn, clock: Clock, begin: int) -> TopicContent:
    """A column whose samples are those cells that have a value."""
    there = np.flatnonzero(column.present & clock.known)
    apart = np.diff(clock.stamps[there]) / 1e9
    values = column.values[there]
    finite = values[np.isfinite(values)]
    limits = (float(finite.min()), float(finite.max()), float((finite == 0).mean())) if len(finite) else None
    step = max(1, -(-len(there) // _SAMPLES))
    return TopicContent(
        name,
        column.type,
        len(there),
        1.0 / max(float(np.median(apart)), 1e-9) if len(apart) else math.nan,
        float(apart.max()) if len(apart) else 0.0,
        (clock.stamps[there[::step]] - begin) / 1e9,
        {} if column.reason or column.is_time else {name: _possible(values[::step])},
        known_unit(unit) or unit,
        column.reason or column.bad,
        limits,
    )


def spread(values: Vector) -> float:
    """Largest less least of the finite values; 0 of none."""
    known = values[np.isfinite(values)]
    return float(np.ptp(known)) if len(known) else 0.0


def _possible(values: Vector) -> Vector:
    """NaN where a value is none that a signal can have."""
    return np.where(possible(values), values, math.nan)


def _numbers(message: Any, prefix: str = "", depth: int = 0) -> Iterator[tuple[str, float]]:
    """The numbers in a message by the paths of a signal map; of poses and odometry those that signals are made of."""
    if depth == 0 and message.__msgtype__ in POSES:
        paths = pose_fields(message.__msgtype__)
        paths |= twist_fields(message.__msgtype__) if message.__msgtype__ in TWISTS else {}
        for path in paths.values():
            value = compile_field(path)(message)
            if value is not None:
                yield path, value
        return
    names = getattr(message, "name", ())
    for part in message.__dataclass_fields__:
        value, path = getattr(message, part), f"{prefix}{part}"
        if part in ("header", "__msgtype__") or depth > _DEEPEST:
            continue
        if isinstance(value, (bool, int, float, np.number)):
            yield path, float(value)
        elif hasattr(value, "__dataclass_fields__"):
            yield from _numbers(value, f"{path}.", depth + 1)
        elif isinstance(value, (list, np.ndarray)) and 0 < len(value) <= _LONGEST_ARRAY:
            named = len(names) == len(value) and part != "name" and all(isinstance(name, str) for name in names)
            for k, one in enumerate(value):
                at = f"{path}[{names[k] if named else k}]"
                if hasattr(one, "__dataclass_fields__"):
                    yield from _numbers(one, f"{at}.", depth + 1)
                elif isinstance(one, (int, float, np.number)):
                    yield at, float(one)


def twist_fields(msgtype: str) -> dict[str, str]:
    """Where ``v_x``, ``v_y`` and ``omega`` are in a message that has a twist."""
    twist = TWISTS[msgtype]
    return {"v_x": f"{twist}.linear.x", "v_y": f"{twist}.linear.y", "omega": f"{twist}.angular.z"}


def pose_fields(msgtype: str) -> dict[str, str]:
    """Where ``x``, ``y`` and ``theta`` are in a message that has a pose."""
    pose = POSES[msgtype]
    return {"x": f"{pose}.position.x", "y": f"{pose}.position.y", "theta": f"yaw({pose}.orientation)"}
