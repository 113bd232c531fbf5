"""Race logs to a recording: what ``dynssm extract`` does."""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dynssm_ros.errors import BagError, RecordingError
from dynssm_ros.progress import Progress
from dynssm_ros.signals.bags import Bag
from dynssm_ros.signals.consistency import checked
from dynssm_ros.signals.decoding import LOG_TIME, decoders, frames_told, header_stamp_ns, stamped_by, to_si
from dynssm_ros.signals.estimation import MEASURED, estimated, noise_notes, require_degrees
from dynssm_ros.signals.findings import Finding
from dynssm_ros.signals.logs import open_log
from dynssm_ros.signals.recording import V_Y_DEVIATION, Recording, RecordingInfo, concatenate
from dynssm_ros.signals.resampling import SLOW, Stamps, Stream, resample, without_repeats
from dynssm_ros.signals.rest_value import rest_value
from dynssm_ros.signals.sensor_consistency import sensor_findings
from dynssm_ros.signals.signal_map import (
    COMPARED,
    CONTEXT_SIGNALS,
    POSE_SIGNALS,
    SENSORS,
    STATE_SIGNALS,
    STEPPED_SIGNALS,
    SignalMap,
    Source,
    yaw_of,
)
from dynssm_ros.signals.stamps import (
    Lateness,
    clean,
    clock_findings,
    clock_notes,
    clocks_apart,
    frames_note,
    log_time_note,
    publishers_note,
)
from dynssm_ros.signals.stated_units import unit_notes
from dynssm_ros.signals.table_clock import clock_of
from dynssm_ros.signals.tables import LogTable
from dynssm_ros.signals.velocities import velocities_along


def extract(
    bags: Sequence[str | Path],
    signal_map: SignalMap,
    rate: float,
    drop_bad: bool = False,
    progress: Progress | None = None,
    *,
    wheelbase: float | None = None,
) -> Recording:
    """Reads logs and brings their signals onto a uniform grid.

    Args:
        bags: bags or tables of one car, in the order in which they shall be joined.
        signal_map: where the signals are.
        rate: of the grid (Hz).
        drop_bad: leave out samples that are not finite or whose stamps repeat or run backwards, instead of raising.
        progress: told of each message.
        wheelbase: of the car (m), with which the scale of the steering is checked too.

    Raises:
        BagError: unreadable, topics or columns missing or of another type, bad samples.
        RecordingError: the signals never overlap in time.
    """
    recordings = [_extract(path, signal_map, rate, drop_bad, progress) for path in bags]
    lacking = [", ".join(one.info.source) for one in recordings if one.info.commands != signal_map.commands]
    if 0 < len(lacking) < len(recordings):  # commands of some logs alone cannot be joined
        none, note = signal_map.with_commands("none"), f"no commands in {', '.join(lacking)}; commands: none"
        recordings = [_extract(path, none, rate, drop_bad, progress, note) for path in bags]
    return concatenate([checked(one, wheelbase) for one in recordings])


def _extract(
    path: str | Path, signal_map: SignalMap, rate: float, drop_bad: bool, progress: Progress | None, note: str = ""
) -> Recording:
    """The recording of one log, whose notes begin with ``note``."""
    with open_log(path) as log:
        signal_map, lack = _with_commands_of(log, signal_map)
        signal_map, left_out = _without_lacking_context(log, signal_map)
        streams, stamped, notes, findings = read_streams(log, signal_map, drop_bad, progress)
    streams, rests = _with_brakes_at_rest(streams, signal_map)
    streams, repeats = without_repeats(streams)
    notes = [*([note] if note else []), *notes, *lack, *left_out, *rests, *repeats]
    if signal_map.velocities is not None:
        streams |= pose_velocities(streams, signal_map.velocities.window, str(path))
        notes.append(f"v_x, v_y, omega: from poses, over {signal_map.velocities.window:g} s")
    deviations: dict[str, float] = {}
    require_degrees(streams, str(path))
    findings += sensor_findings(streams, signal_map)
    if signal_map.estimation is not None:
        streams, deviations, told = estimated_velocities(streams, signal_map, str(path))
        notes += told
    streams = {name: one for name, one in streams.items() if name not in COMPARED}
    held = held_signals(signal_map, streams, 1e9 / rate)
    info = RecordingInfo(
        sampling_time=1 / rate,
        commands=signal_map.commands,
        set_point=signal_map.set_point,
        source=(Path(path).name,),
        signal_map=signal_map.name,
        held=tuple(held),
        held_periods=held,
        stamped=stamped,
        standard_deviations=deviations,
        notes=tuple(notes),
        findings=findings,
    )
    return resample(streams, rate, signal_map.max_gap, signal_map.commands, info)


def _with_brakes_at_rest(streams: dict[str, Stream], signal_map: SignalMap) -> tuple[dict[str, Stream], list[str]]:
    """The streams with brakes that are 0 while nobody brakes, and what the map has to say for a live node to do so."""
    found, notes = dict(streams), []
    for name in ("brake_feedback", "brake_command"):
        limit = rest_value(streams[name].values) if name in streams else 0.0
        if limit > 0:
            found[name] = Stream(streams[name].stamps, streams[name].values - limit)
            notes.append(
                f"{name}: up to {limit:.4g} nobody brakes, and the throttle would not count; taken off (for the live node "
                f"write offset: {signal_map.signals[name].offset - limit:.4g} in the signal map)"
            )
    return found, notes


def _with_commands_of(log: Bag | LogTable, signal_map: SignalMap) -> tuple[SignalMap, list[str]]:
    """The map, without commands where the log lacks a topic or column of them, and a note on it."""
    if signal_map.commands != "topics":
        return signal_map, []
    sources = [signal_map.signals[name] for name in signal_map.command_signals]
    missing = [what for one in sources if (what := _lacking(log, one))]
    if not missing:
        return signal_map, []
    told = " and ".join(dict.fromkeys(missing))
    return signal_map.with_commands("none"), [f"no commands in the log ({told}); commands: none"]


def _without_lacking_context(log: Bag | LogTable, signal_map: SignalMap) -> tuple[SignalMap, list[str]]:
    """The map without gear or engine speed where the log lacks them, and a note on each."""
    mapped = [name for name in CONTEXT_SIGNALS if name in signal_map.signals]
    lacking = {name: what for name in mapped if (what := _lacking(log, signal_map.signals[name]))}
    return signal_map.without(lacking), [f"{name}: no {what} in the log; left out" for name, what in lacking.items()]


def _lacking(log: Bag | LogTable, source: Source) -> str:
    """The topic or column of a signal if the log does not have it, else nothing."""
    if isinstance(log, LogTable):
        return f"column '{source.column}'" if source.column and source.column not in log.headings else ""
    return f"topic {source.recorded}" if not source.column and not log.counts.get(source.recorded) else ""


def pose_velocities(streams: Mapping[str, Stream], window: float, where: str) -> dict[str, Stream]:
    """Streams of ``v_x``, ``v_y`` and ``omega`` from those of the pose, without delay.

    Raises:
        RecordingError: fewer poses in a row than a window has, or none.
    """
    lacking = [name for name in POSE_SIGNALS if name not in streams]
    if lacking:
        raise RecordingError(f"{where}: {', '.join(lacking)}: no good sample, needed for velocities from poses")
    x, y, theta = (streams[name] for name in POSE_SIGNALS)
    stamps = np.intersect1d(np.intersect1d(x.stamps, y.stamps), theta.stamps)  # dropped ones may differ
    columns = [one.values[np.searchsorted(one.stamps, stamps)] for one in (x, y, theta)]
    poses = np.stack([*columns[:2], np.unwrap(columns[2])], axis=1)
    rows, found = velocities_along((stamps - stamps[0]) / 1e9, poses, window)
    if not len(rows):
        raise RecordingError(f"{where}: {len(stamps)} poses; expected more in a row, for windows of {window:g} s")
    return {name: Stream(stamps[rows], values) for name, values in zip(STATE_SIGNALS, found.T, strict=True)}


def estimated_velocities(
    streams: Mapping[str, Stream], signal_map: SignalMap, where: str
) -> tuple[dict[str, Stream], dict[str, float], list[str]]:
    """Streams with estimated velocities, and a pose by fixes, instead of those that they are estimated from.

    Returns:
        The streams, the standard deviation of each velocity (root mean square), and notes.

    Raises:
        RecordingError: ``omega`` and ``v_x`` are nowhere known together.
    """
    settings = signal_map.estimation
    assert settings is not None
    samples = {name: (one.stamps, one.values) for name, one in streams.items()}
    found = estimated(samples, settings, signal_map.max_gap_ns, where=where)
    kept = {name: one for name, one in streams.items() if name not in (*STATE_SIGNALS, *SENSORS)}
    kept |= {name: Stream(found.stamps, one) for name, one in zip(STATE_SIGNALS, found.states.T, strict=True)}
    kept[V_Y_DEVIATION] = Stream(found.stamps, found.deviations[:, 1])
    used = [name for name in MEASURED if name in streams]
    typical, most = np.quantile(found.deviations[:, 1], [0.5, 0.95])
    notes = [
        f"v_x, v_y, omega: estimated from {', '.join(used)}; standard deviation of v_y {typical:.2g} m/s, 95 % below "
        f"{most:.2g}",
        *noise_notes(samples, settings),
    ]
    known = np.isfinite(found.poses).all(axis=1)
    if "theta" not in streams and known.any():
        kept |= {
            name: Stream(found.stamps[known], one[known]) for name, one in zip(POSE_SIGNALS, found.poses.T, strict=True)
        }
        if found.origin is not None:
            origin = ", ".join(f"{angle:.7f}" for angle in found.origin)
            notes.append(
                f"x, y: east and north of latitude, longitude {origin} (estimation.origin shares it between logs)"
            )
    elif "theta" not in streams and ("x" in streams or "latitude" in streams):
        kept = {name: one for name, one in kept.items() if name not in POSE_SIGNALS}
        notes.append("x, y, theta: left out, as the positions never tell the heading")
    squares = np.sqrt((found.deviations**2).mean(axis=0)).tolist()
    return kept, dict(zip(STATE_SIGNALS, squares, strict=True)), notes


def held_signals(signal_map: SignalMap, streams: Mapping[str, Stream], period: float) -> dict[str, float]:
    """The signals that keep their last sample until the next, on a grid of ``period`` (ns), and how long they do (s).

    Actuators that come more slowly than the rows would else look ahead of what a live node knows. A set-point stays until
    the next one.
    """
    held = {}
    for name, source in signal_map.active_signals().items():
        stamps = streams[name].stamps if name in streams else np.empty(0, np.int64)
        between = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 0.0
        slow = between > SLOW * period and name not in (*STATE_SIGNALS, *POSE_SIGNALS)
        usual = "zero" if slow or name in STEPPED_SIGNALS else "first"
        if (source.hold or usual) == "zero":
            held[name] = between / 1e9
    return held


class LogStreams(NamedTuple):
    """What was read of a log."""

    streams: dict[str, Stream]  # by signal
    stamped: dict[str, str]  # by what those of a bag are stamped
    notes: list[str]  # what was recovered or dropped
    findings: tuple[Finding, ...]  # clocks that are apart


def read_streams(
    log: Bag | LogTable, signal_map: SignalMap, drop_bad: bool = False, progress: Progress | None = None
) -> LogStreams:
    """Reads the samples of every mapped signal; memory holds these and one message, or the columns, at a time.

    Stamps are those of headers or of the messages themselves, and log times only where there is neither; of tables
    those of their time column.

    Raises:
        BagError: a topic, field or column is missing, or samples are bad and ``drop_bad`` is off.
    """
    stamped: dict[str, str] = {}
    findings: tuple[Finding, ...] = ()
    told: list[str] = []
    compared = _compared(log, signal_map)
    if isinstance(log, LogTable):
        found = _table_streams(log, signal_map, compared, drop_bad)
    else:
        found, stamped, told, findings = _bag_streams(log, signal_map, compared, progress)
    notes = [*log.notes, *told, *unit_notes(log, signal_map.active_signals() | compared)]
    streams: dict[str, Stream] = {}
    for name, source in (signal_map.active_signals() | compared).items():
        place = f"column '{source.column}'" if source.column else f"topic {source.recorded}"
        hopeless = name in POSE_SIGNALS and len(found[name].values) > 0 and not np.isfinite(found[name].values).any()
        where = f"{log.path}: {place}: {name}" + (f" = {source.field}" if source.field.startswith("yaw(") else "")
        stream, dropped = clean(found[name], where, drop_bad or hopeless, signal_map.jump_ns)
        if dropped:
            notes.append(f"{name}: dropped {dropped}")
        if len(stream.stamps):
            streams[name] = stream
            continue
        counted = 1 if isinstance(log, LogTable) else log.counts[source.recorded]
        lack = f"has no good sample of '{source.field}'" if dropped else f"never carries '{source.field}'"
        lack += ", as its quaternions are not of length 1" if dropped and source.field.startswith("yaw(") else ""
        lack = "has no good value" if source.column else lack
        if name not in (*POSE_SIGNALS, *CONTEXT_SIGNALS) or not counted:
            raise BagError(f"{log.path}: {place} {lack if counted else 'has no messages'}, needed for {name}")
        notes.append(f"{name}: {place} {lack}; left out")
    if {"x", "y"} <= set(streams) and len(streams["x"].stamps) == len(streams["y"].stamps):
        source = signal_map.signals["x"]
        notes += publishers_note(source.column or source.recorded, streams["x"].values, streams["y"].values)
    return LogStreams(streams, stamped, notes, findings)


def _compared(log: Bag | LogTable, signal_map: SignalMap) -> dict[str, Source]:
    """Signals that are only compared with measured velocities, as far as the log has them."""
    active = signal_map.active_signals()
    return {
        name: source
        for name, source in signal_map.signals.items()
        if name in COMPARED and name not in active and not _lacking(log, source)
    }


def _bag_streams(bag: Bag, signal_map: SignalMap, compared: dict[str, Source], progress: Progress | None) -> LogStreams:
    """The samples of every mapped signal, as they came, with notes on stamps and frames."""
    by_topic = decoders(signal_map, compared)
    for topic, decoder in by_topic.items():
        bag.require(topic, decoder.msgtype)
    samples, stamped = _Samples(), dict.fromkeys(by_topic, "")
    frames: dict[str, Counter[str]] = {topic: Counter() for topic in by_topic}
    total = sum(bag.counts[topic] for topic in by_topic)
    for done, (topic, log_time, raw) in enumerate(bag.messages(list(by_topic)), 1):
        message = bag.decode(topic, raw)
        stamped[topic] = stamped[topic] or stamped_by(message)
        try:
            present = by_topic[topic].decode(message)
        except BagError as error:
            raise BagError(f"{bag.path}: {error}") from error
        samples.add(topic, log_time, header_stamp_ns(message) or 0, present)
        frames[topic][frames_told(message)] += 1
        if progress is not None:
            progress(done, total)
    notes: list[str] = []
    lateness: dict[str, Lateness] = {}
    by_log_time = {topic for topic, by in stamped.items() if by == LOG_TIME}
    for topic in by_topic:
        logged, stamps = samples.times(topic)
        unset = int((stamps == 0).sum())
        if topic in by_log_time:
            notes.append(log_time_note(topic))
        elif unset > 1:  # one may be where simulated time begins
            notes.append(f"{topic}: {unset} of {len(stamps)} messages have the stamp 0; they count by log time")
            by_log_time.add(topic)
            stamped[topic] = LOG_TIME if unset == len(stamps) else stamped[topic]
        order = np.argsort(logged, kind="stable")
        order = order[stamps[order] != 0]
        lateness[topic] = Lateness(logged[order] / 1e9, (logged[order] - stamps[order]) / 1e9)
        notes += frames_note(topic, frames[topic])
    notes += clock_notes(lateness, signal_map.odometry_topic)
    active = (signal_map.active_signals() | compared).items()
    streams = {
        name: samples.stream(name, round(source.delay * 1e9), source.recorded in by_log_time) for name, source in active
    }
    findings = clock_findings(clocks_apart(lateness, signal_map.odometry_topic), signal_map)
    return LogStreams(streams, {name: stamped[source.recorded] for name, source in active}, notes, findings)


def _table_streams(
    table: LogTable, signal_map: SignalMap, compared: dict[str, Source], drop_bad: bool
) -> dict[str, Stream]:
    """The cells of every mapped column that have a value, as they came."""
    if not signal_map.is_of_table:
        raise BagError(
            f"{table.path}: a table, and signal map {signal_map.name} names topics; expected one with columns (`dynssm "
            f"inspect` suggests it)"
        )
    active = signal_map.active_signals() | compared
    columns = table.read([column for source in active.values() for column in source.columns])
    clock = clock_of(table, signal_map.time)
    streams = {}
    for name, source in active.items():
        parts = {heading: columns[heading] for heading in source.columns}
        for heading, column in parts.items():
            wrong = column.reason or ("" if drop_bad else column.bad)
            if wrong:
                hint = "" if column.reason else " (--drop-bad leaves such cells out)"
                raise BagError(f"{table.path}: column '{heading}' for {name}: {wrong}; expected numbers{hint}")
        there = np.logical_and.reduce([clock.known, *(column.present for column in parts.values())])
        stamps = clock.stamps[there] - round(source.delay * 1e9)
        values = [column.values[there] for column in parts.values()]
        with np.errstate(invalid="ignore", over="ignore"):  # what comes of infinities is left out later
            streams[name] = Stream(stamps, to_si(source)(yaw_of(*values) if len(values) == 4 else values[0]))
    return streams


class _Samples:
    """What messages carried, in the order of the messages; signals that always come together share their stamps."""

    def __init__(self) -> None:
        self._together: dict[tuple[str, ...], tuple[array[int], array[int], array[int], array[float]]] = {}
        self._messages = 0

    def add(self, topic: str, log_time: int, stamp: int, present: Mapping[str, float]) -> None:
        """Adds a message of ``topic`` at ``stamp`` (ns; 0: unset) with the signals that it carried."""
        key = (topic, *present)
        if key not in self._together:
            self._together[key] = array("q"), array("q"), array("q"), array("d")
        numbers, logged, stamps, values = self._together[key]
        self._messages += 1
        numbers.append(self._messages)
        logged.append(log_time)
        stamps.append(stamp)
        values.extend(present.values())

    def stream(self, signal: str, delay: int, unstamped: bool) -> Stream:
        """The samples of a signal as they came, with stamps ``delay`` ns earlier; log times instead of unset ones."""
        numbers, stamps, values = [np.empty(0, np.int64)], [np.empty(0, np.int64)], [np.empty(0)]
        for (_, *signals), kept in self._together.items():
            if signal in signals:
                numbers.append(np.frombuffer(kept[0], np.int64))
                given = np.frombuffer(kept[2], np.int64)
                stamps.append(np.where(given == 0, np.frombuffer(kept[1], np.int64), given) if unstamped else given)
                values.append(np.frombuffer(kept[3]).reshape(-1, len(signals))[:, signals.index(signal)])
        order = np.argsort(np.concatenate(numbers), kind="stable")
        return Stream(np.concatenate(stamps)[order] - delay, np.concatenate(values)[order])

    def times(self, topic: str) -> tuple[Stamps, Stamps]:
        """Log times and stamps (ns; 0: unset) of the messages of a topic, in no order."""
        kept = [one for (name, *_), one in self._together.items() if name == topic]
        both = [
            np.concatenate([np.empty(0, np.int64), *(np.frombuffer(one[k], np.int64) for one in kept)]) for k in (1, 2)
        ]
        return both[0], both[1]
