"""What is in a log: topics or columns, rates, gaps, clocks, and a first signal map."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from dynssm_ros.errors import BagError, UserError
from dynssm_ros.progress import Progress
from dynssm_ros.signals.contents import TopicContent, contents_of_bag, contents_of_table
from dynssm_ros.signals.extraction import extract
from dynssm_ros.signals.findings import Finding
from dynssm_ros.signals.logs import open_log
from dynssm_ros.signals.recording import RecordingInfo
from dynssm_ros.signals.signal_map import (
    SIGNALS,
    STATE_SIGNALS,
    UNITS,
    SignalMap,
    TimeColumn,
    command_signals,
    required_signals,
    set_point_of,
)
from dynssm_ros.signals.steering_scale import Suggestion
from dynssm_ros.signals.suggestions import suggest
from dynssm_ros.signals.table_clock import clock_of
from dynssm_ros.signals.tables import LogTable

_FASTEST_HZ = 50.0  # at which a log is extracted to compare its signals
_OF_CURVATURE = ("pose_speed", "omega", "v_x", "twist", "speed", "gyro", "odometry")
"""How findings begin after which nothing is known of the curvature."""
_WINDOW = 0.1  # s, of poses from which velocities follow


@dataclass(frozen=True)
class Inspection:
    """What is in a log."""

    name: str
    duration: float  # between its first and last message (s)
    topics: dict[str, TopicContent]  # by name
    signals: dict[str, Suggestion]  # suggested sources, by signal
    notes: tuple[str, ...]  # what to look at, in sentences
    time: TimeColumn | None = None  # of a table
    findings: tuple[Finding, ...] = ()  # what cannot be right if the suggested signal map is

    @property
    def missing(self) -> tuple[str, ...]:
        """Signals that every signal map needs and for which nothing was found."""
        required = required_signals(set_point_of(self.signals))
        needed = required[len(STATE_SIGNALS) :] if self.poses_alone else required
        return tuple(name for name in needed if name not in self.signals and (name != "v_y" or not self.estimates))

    @property
    def poses_alone(self) -> bool:
        """Whether velocities have to follow from poses."""
        return "v_x" not in self.signals and "x" in self.signals

    @property
    def estimates(self) -> bool:
        """Whether ``v_y`` has to be estimated."""
        return {"v_x", "omega"} <= set(self.signals) and "v_y" not in self.signals

    def signal_map(self) -> str:
        """The suggested signal map as YAML; what is missing or uncertain stands there as a comment."""
        commands = "topics" if set(command_signals(set_point_of(self.signals))) <= set(self.signals) else "none"
        name = re.sub(r"\W+", "_", Path(self.name).stem) or "own"
        check, give = ("columns, units", "column") if self.time else ("fields", "topic, type and field")
        lines = [f"# Suggested by `dynssm inspect` from {self.name}. Check {check} and scales before you use it.",
                 f"name: {name}", f"commands: {commands}", "max_gap: 0.25", "signals:"]  # fmt: skip
        lines[-1:-1] = [f"velocities: {{window: {_WINDOW}}}"] if self.poses_alone else []
        lines[-1:-1] = ["estimation: {rear_axle: 0.0}  # m from the centre of gravity"] if self.estimates else []
        lines[-1:-1] = [f"time: {_flow(self.time.model_dump(exclude_none=True))}"] if self.time else []
        lines += [f"  # {each}: nothing found; give its {give}" for each in self.missing]
        for signal in SIGNALS:
            if signal not in self.signals:
                continue
            found = self.signals[signal]
            source: dict[str, Any] = {"topic": found.topic.name, "type": found.topic.msgtype, "field": found.field}
            source = {"column": found.field} if self.time else source
            if found.unit != "1":
                source["unit"] = found.unit
            if found.scale != 1.0:
                source["scale"] = float(f"{found.scale:.4g}")
            if found.offset:
                source["offset"] = float(f"{found.offset:.4g}")
            lines += [f"  # {found.note}"] if found.note else []
            lines.append(f"  {signal}: {_flow(source)}")
        return "\n".join(lines) + "\n"


def _flow(content: dict[str, Any]) -> str:
    """As YAML on one line."""
    return yaml.safe_dump(content, default_flow_style=True, sort_keys=False, width=math.inf, allow_unicode=True).strip()


def inspect(path: str | Path, wheelbase: float | None = None, progress: Progress | None = None) -> Inspection:
    """Reads a log, a bag or a table, and says what is in it.

    With the ``wheelbase`` of the car (m) the scale of a steering signal follows from the curvature it drives. Where the
    suggested signal map is complete, the log is extracted with it, and its signals are compared with each other.

    Raises:
        BagError: unreadable, or without messages or a time column.
    """
    with open_log(path) as log:
        if isinstance(log, LogTable):
            clock = clock_of(log, None)
            topics, begin, end = contents_of_table(log, clock)
            notes, time = [f"{log.kind}; {clock.told}", *log.notes], clock.as_given
        else:
            topics, begin, end = contents_of_bag(log, progress)
            notes, time = [*log.notes], None
    if not topics:
        raise BagError(f"{path}: holds no messages; expected some")
    notes += [f"{name}: {one.reason}" for name, one in topics.items() if one.reason]
    signals = suggest(topics, wheelbase, notes, is_table=time is not None)
    found = Inspection(Path(path).name, (end - begin) / 1e9, topics, signals, tuple(notes), time)
    return found if found.missing else _compared(path, found, wheelbase)


def _compared(path: str | Path, found: Inspection, wheelbase: float | None) -> Inspection:
    """With what the signals of a log, by the suggested signal map, contradict, and what is noted when they are extracted.

    A steering's scale follows from speed and yaw rate: where these are wrong, it is left to the comparison.
    """
    try:
        info = _extracted(path, found, wheelbase)
        scaled = found.signals["steering_feedback"]
        if "curvature" in scaled.note and any(each.what.startswith(_OF_CURVATURE) for each in info.findings):
            plain = replace(scaled, scale=1.0, unit=scaled.topic.unit if scaled.topic.unit in UNITS else "1", note="")
            found = replace(found, signals=found.signals | {"steering_feedback": plain})
            info = _extracted(path, found, wheelbase)
    except (UserError, ValidationError) as error:
        told = error.errors()[0]["msg"] if isinstance(error, ValidationError) else str(error)
        return replace(found, notes=(*found.notes, f"its signals could not be compared: {told}"))
    said = tuple(note for note in info.notes if not _is_known(note, found))
    return replace(found, findings=info.findings, notes=(*found.notes, *said))


def _extracted(path: str | Path, found: Inspection, wheelbase: float | None) -> RecordingInfo:
    """What is noted of the recording that the suggested signal map gives."""
    rate = found.signals["v_x" if "v_x" in found.signals else "x"].topic.rate
    signal_map = SignalMap.model_validate(yaml.safe_load(found.signal_map())).with_commands("none")
    rate = min(max(rate, 1.0), _FASTEST_HZ)
    return extract([path], signal_map, rate, drop_bad=True, wheelbase=wheelbase).info


def _is_known(note: str, found: Inspection) -> bool:
    """Whether a note of an extraction is among those of an inspection, or follows from its signal map."""
    return note in found.notes or note.startswith("v_x, v_y, omega: from poses")
