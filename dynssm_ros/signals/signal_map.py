"""The signal map: which field of which topic, or which column of a table, is which signal.

Extractor, node, player and replay share it; columns are for the extractor alone.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection
from itertools import groupby, pairwise
from operator import attrgetter
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from dynssm_ros import configuration
from dynssm_ros.arrays import Vector
from dynssm_ros.configuration import StrictModel
from dynssm_ros.signals.motion_filter import Estimation
from dynssm_ros.vehicle.single_track import SetPoint

Commands = Literal["topics", "lookahead", "none"]
"""Where ``u_t`` comes from: recorded command topics, the next feedback sample (offline only), or nowhere (zero)."""

STATE_SIGNALS = ("v_x", "v_y", "omega")
POSE_SIGNALS = ("x", "y", "theta")
REQUIRED_SIGNALS = (*STATE_SIGNALS, "throttle_feedback", "steering_feedback")
COMMAND_SIGNALS = ("throttle_command", "steering_command")
_OF_THROTTLE = ("throttle_feedback", "throttle_command", "brake_feedback", "brake_command")
STANDARD_MAPS: dict[SetPoint, str] = {"throttle": "default", "speed": "default_speed"}
"""Shipped maps of the package's own topics."""
SPEED_SIGNALS = ("speed_feedback", "speed_command")
SENSORS = ("a_x", "a_y", "latitude", "longitude", "v_east", "v_north")
"""From which velocities are estimated; no columns of a recording."""
CONTEXT_SIGNALS = ("gear", "engine_speed")
"""What a recording keeps beside, for diagnosis and the anatomy of errors; no model and no node needs it."""
STEPPED_SIGNALS = (*SPEED_SIGNALS, "gear")
"""Those that stay until the next sample, however fast they come."""
COMPARED = ("a_x", "a_y", "wheel_speed")
"""Compared with measured velocities where a log has them; no columns of a recording."""
SIGNALS = (
    *REQUIRED_SIGNALS,
    *POSE_SIGNALS,
    *COMMAND_SIGNALS,
    "brake_feedback",
    "brake_command",
    *SPEED_SIGNALS,
    *SENSORS,
    *CONTEXT_SIGNALS,
    "wheel_speed",
)

Hold = Literal["zero", "first"]
"""What a signal is between two samples: the last one, or on a line to the next."""
ROUNDING = 1e-6
"""Periods by which an instant of a grid may miss a sample."""
JUMP_NS = 500_000_000
"""Time between two stamps (ns) up to which the second is not doubted, however short ``max_gap`` is."""

UNITS = {
    "m/s": 1.0, "km/h": 1 / 3.6, "mph": 0.44704, "kt": 1852 / 3600, "ft/s": 0.3048, "rad": 1.0, "deg": math.pi / 180,
    "rad/s": 1.0, "deg/s": math.pi / 180, "m": 1.0, "cm": 0.01, "mm": 0.001, "km": 1000.0, "ft": 0.3048, "%": 0.01, "1": 1.0,
    "m/s^2": 1.0, "g": 9.80665, "rpm": math.pi / 30,
}  # fmt: skip
"""Units of fields and columns, and what one is in SI units."""
TIME_UNITS = {
    "s": 1_000_000_000, "ms": 1_000_000, "us": 1000, "ns": 1, "min": 60_000_000_000, "h": 3_600_000_000_000,
    "days": 86_400_000_000_000,
}  # fmt: skip
"""Units of time columns, and what one is in ns."""

Accessor = Callable[[Any], float | None]
_NOT_UNIT = 0.1  # squared length of a quaternion: some drivers publish some that are not quite unit
_STEP = r"[A-Za-z_]\w*(?:\[[^\[\]().]+\])?"
_PATH = rf"{_STEP}(?:\.{_STEP})*"
_FIELD = re.compile(rf"^(?:yaw\((?P<yaw>{_PATH})\)|(?P<path>{_PATH}))\Z")
_YAW_OF_COLUMNS = re.compile(r"^yaw\((?P<names>[^,]+(?:,[^,]+){3})\)\Z")
_OUTSIDE_BRACKETS = r"(?![^\[]*\])"
_PLUS, _TIMES = re.compile(rf"\s*\+\s*{_OUTSIDE_BRACKETS}"), re.compile(rf"\s*\*\s*{_OUTSIDE_BRACKETS}")


class TimeColumn(StrictModel):
    """The time column of a table."""

    column: str = Field(min_length=1, description="its heading")
    unit: Literal["s", "ms", "us", "ns", "min", "h", "days"] | None = Field(
        default=None, description="of its numbers; null for dates and times of day, and where its steps tell"
    )
    nanoseconds: str | None = Field(default=None, description="column of the ns beside whole seconds, as in ROS stamps")


class Source(StrictModel):
    """Where one signal comes from, a field of a topic or a column; its value is ``scale * unit * curve(field) + offset``."""

    column: str = Field(
        default="",
        description="heading of a table's column, instead of topic, type and field; yaw(qx, qy, qz, qw) of a quaternion in "
        "four of them",
    )
    topic: str = Field(
        default="",
        pattern=r"^(?:/?(?:\w+/)*\w+)?$",
        description="topic name; relative names, without a slash in front, are in the namespace of the node",
    )
    type: str = Field(default="", pattern=r"^(?:\w+/msg/\w+)?$", description="message type, package/msg/Name")
    field: str = Field(
        default="",
        description="dotted path; position[steering] picks by name or index; yaw(path) of a quaternion. Sums of products of "
        "these: torque[fl] + torque[fr], pressure * area",
    )
    curve: tuple[tuple[float, float], ...] | None = Field(
        default=None,
        min_length=2,
        description="points (field, value) of a measured curve or a dead band: lines between them, the ends held",
    )
    unit: str = Field(default="1", description=f"of the field, or of what its curve gives: {' '.join(UNITS)}")
    scale: float = 1.0
    offset: float = 0.0
    delay: float = Field(
        default=0.0, gt=-100.0, lt=100.0, description="by which stamps are late (s); live only 0 to below 1"
    )
    hold: Hold | None = Field(
        default=None,
        description="between samples: zero, the last one; first, a line to the next, which a live node does not know. null: "
        "zero for set-points and gears, and for actuators and commands that come more slowly than the rows of a recording, "
        "else first",
    )

    @model_validator(mode="after")
    def _one_place(self) -> Source:
        named = [name for name in ("topic", "type", "field") if getattr(self, name)]
        if self.column and named:
            raise ValueError(f"column '{self.column}' and {named[0]} '{getattr(self, named[0])}'; expected either")
        missing = [name for name in ("topic", "type", "field") if name not in named]
        if missing and not self.column:
            raise ValueError(f"{missing[0]} is missing; expected topic, type and field, or the column of a table")
        return self

    @field_validator("unit")
    @classmethod
    def _is_known(cls, value: str) -> str:
        if value not in UNITS:
            raise ValueError(f"expected one of {' '.join(UNITS)}")
        return value

    @property
    def factor(self) -> float:
        """Of a field, or of what its curve gives, to SI units."""
        return self.scale * UNITS[self.unit]

    @property
    def columns(self) -> tuple[str, ...]:
        """Headings of the columns that are read: one, or the x, y, z and w of a quaternion."""
        match = _YAW_OF_COLUMNS.match(self.column)
        return tuple(name.strip() for name in match["names"].split(",")) if match else (self.column,)

    @property
    def recorded(self) -> str:
        """The topic's absolute name in a bag of one car."""
        return f"/{self.topic.removeprefix('/')}"

    @field_validator("field")
    @classmethod
    def _parses(cls, value: str) -> str:
        if value and not all(_FIELD.match(path) for term in _terms(value) for path in term):
            raise ValueError(
                "expected a dotted path such as twist.twist.linear.x, position[steering] or yaw(pose), or a sum (+) of "
                "products (*) of them"
            )
        return value

    @field_validator("curve")
    @classmethod
    def _rises(cls, value: tuple[tuple[float, float], ...] | None) -> tuple[tuple[float, float], ...] | None:
        at = [] if value is None else [point[0] for point in value]
        if any(b <= a for a, b in pairwise(at)):
            raise ValueError("expected points in the order of rising field values")
        return value


class Velocities(StrictModel):
    """How velocities follow from poses; see :mod:`dynssm_ros.signals.velocities`."""

    window: float = Field(default=0.1, gt=0, le=1.0, description="time over which a motion is fitted to the poses (s)")


class SignalMap(StrictModel):
    """All signals of a car's stack."""

    name: str
    commands: Commands = "topics"
    max_gap: float = Field(default=0.25, gt=0, description="longest time between samples that is bridged (s)")
    time: TimeColumn | None = Field(default=None, description="time column of a table; null: found by name and steps")
    velocities: Velocities | None = Field(
        default=None, description="for cars whose pose alone is measured; null: v_x, v_y and omega are signals"
    )
    estimation: Estimation | None = Field(
        default=None, description="for cars whose v_y is not measured; given where a_y is a signal and v_y is not"
    )
    signals: dict[str, Source]

    @field_validator("signals", mode="before")
    @classmethod
    def _none_given(cls, value: Any) -> Any:
        """None yet, as where a suggested map has found nothing, are missing ones."""
        return {} if value is None else value

    @model_validator(mode="before")
    @classmethod
    def _that_estimates(cls, content: Any) -> Any:
        """A map of an accelerometer that leaves out ``v_y`` means that it is estimated."""
        if not isinstance(content, dict) or not isinstance(content.get("signals"), dict):
            return content
        means = "a_y" in content["signals"] and "v_y" not in content["signals"] and not content.get("velocities")
        return content | {"estimation": content.get("estimation") or {}} if means else content

    @model_validator(mode="before")
    @classmethod
    def _without_commands(cls, content: Any) -> Any:
        """A map that names no command has none, unless it says where they come from."""
        if not isinstance(content, dict) or "commands" in content or not isinstance(content.get("signals"), dict):
            return content
        named = any(name in content["signals"] for name in (*COMMAND_SIGNALS, "speed_command"))
        return content if named else content | {"commands": "none"}

    @model_validator(mode="after")
    def _known_and_complete(self) -> SignalMap:
        unknown = [name for name in self.signals if name not in SIGNALS]
        if unknown:
            raise ValueError(f"signals: unknown '{unknown[0]}'; expected {' '.join(SIGNALS)}")
        if len({bool(source.column) for source in self.signals.values()}) > 1:
            raise ValueError("signals: some are columns of a table, others fields of topics; expected either")
        if self.set_point == "speed" and (other := [name for name in self.signals if name in _OF_THROTTLE]):
            raise ValueError(f"signals.{other[0]}: the input is a speed set-point; expected either speed or throttle")
        if self.estimation is not None:
            self._can_estimate()
        needed = self.required + (self.command_signals if self.commands == "topics" else ())
        if self.velocities is not None:
            double = [name for name in STATE_SIGNALS if name in self.signals]
            if double:
                raise ValueError(f"signals.{double[0]}: velocities come from poses; expected either")
            if len({self.signals[name].topic for name in POSE_SIGNALS if name in self.signals}) > 1:
                raise ValueError("velocities: x, y and theta come from several topics; expected one")
            needed = (*POSE_SIGNALS, *needed[len(STATE_SIGNALS) :])
        elif self.estimation is not None:
            needed = tuple(name for name in needed if name != "v_y")
        missing = [name for name in needed if name not in self.signals]
        if missing:
            hint = "; map a_y or write `estimation: {}` to have v_y estimated" if missing == ["v_y"] else ""
            raise ValueError(f"signals: missing {', '.join(missing)} (commands: {self.commands}){hint}")
        for name in POSE_SIGNALS if self.estimation is not None else (*STATE_SIGNALS, *POSE_SIGNALS):
            if name in self.signals and self.signals[name].delay:
                raise ValueError(f"signals.{name}.delay: late odometry is the controller's `delay`; expected none")
        types: dict[str, str] = {}
        for source in self.signals.values():
            if types.setdefault(source.recorded, source.type) != source.type:
                raise ValueError(f"signals: topic {source.topic} is given two types")
        return self

    def _can_estimate(self) -> None:
        """Checks what only maps that estimate have."""
        if self.velocities is not None or "v_y" in self.signals:
            other = "velocities" if self.velocities is not None else "signals.v_y"
            raise ValueError(f"estimation: v_y comes from {other}; expected either")
        for one, other in (("latitude", "longitude"), ("v_east", "v_north"), ("x", "y")):
            pair = [self.signals[name] for name in (one, other) if name in self.signals]
            if len(pair) == 1 or len({source.topic for source in pair}) > 1:
                raise ValueError(f"signals: {one} and {other} come alone or apart; expected both from one topic")
        turned = [name for name in ("latitude", "longitude") if name in self.signals and self.signals[name].unit != "1"]
        if turned:
            raise ValueError(
                f"signals.{turned[0]}.unit: '{self.signals[turned[0]].unit}'; it is in degrees, expected none"
            )
        if "latitude" in self.signals and "x" in self.signals:
            raise ValueError("signals.latitude: the position is x and y already; expected either")

    @property
    def set_point(self) -> SetPoint:
        """What the first input is: a throttle, or the set-point of a speed controller."""
        return set_point_of(self.signals)

    @property
    def required(self) -> tuple[str, ...]:
        """The signals that are needed: state, first input and steering."""
        return required_signals(self.set_point)

    @property
    def command_signals(self) -> tuple[str, str]:
        """The commands of both inputs."""
        return command_signals(self.set_point)

    @property
    def is_of_table(self) -> bool:
        """Whether signals are columns of a table rather than fields of topics."""
        return any(source.column for source in self.signals.values())

    @property
    def odometry_topic(self) -> str:
        """The topic whose messages trigger predictions and anchor the time grid: that of ``v_x``, or of the pose.

        Where velocities are estimated it is that of ``omega``.
        """
        if self.estimation is not None:
            return self.signals["omega"].recorded
        return self.signals["v_x" if self.velocities is None else "x"].recorded

    @property
    def max_gap_ns(self) -> int:
        """``max_gap`` in integer nanoseconds."""
        return round(self.max_gap * 1e9)

    @property
    def jump_ns(self) -> int:
        """Time between stamps from which on the second is believed only if others confirm it (ns)."""
        return max(JUMP_NS, 2 * self.max_gap_ns)

    def with_commands(self, commands: Commands | None) -> SignalMap:
        """The same map with another source of commands; ``None`` keeps it.

        Raises:
            ConfigurationError: ``topics`` asked of a map without command signals.
        """
        if commands is None:
            return self
        content = self.model_dump() | {"commands": commands}
        return configuration.validate(SignalMap, content, f"signal map {self.name}")

    def without(self, names: Collection[str]) -> SignalMap:
        """The same map without some signals that are not required."""
        return self.model_copy(update={"signals": {k: v for k, v in self.signals.items() if k not in names}})

    def active_signals(self) -> dict[str, Source]:
        """The signals that are read: commands only where ``commands: topics``, sensors where velocities are estimated."""
        skipped: tuple[str, ...] = () if self.commands == "topics" else (*self.command_signals, "brake_command")
        skipped += ("wheel_speed", *(SENSORS if self.estimation is None else ()))
        return {name: source for name, source in self.signals.items() if name not in skipped}


def set_point_of(signals: Collection[str]) -> SetPoint:
    """What the first input of these signals is."""
    return "speed" if any(name in signals for name in SPEED_SIGNALS) else "throttle"


def required_signals(set_point: SetPoint) -> tuple[str, ...]:
    """The signals that a recording needs: state, first input and steering."""
    return *STATE_SIGNALS, f"{set_point}_feedback", "steering_feedback"


def command_signals(set_point: SetPoint) -> tuple[str, str]:
    """The commands of both inputs."""
    return f"{set_point}_command", "steering_command"


def load_signal_map(name_or_path: str | Path) -> SignalMap:
    """Reads a signal map by shipped name or path.

    Raises:
        ConfigurationError: not found, malformed, or with unknown or missing signals.
    """
    return configuration.load(SignalMap, "signals", name_or_path)


def compile_field(field: str) -> Accessor:
    """Turns a field path, or a sum of products of them, into a function of the message.

    The function returns ``None`` where a joint name or index is not in this message (a partial JointState is legal)
    and raises ``AttributeError`` where the message type has no such field.
    """
    terms = [[_compile_path(path) for path in term] for term in _terms(field)]
    if len(terms) == len(terms[0]) == 1:
        return terms[0][0]

    def total(message: Any) -> float | None:
        values = [[read(message) for read in term] for term in terms]
        present = [[value for value in term if value is not None] for term in values]
        return None if present != values else sum(math.prod(term) for term in present)

    return total


def _terms(field: str) -> list[list[str]]:
    """The paths of a sum of products."""
    return [_TIMES.split(term) for term in _PLUS.split(field)]


def _compile_path(field: str) -> Accessor:
    match = _FIELD.match(field)
    if match is None:
        raise ValueError(f"not a field path: {field}")
    steps: list[Callable[[Any], Any]] = []
    for indexed, run in groupby((match["yaw"] or match["path"]).split("."), lambda name: "[" in name):
        names = list(run)
        steps += [_element(name) for name in names] if indexed else [attrgetter(".".join(names))]

    number = _yaw if match["yaw"] else float

    def value(message: Any) -> float | None:
        for step in steps:
            message = step(message)
            if message is None:
                return None
        return number(message)

    return value


def _yaw(q: Any) -> float:
    """Of a quaternion; NaN if its length is not near 1, as where nobody filled it in."""
    if abs(q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z - 1.0) > _NOT_UNIT:
        return math.nan
    return math.atan2(2.0 * (q.w * q.z + q.x * q.y), q.w * q.w + q.x * q.x - q.y * q.y - q.z * q.z)


def yaw_of(x: Vector, y: Vector, z: Vector, w: Vector) -> Vector:
    """Yaw (rad) of quaternions, each ``(N,)``; NaN where the length is not near 1."""
    yaw = np.arctan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)
    return np.where(np.abs(w * w + x * x + y * y + z * z - 1.0) > _NOT_UNIT, np.nan, yaw)


def _element(part: str) -> Callable[[Any], Any]:
    """The element of an array by its index, or by the name beside it."""
    name, _, key = part.rstrip("]").partition("[")
    index = int(key) if key.isdecimal() else None

    def element(message: Any) -> Any:
        values = getattr(message, name)
        at = index if index is not None else message.name.index(key) if key in message.name else len(values)
        return values[at] if at < len(values) else None

    return element
