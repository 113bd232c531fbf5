"""Messages to named SI values: the one place where a message is taken apart, for bags and live topics alike."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from dynssm_ros.errors import BagError, ConfigurationError
from dynssm_ros.signals.estimation import MEASURED, LiveEstimation
from dynssm_ros.signals.signal_map import Accessor, SignalMap, Source, compile_field
from dynssm_ros.signals.velocities import LiveVelocities

Frames = tuple[str, str]
"""``frame_id`` of the header and ``child_frame_id``."""

LOG_TIME = "log time"
_OWN_STAMPS = ("stamp", "timestamp")  # of messages without a header, builtin_interfaces/Time


class _Reading(NamedTuple):
    signal: str
    source: Source
    read: Accessor
    to_si: Callable[[Any], Any]


def to_si(source: Source) -> Callable[[Any], Any]:
    """Turns what is in a message, or in the cells of a column, into SI units."""
    factor, offset = source.factor, source.offset
    if source.curve is None:
        return lambda raw: factor * raw + offset
    at, values = np.array(source.curve).T
    return lambda raw: factor * np.where(np.isfinite(raw), np.interp(raw, at, values), raw) + offset


class TopicDecoder:
    """Reads all signals that one topic carries, by their ``sources``, out of its messages."""

    def __init__(self, topic: str, msgtype: str, sources: Mapping[str, Source]) -> None:
        self.topic = topic
        self.msgtype = msgtype
        self.subscribed = next((source.topic for source in sources.values() if source.recorded == topic), topic)
        """The name as the map has it: relative ones are in the namespace of a node."""
        self._readings = [
            _Reading(name, source, compile_field(source.field), to_si(source))
            for name, source in sources.items()
            if source.recorded == topic
        ]

    @property
    def signals(self) -> tuple[str, ...]:
        """Names of the signals that this topic carries."""
        return tuple(reading.signal for reading in self._readings)

    def decode(self, message: Any, stamp: int | None = None) -> dict[str, float]:
        """The signals present in ``message`` in SI units; a joint that it does not name is left out.

        ``stamp`` (ns) is when it was measured, for decoders that follow the motion; of the header if not given.

        Raises:
            BagError: the message type has no such field, or the field is not a number.
        """
        values: dict[str, float] = {}
        for signal, source, read, convert in self._readings:
            try:
                raw = read(message)
            except AttributeError as error:
                raise BagError(
                    f"topic {self.topic}: {self.msgtype} has no field '{source.field}' for signal {signal} "
                    f"(at '{error.name}'; there: {_public_fields(error.obj)})"
                ) from error
            except (TypeError, ValueError, OverflowError) as error:
                raise BagError(
                    f"topic {self.topic}: field '{source.field}' for signal {signal} is not a number ({error})"
                ) from error
            if raw is not None:
                values[signal] = convert(raw)
        return values


class _PoseDecoder(TopicDecoder):
    """Adds the velocities that follow from the poses so far."""

    def __init__(self, topic: str, msgtype: str, signal_map: SignalMap, window: float) -> None:
        super().__init__(topic, msgtype, signal_map.active_signals())
        self._velocities = LiveVelocities(window)

    def decode(self, message: Any, stamp: int | None = None) -> dict[str, float]:
        """As :class:`TopicDecoder`, with ``v_x``, ``v_y`` and ``omega`` as soon as there are poses enough."""
        values, stamp = super().decode(message), header_stamp_ns(message) if stamp is None else stamp
        return values if stamp is None else values | self._velocities.add(stamp, values)


class _SensorDecoder(TopicDecoder):
    """Gives what the motion is estimated from to the estimation; its result comes with the topic of ``omega``."""

    def __init__(self, topic: str, msgtype: str, signal_map: SignalMap, estimation: LiveEstimation) -> None:
        super().__init__(topic, msgtype, signal_map.active_signals())
        self._estimation = estimation
        self._tells = topic == signal_map.odometry_topic

    def decode(self, message: Any, stamp: int | None = None) -> dict[str, float]:
        """As :class:`TopicDecoder`, with what is estimated instead of what it is estimated from."""
        values, stamp = super().decode(message), header_stamp_ns(message) if stamp is None else stamp
        rest = {name: value for name, value in values.items() if name not in MEASURED}
        if stamp is None:
            return rest
        self._estimation.add(stamp, values)
        return rest | self._estimation.at(stamp) if self._tells else rest


def live_decoders(signal_map: SignalMap) -> dict[str, TopicDecoder]:
    """As :func:`decoders`, with velocities from poses or sensors so far where the map has none."""
    found = decoders(signal_map)
    if signal_map.estimation is not None:
        estimation = LiveEstimation(signal_map)
        return {topic: _SensorDecoder(topic, one.msgtype, signal_map, estimation) for topic, one in found.items()}
    if signal_map.velocities is not None:
        topic = signal_map.odometry_topic
        found[topic] = _PoseDecoder(topic, found[topic].msgtype, signal_map, signal_map.velocities.window)
    return found


def decoders(signal_map: SignalMap, compared: Mapping[str, Source] | None = None) -> dict[str, TopicDecoder]:
    """A decoder for each topic of the map, actuators first so that a node serves them before the odometry.

    Signals that are ``compared`` alone are read beside those that are used.

    Raises:
        ConfigurationError: the map is of a table.
    """
    if signal_map.is_of_table:
        raise ConfigurationError(
            f"signal map {signal_map.name}: names columns of a table; expected the topics of a car or a bag"
        )
    sources = signal_map.active_signals() | dict(compared or {})
    types = {source.recorded: source.type for source in sources.values()}
    order = sorted(types, key=lambda topic: topic == signal_map.odometry_topic)
    return {topic: TopicDecoder(topic, types[topic], sources) for topic in order}


def header_stamp_ns(message: Any) -> int | None:
    """The stamp of the header or, without one, of the message itself (``stamp``), in integer nanoseconds; ``None`` where
    there is neither.
    """
    _, stamp = _stamp(message)
    return None if stamp is None else int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def stamped_by(message: Any) -> str:
    """What says when a message was measured: ``header``, the name of a field of its own, or :data:`LOG_TIME`."""
    return _stamp(message)[0]


def _stamp(message: Any) -> tuple[str, Any]:
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    if hasattr(stamp, "nanosec"):
        return "header", stamp
    for name in _OWN_STAMPS:
        stamp = getattr(message, name, None)
        if hasattr(stamp, "nanosec"):
            return name, stamp
    return LOG_TIME, None


def frames_told(message: Any) -> str:
    """The frame of a message and that of its twist as people read them, ``odom -> base_link``; empty without a header."""
    try:
        frame = str(message.header.frame_id)
    except AttributeError:
        return ""
    return f"{frame} -> {message.child_frame_id}" if hasattr(message, "child_frame_id") else frame


def frames_of(message: Any) -> Frames | None:
    """The frames of odometry, or ``None`` where the message names none of its own."""
    try:
        return message.header.frame_id, message.child_frame_id
    except AttributeError:
        return None


def _public_fields(message: Any) -> str:
    names: Any = getattr(message, "__slots__", None) or getattr(message, "__dict__", ())
    return ", ".join(sorted(name.lstrip("_") for name in names if not name.startswith(("__", "_check")))) or "nothing"
