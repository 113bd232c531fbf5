"""Race logs to a recording: what ``dynssm extract`` does."""

from __future__ import annotations

from array import array
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from dynssm_ros.errors import BagError, RecordingError
from dynssm_ros.progress import Progress
from dynssm_ros.signals.bags import Bag
from dynssm_ros.signals.decoding import decoders, header_stamp_ns, to_si
from dynssm_ros.signals.logs import open_log
from dynssm_ros.signals.recording import Recording, RecordingInfo, concatenate
from dynssm_ros.signals.resampling import Stream, resample
from dynssm_ros.signals.signal_map import COMMAND_SIGNALS, POSE_SIGNALS, STATE_SIGNALS, SignalMap
from dynssm_ros.signals.table_clock import clock_of
from dynssm_ros.signals.tables import Table
from dynssm_ros.signals.velocities import velocities_along

_SLOW = 1.5  # periods of the grid between samples, from which on a signal is slower than it


def extract(
    bags: Sequence[str | Path],
    signal_map: SignalMap,
    rate: float,
    drop_bad: bool = False,
    progress: Progress | None = None,
) -> Recording:
    """Reads logs and brings their signals onto a uniform grid.

    Args:
        bags: bags or tables of one car, in the order in which they shall be joined.
        signal_map: where the signals are.
        rate: of the grid (Hz).
        drop_bad: leave out samples that are not finite or whose stamps repeat or run backwards, instead of raising.
        progress: told of each message.

    Raises:
        BagError: unreadable, topics or columns missing or of another type, bad samples.
        RecordingError: the signals never overlap in time.
    """
    recordings = [_extract(path, signal_map, rate, drop_bad, progress) for path in bags]
    lacking = [", ".join(one.info.source) for one in recordings if one.info.commands != signal_map.commands]
    if 0 < len(lacking) < len(recordings):  # commands of some logs alone cannot be joined
        none, note = signal_map.with_commands("none"), f"no commands in {', '.join(lacking)}; commands: none"
        recordings = [_extract(path, none, rate, drop_bad, progress, note) for path in bags]
    return concatenate(recordings)


def _extract(
    path: str | Path, signal_map: SignalMap, rate: float, drop_bad: bool, progress: Progress | None, note: str = ""
) -> Recording:
    """The recording of one log, whose notes begin with ``note``."""
    with open_log(path) as log:
        signal_map, lack = _with_commands_of(log, signal_map)
        streams, notes = read_streams(log, signal_map, drop_bad, progress)
    notes = [*([note] if note else []), *notes, *lack]
    if signal_map.velocities is not None:
        streams |= pose_velocities(streams, signal_map.velocities.window, str(path))
        notes.append(f"v_x, v_y, omega: from poses, over {signal_map.velocities.window:g} s")
    held = held_signals(signal_map, streams, 1e9 / rate)
    info = RecordingInfo(
        sampling_time=1 / rate,
        commands=signal_map.commands,
        source=(Path(path).name,),
        signal_map=signal_map.name,
        held=tuple(held),
        held_periods=held,
        notes=tuple(notes),
    )
    return resample(streams, rate, signal_map.max_gap, signal_map.commands, info)


def _with_commands_of(log: Bag | Table, signal_map: SignalMap) -> tuple[SignalMap, list[str]]:
    """The map, without commands where the log has none of their topics or columns, and a note on it."""
    if signal_map.commands != "topics":
        return signal_map, []
    sources = [signal_map.signals[name] for name in COMMAND_SIGNALS]
    if isinstance(log, Table):
        missing = [f"column '{one.column}'" for one in sources if one.column and one.column not in log.headings]
    else:
        missing = [f"topic {one.recorded}" for one in sources if not one.column and not log.counts.get(one.recorded)]
    if len(missing) < len(sources):
        return signal_map, []
    told = " and ".join(dict.fromkeys(missing))
    return signal_map.with_commands("none"), [f"no commands in the log ({told}); commands: none"]


def pose_velocities(streams: Mapping[str, Stream], window: float, where: str) -> dict[str, Stream]:
    """Streams of ``v_x``, ``v_y`` and ``omega`` from those of the pose, without delay.

    Raises:
        RecordingError: fewer poses in a row than a window has.
    """
    x, y, theta = (streams[name] for name in POSE_SIGNALS)
    stamps = np.intersect1d(np.intersect1d(x.stamps, y.stamps), theta.stamps)  # dropped ones may differ
    columns = [one.values[np.searchsorted(one.stamps, stamps)] for one in (x, y, theta)]
    poses = np.stack([*columns[:2], np.unwrap(columns[2])], axis=1)
    rows, found = velocities_along((stamps - stamps[0]) / 1e9, poses, window)
    if not len(rows):
        raise RecordingError(f"{where}: {len(stamps)} poses; expected more in a row, for windows of {window:g} s")
    return {name: Stream(stamps[rows], values) for name, values in zip(STATE_SIGNALS, found.T, strict=True)}


def held_signals(signal_map: SignalMap, streams: Mapping[str, Stream], period: float) -> dict[str, float]:
    """The signals that keep their last sample until the next, on a grid of ``period`` (ns), and how long they do (s).

    Actuators that come more slowly than the rows would else look ahead of what a live node knows.
    """
    held = {}
    for name, source in signal_map.active_signals().items():
        stamps = streams[name].stamps if name in streams else np.empty(0, np.int64)
        between = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 0.0
        usual = "zero" if between > _SLOW * period and name not in (*STATE_SIGNALS, *POSE_SIGNALS) else "first"
        if (source.hold or usual) == "zero":
            held[name] = between / 1e9
    return held


def read_streams(
    log: Bag | Table, signal_map: SignalMap, drop_bad: bool = False, progress: Progress | None = None
) -> tuple[dict[str, Stream], list[str]]:
    """Reads the samples of every mapped signal; memory holds these and one message, or the columns, at a time.

    Stamps are header stamps, and log times only where a message has no header; of tables those of their time column.

    Returns:
        The streams by signal name, and notes on what was recovered or dropped.

    Raises:
        BagError: a topic, field or column is missing, or samples are bad and ``drop_bad`` is off.
    """
    if isinstance(log, Table):
        found, notes = _table_streams(log, signal_map, drop_bad), list(log.notes)
    else:
        found, notes = _bag_streams(log, signal_map, progress), list(log.notes)
    streams: dict[str, Stream] = {}
    for name, source in signal_map.active_signals().items():
        place = f"column '{source.column}'" if source.column else f"topic {source.recorded}"
        stream, dropped = clean(found[name], f"{log.path}: {place}: {name}", drop_bad)
        if dropped:
            notes.append(f"{name}: dropped {dropped}")
        if len(stream.stamps):
            streams[name] = stream
            continue
        counted = 1 if isinstance(log, Table) else log.counts[source.recorded]
        lack = f"has no good sample of '{source.field}'" if dropped else f"never carries '{source.field}'"
        lack = "has no good value" if source.column else lack
        if name not in POSE_SIGNALS or not counted:
            raise BagError(f"{log.path}: {place} {lack if counted else 'has no messages'}, needed for {name}")
        notes.append(f"{name}: {place} {lack}; left out")
    return streams, notes


def _bag_streams(bag: Bag, signal_map: SignalMap, progress: Progress | None) -> dict[str, Stream]:
    """The samples of every mapped signal, as they came."""
    by_topic = decoders(signal_map)
    for topic, decoder in by_topic.items():
        bag.require(topic, decoder.msgtype)
    samples = _Samples()
    total = sum(bag.counts[topic] for topic in by_topic)
    for done, (topic, log_time, raw) in enumerate(bag.messages(list(by_topic)), 1):
        message = bag.decode(topic, raw)
        stamp = header_stamp_ns(message)
        try:
            present = by_topic[topic].decode(message)
        except BagError as error:
            raise BagError(f"{bag.path}: {error}") from error
        samples.add(topic, log_time if stamp is None else stamp, present)
        if progress is not None:
            progress(done, total)
    active = signal_map.active_signals().items()
    return {name: samples.stream(name, round(source.delay * 1e9)) for name, source in active}


def _table_streams(table: Table, signal_map: SignalMap, drop_bad: bool) -> dict[str, Stream]:
    """The cells of every mapped column that have a value, as they came."""
    if not signal_map.is_of_table:
        raise BagError(
            f"{table.path}: a table, and signal map {signal_map.name} names topics; expected one with columns (`dynssm "
            f"inspect` suggests it)"
        )
    active = signal_map.active_signals()
    columns = table.read([source.column for source in active.values()])
    clock = clock_of(table, signal_map.time)
    streams = {}
    for name, source in active.items():
        column = columns[source.column]
        wrong = column.reason or ("" if drop_bad else column.bad)
        if wrong:
            hint = "" if column.reason else " (--drop-bad leaves such cells out)"
            raise BagError(f"{table.path}: column '{source.column}' for {name}: {wrong}; expected numbers{hint}")
        there = column.present & clock.known
        stamps = clock.stamps[there] - round(source.delay * 1e9)
        streams[name] = Stream(stamps, to_si(source)(column.values[there]))
    return streams


class _Samples:
    """What messages carried, in the order of the messages; signals that always come together share their stamps."""

    def __init__(self) -> None:
        self._together: dict[tuple[str, ...], tuple[array[int], array[int], array[float]]] = {}
        self._messages = 0

    def add(self, topic: str, stamp: int, present: Mapping[str, float]) -> None:
        """Adds a message of ``topic`` at ``stamp`` (ns) with the signals that it carried."""
        key = (topic, *present)
        if key not in self._together:
            self._together[key] = array("q"), array("q"), array("d")
        numbers, stamps, values = self._together[key]
        self._messages += 1
        numbers.append(self._messages)
        stamps.append(stamp)
        values.extend(present.values())

    def stream(self, signal: str, delay: int) -> Stream:
        """The samples of a signal as they came, with stamps ``delay`` ns earlier."""
        numbers, stamps, values = [np.empty(0, np.int64)], [np.empty(0, np.int64)], [np.empty(0)]
        for (_, *signals), kept in self._together.items():
            if signal in signals:
                numbers.append(np.frombuffer(kept[0], np.int64))
                stamps.append(np.frombuffer(kept[1], np.int64))
                values.append(np.frombuffer(kept[2]).reshape(-1, len(signals))[:, signals.index(signal)])
        order = np.argsort(np.concatenate(numbers), kind="stable")
        return Stream(np.concatenate(stamps)[order] - delay, np.concatenate(values)[order])


def clean(stream: Stream, where: str, drop_bad: bool) -> tuple[Stream, str]:
    """Checks a stream for values that are not finite and for stamps that repeat or run backwards.

    Returns:
        The stream, without bad samples if ``drop_bad``, and what was dropped (empty if nothing).

    Raises:
        BagError: a bad sample and ``drop_bad`` is off; names the first.
    """
    stamps, values = stream.stamps, stream.values
    finite = np.isfinite(values)
    oldest = np.iinfo(np.int64).min
    newest = np.maximum.accumulate(np.concatenate([[oldest], np.where(finite, stamps, oldest)]))[:-1]
    kinds = {
        "not finite": ~finite,
        "with a repeated stamp": finite & (stamps == newest),
        "with a stamp that runs backwards": finite & (stamps < newest),
    }
    dropped: list[str] = []
    for kind, bad in kinds.items():
        if not bad.any():
            continue
        k = int(np.flatnonzero(bad)[0])
        if not drop_bad:
            raise BagError(
                f"{where}: sample {k} at {stamps[k] / 1e9:.3f} s, value {values[k]:g}, is {kind} ({bad.sum()} such); "
                f"expected finite values at increasing stamps (--drop-bad leaves such samples out)"
            )
        dropped.append(f"{bad.sum()} samples {kind}")
    if not dropped:
        return stream, ""
    keep = ~np.logical_or.reduce(list(kinds.values()))
    return Stream(stamps[keep], values[keep]), ", ".join(dropped)
