"""What is in a log: topics, rates, gaps, clocks, and which fields the signals of a signal map may be.

Names of topics and fields suggest a signal map; the values correct it. A steering signal is compared with the curvature
that is driven, so that degrees, steering-wheel angles and swapped signs are seen.
"""

from __future__ import annotations

import math
import re
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from dynssm_ros.arrays import Vector
from dynssm_ros.errors import BagError
from dynssm_ros.progress import Progress
from dynssm_ros.signals.bags import Bag, open_bag
from dynssm_ros.signals.decoding import header_stamp_ns
from dynssm_ros.signals.signal_map import COMMAND_SIGNALS, REQUIRED_SIGNALS, SIGNALS, STATE_SIGNALS, compile_field

ODOMETRY = "nav_msgs/msg/Odometry"
_TWIST = {"v_x": "twist.twist.linear.x", "v_y": "twist.twist.linear.y", "omega": "twist.twist.angular.z"}
_POSES = {
    ODOMETRY: "pose.pose",
    "geometry_msgs/msg/PoseWithCovarianceStamped": "pose.pose",
    "geometry_msgs/msg/PoseStamped": "pose",
}
_SAMPLES = 4000  # messages of a topic that are taken apart, evenly spread
_LARGEST = 65536  # bytes of a message; images and clouds hold no signal
_LONGEST_ARRAY, _DEEPEST = 16, 5
_WORDS = {
    "steering": re.compile(r"steer|delta|servo", re.IGNORECASE),
    "throttle": re.compile(r"throttle|accel\w*pedal|pedal_(?:output|position)|gas|duty", re.IGNORECASE),
    "brake": re.compile(r"brake", re.IGNORECASE),
}
_COMMAND = re.compile(r"cmd|command|target|desired|setpoint|request", re.IGNORECASE)
_MEASURED = re.compile(r"report|feedback|measured|actual|angle|position|output|pressure", re.IGNORECASE)
_OTHER = re.compile(
    r"rate|veloc|speed|torque|current|status|state|enable|fault|counter|temp|rolling|valid|overrid|timeout|limit|effort"
    r"|covariance|stamp|warn|error|source|mode",
    re.IGNORECASE,
)
_RADIANS, _SHARE = 1.6, 1.5  # larger values are no road-wheel angle in rad, and no throttle between -1 and 1
_AGREES = 0.5  # correlation with the curvature, from which on a scale is told
_UNIT = (0.6, 1.7)  # wheelbase times curvature per unit, for a signal that is the road-wheel angle in rad already
_WINDOW = 0.1  # s, of poses from which velocities follow
_CLOCK = 1.0  # s by which the stamps of topics may be apart
_DRIVING = 0.3  # of the largest speed, from which on curvature is compared


@dataclass(frozen=True)
class TopicContent:
    """One topic of a log."""

    name: str
    msgtype: str
    count: int  # number of messages
    rate: float  # median by log time (Hz); NaN with fewer than two messages
    longest_gap: float  # longest time between two messages by log time (s)
    lateness: float  # median of log time less header stamp (s); NaN without headers
    time: Vector = field(repr=False)  # log time of the samples (s since the log's first message), (N,)
    values: dict[str, Vector] = field(repr=False)  # numbers of the samples by field, (N,); NaN where a message lacks it


@dataclass(frozen=True)
class Suggestion:
    """Where a signal may come from."""

    topic: TopicContent
    field: str
    scale: float = 1.0
    note: str = ""

    @property
    def values(self) -> Vector:
        """The signal at the topic's samples, shape ``(N,)``."""
        return self.scale * self.topic.values[self.field]


@dataclass(frozen=True)
class Inspection:
    """What is in a log."""

    name: str
    duration: float  # between its first and last message (s)
    topics: dict[str, TopicContent]  # by name
    signals: dict[str, Suggestion]  # suggested sources, by signal
    notes: tuple[str, ...]  # what to look at, in sentences

    @property
    def missing(self) -> tuple[str, ...]:
        """Signals that every signal map needs and for which nothing was found."""
        needed = REQUIRED_SIGNALS[len(STATE_SIGNALS) :] if self.poses_alone else REQUIRED_SIGNALS
        return tuple(name for name in needed if name not in self.signals)

    @property
    def poses_alone(self) -> bool:
        """Whether velocities have to follow from poses."""
        return "v_x" not in self.signals and "x" in self.signals

    def signal_map(self) -> str:
        """The suggested signal map as YAML; what is missing or uncertain stands there as a comment."""
        commands = "topics" if set(COMMAND_SIGNALS) <= set(self.signals) else "none"
        name = re.sub(r"\W+", "_", Path(self.name).stem) or "own"
        lines = [f"# Suggested by `dynssm inspect` from {self.name}. Check fields and scales before you use it.",
                 f"name: {name}", f"commands: {commands}", "max_gap: 0.25", "signals:"]  # fmt: skip
        lines[-1:-1] = [f"velocities: {{window: {_WINDOW}}}"] if self.poses_alone else []
        lines += [f"  # {each}: nothing found; give its topic, type and field" for each in self.missing]
        for signal in SIGNALS:
            if signal not in self.signals:
                continue
            found = self.signals[signal]
            source: dict[str, Any] = {"topic": found.topic.name, "type": found.topic.msgtype, "field": found.field}
            if found.scale != 1.0:
                source["scale"] = float(f"{found.scale:.4g}")
            text = yaml.safe_dump(source, default_flow_style=True, sort_keys=False, width=math.inf).strip()
            lines += [f"  # {found.note}"] if found.note else []
            lines.append(f"  {signal}: {text}")
        return "\n".join(lines) + "\n"


def inspect(path: str | Path, wheelbase: float | None = None, progress: Progress | None = None) -> Inspection:
    """Reads a log, a rosbag2 folder or storage file, and says what is in it.

    With the ``wheelbase`` of the car (m) the scale of a steering signal follows from the curvature it drives.

    Raises:
        BagError: unreadable, or without messages.
    """
    with open_bag(path) as bag:
        topics, begin, end = _topics(bag, progress)
        notes = [*bag.notes]
    if not topics:
        raise BagError(f"{path}: holds no messages; expected some")
    signals = _odometry(topics, notes) | _actuators(topics)
    if not set(COMMAND_SIGNALS) <= set(signals):  # of no use alone
        signals = {name: source for name, source in signals.items() if not name.endswith("_command")}
    for name in ("steering_feedback", "steering_command"):
        if name in signals:
            signals[name] = _scaled_steering(signals[name], signals, wheelbase)
    notes += _clocks(topics, signals)
    return Inspection(Path(path).name, (end - begin) / 1e9, topics, signals, tuple(notes))


def _topics(bag: Bag, progress: Progress | None) -> tuple[dict[str, TopicContent], int, int]:
    """All topics that have messages, with the log's first and last time (ns)."""
    counts = {topic: count for topic, count in bag.counts.items() if count}
    times = {topic: array("q") for topic in counts}
    lateness: dict[str, list[float]] = {topic: [] for topic in counts}
    sampled: dict[str, list[tuple[int, dict[str, float]]]] = {topic: [] for topic in counts}
    described = {topic for topic in counts if bag.types[topic] in bag.typestore(bag.types[topic]).types}
    total = sum(counts.values())
    for done, (topic, log_time, raw) in enumerate(bag.messages(list(counts)), 1):
        step = -(-counts[topic] // _SAMPLES)
        if len(times[topic]) % step == 0 and topic in described and len(raw) <= _LARGEST:
            message = bag.decode(topic, raw)
            stamp = header_stamp_ns(message)
            if stamp is not None:
                lateness[topic].append((log_time - stamp) / 1e9)
            sampled[topic].append((log_time, dict(_numbers(message))))
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
            float(np.median(lateness[topic])) if lateness[topic] else math.nan,
            np.array([time - begin for time, _ in sampled[topic]]) / 1e9,
            {path: np.array([values.get(path, math.nan) for _, values in sampled[topic]]) for path in paths},
        )
    return found, begin, end


def _numbers(message: Any, prefix: str = "", depth: int = 0) -> Iterator[tuple[str, float]]:
    """The numbers in a message by the paths of a signal map; of poses and odometry those that signals are made of."""
    if depth == 0 and message.__msgtype__ in _POSES:
        paths = _pose_fields(message.__msgtype__) | (_TWIST if message.__msgtype__ == ODOMETRY else {})
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


def _odometry(topics: dict[str, TopicContent], notes: list[str]) -> dict[str, Suggestion]:
    """The odometry that moves most often, if there is one."""
    odometries = [topic for topic in topics.values() if topic.msgtype == ODOMETRY and topic.values]
    moving = [topic for topic in odometries if _spread(topic.values[_TWIST["v_x"]]) > 0]
    if not moving:
        poses = [topic for topic in topics.values() if topic.msgtype in _POSES and _moves(topic)]
        if not poses:
            notes.append(
                "nothing tells where the car is or how fast; find a topic with v_x, v_y and omega, or with poses"
            )
            return {}
        best = max(poses, key=lambda topic: topic.count)
        notes.append(f"no topic has velocities; they follow from the poses of {best.name}")
        return {signal: Suggestion(best, path) for signal, path in _pose_fields(best.msgtype).items()}
    best = max(moving, key=lambda topic: topic.count)
    if len(moving) > 1:
        notes.append(f"several odometries move: {', '.join(topic.name for topic in moving)}; taken is {best.name}")
    if _spread(best.values[_TWIST["v_y"]]) == 0:
        notes.append(f"{best.name}: v_y is constant, so that nothing is known of how the car slides")
    fields = _TWIST | _pose_fields(ODOMETRY) if _moves(best) else _TWIST
    return {signal: Suggestion(best, path) for signal, path in fields.items()}


def _pose_fields(msgtype: str) -> dict[str, str]:
    """Where ``x``, ``y`` and ``theta`` are in a message that has a pose."""
    pose = _POSES[msgtype]
    return {"x": f"{pose}.position.x", "y": f"{pose}.position.y", "theta": f"yaw({pose}.orientation)"}


def _moves(topic: TopicContent) -> bool:
    fields = _pose_fields(topic.msgtype)
    return any(_spread(topic.values[fields[name]]) > 0 for name in ("x", "y") if fields[name] in topic.values)


def _actuators(topics: dict[str, TopicContent]) -> dict[str, Suggestion]:
    """Throttle, steering and brake by their names, as measured and as commanded."""
    found: dict[str, Suggestion] = {}
    for actuator, words in _WORDS.items():
        ranked: dict[str, list[tuple[tuple[int, ...], Suggestion]]] = {"feedback": [], "command": []}
        for topic in topics.values():
            for path, values in topic.values.items():
                name = f"{topic.name} {path}"
                leaf = path.rsplit(".", 1)[-1]
                own = bool(words.search(path)) + bool(words.search(leaf))
                others = any(word.search(path) for key, word in _WORDS.items() if key != actuator)
                if not (own or words.search(topic.name)) or others or _OTHER.search(path):
                    continue
                kind = "command" if _COMMAND.search(name) else "feedback"
                varied = len(np.unique(values[np.isfinite(values)])) > 2
                rank = (varied, own, bool(_MEASURED.search(leaf)), bool(_MEASURED.search(topic.name)), topic.count)
                ranked[kind].append((rank, Suggestion(topic, path)))
        for kind, candidates in ranked.items():
            if candidates:
                found[f"{actuator}_{kind}"] = _scaled(actuator, max(candidates, key=lambda pair: pair[0])[1])
        if f"{actuator}_feedback" not in found and f"{actuator}_command" in found and actuator != "brake":
            command = found[f"{actuator}_command"]
            note = "no feedback found: the command is taken for it"
            found[f"{actuator}_feedback"] = replace(command, note=note)
    return found


def _scaled(actuator: str, suggestion: Suggestion) -> Suggestion:
    """Pedals between 0 and 1; the steering is scaled by the curvature."""
    values = suggestion.topic.values[suggestion.field]
    largest = float(np.nanmax(np.abs(values))) if np.isfinite(values).any() else 0.0
    if actuator == "steering" or largest <= _SHARE:
        return suggestion
    if actuator == "throttle" and largest <= 100.0 * _SHARE:
        return replace(suggestion, scale=0.01, note="taken for percent")
    note = f"up to {largest:.4g} in the log, which is taken for full {actuator}"
    return replace(suggestion, scale=1.0 / largest, note=note)


def _scaled_steering(suggestion: Suggestion, signals: dict[str, Suggestion], wheelbase: float | None) -> Suggestion:
    """The steering in rad at the road wheel, as far as the curvature that it drives tells."""
    slope = _curvature_per_unit(suggestion, signals)
    values = suggestion.topic.values[suggestion.field]
    if slope is None:
        large = float(np.nanmax(np.abs(values), initial=0.0)) > _RADIANS
        note = "too large for rad at the road wheel: find its scale" if large else suggestion.note
        return replace(suggestion, scale=1.0, note=note)
    told = f"the curvature follows it with {slope:.4g} 1/m per unit"
    if wheelbase is None:
        return replace(suggestion, scale=1.0, note=f"{told}: the scale is about that times the wheelbase")
    scale = slope * wheelbase
    if _UNIT[0] < scale < _UNIT[1]:
        return replace(suggestion, scale=1.0)
    return replace(suggestion, scale=scale, note=f"{told}; measure the scale at the wheel")


def _curvature_per_unit(suggestion: Suggestion, signals: dict[str, Suggestion]) -> float | None:
    """Change of ``omega / v_x`` (1/m) per unit of the signal; ``None`` where they do not go together."""
    if "v_x" not in signals or "omega" not in signals:
        return None
    odometry, at = signals["v_x"].topic, suggestion.topic.time
    values = suggestion.topic.values[suggestion.field]
    v_x, omega = (np.interp(at, odometry.time, signals[name].values) for name in ("v_x", "omega"))
    fast = (v_x > _DRIVING * v_x.max(initial=0.0)) & np.isfinite(values) & (v_x > 0)
    if fast.sum() < 3 or _spread(values[fast]) == 0 or _spread(omega[fast]) == 0:
        return None
    curvature = omega[fast] / v_x[fast]
    if abs(np.corrcoef(values[fast], curvature)[0, 1]) < _AGREES:
        return None
    return float(np.polyfit(values[fast], curvature, 1)[0])


def _clocks(topics: dict[str, TopicContent], signals: dict[str, Suggestion]) -> list[str]:
    """Topics of signals whose stamps are of another clock than the odometry's."""
    if "v_x" not in signals:
        return []
    reference = signals["v_x"].topic
    used = {suggestion.topic.name: suggestion.topic for suggestion in signals.values()}
    return [
        f"{topic.name} is stamped {topic.lateness - reference.lateness:+.3g} s against {reference.name}: another clock?"
        for topic in used.values()
        if abs(topic.lateness - reference.lateness) > _CLOCK
    ]


def _spread(values: Vector) -> float:
    known = values[np.isfinite(values)]
    return float(np.ptp(known)) if len(known) else 0.0
