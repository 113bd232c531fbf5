"""An inspection as tables, for terminal and page, and for programs."""

from __future__ import annotations

from collections.abc import Sequence
from operator import attrgetter
from typing import Any

import numpy as np

from dynssm_ros.evaluation.metrics import finite
from dynssm_ros.reporting.tables import Column, Table
from dynssm_ros.signals.findings import Finding
from dynssm_ros.signals.inspection import Inspection
from dynssm_ros.signals.season import Season


def topic_table(found: Inspection) -> Table:
    """All topics with how regularly they come, or all columns with what is in them."""
    if found.time is not None:
        return _column_table(found)
    return Table.of(
        found.topics.values(),
        (Column("topic", brief=True), lambda topic: topic.name),
        (Column("type"), lambda topic: topic.msgtype),
        (Column("messages", brief=True), lambda topic: topic.count),
        (Column("rate", "Hz", brief=True), lambda topic: topic.rate),
        (Column("longest gap", "s", brief=True), lambda topic: topic.longest_gap),
        (Column("stamped by", brief=True), lambda topic: topic.stamped),
        (Column("stamp to log", "s"), lambda topic: topic.lateness),
    )


def _column_table(found: Inspection) -> Table:
    limits = {name: one.limits or (np.nan,) * 3 for name, one in found.topics.items()}
    return Table.of(
        found.topics.values(),
        (Column("column", brief=True), lambda column: column.name),
        (Column("cells", brief=True), lambda column: column.msgtype),
        (Column("unit", brief=True), lambda column: column.unit),
        (Column("values"), lambda column: column.count),
        (Column("rate", "Hz", brief=True), lambda column: column.rate),
        (Column("longest gap", "s"), lambda column: column.longest_gap),
        (Column("least", brief=True), lambda column: limits[column.name][0]),
        (Column("largest", brief=True), lambda column: limits[column.name][1]),
        (Column("zeros", "%", brief=True), lambda column: 100.0 * limits[column.name][2]),
    )


def signal_table(found: Inspection) -> Table:
    """The suggested sources, with what they were in the log."""
    return Table.of(
        found.signals.items(),
        (Column("signal"), lambda item: item[0]),
        (Column("topic"), lambda item: item[1].topic.name),
        (Column("field"), lambda item: item[1].field),
        (Column("unit"), lambda item: item[1].unit),
        (Column("scale"), lambda item: item[1].scale),
        (Column("least"), lambda item: float(np.nanmin(item[1].values))),
        (Column("largest"), lambda item: float(np.nanmax(item[1].values))),
    )


def finding_table(findings: Sequence[Finding]) -> Table:
    """What cannot be right, how large it is, and what mends it."""
    return Table.of(
        findings,
        (Column("finding", brief=True), lambda one: one.what),
        (Column("size", brief=True), lambda one: one.size),
        (Column("low"), lambda one: one.low),
        (Column("high"), lambda one: one.high),
        (Column("unit", brief=True), lambda one: one.unit),
        (Column("expected", brief=True), lambda one: one.expected),
        (Column("remedy", brief=True), lambda one: one.remedy),
        caption="Low and high are the 95 % interval of the size.",
    )


def season_table(season: Season) -> Table:
    """All sessions, in the order of driving, those that could not be read last."""
    sessions = sorted(season.sessions.values(), key=lambda each: (bool(each.failure), each.start, each.place))
    names = ("car", "track", "session", "start", "rows")
    return Table.of(
        sessions,
        ([Column(name) for name in names], attrgetter(*names)),
        (Column("duration", "s"), lambda each: each.seconds),
        (Column("segments"), lambda each: each.segments),
        (Column("notes"), lambda each: f"not read: {each.failure}" if each.failure else "; ".join(each.notes)),
        caption=f"{len(sessions)} sessions, {sum(each.seconds for each in sessions) / 3600:.3g} h.",
    )


def inspection_json(found: Inspection) -> dict[str, Any]:
    """The inspection for programs."""
    return {
        "name": found.name,
        "duration_s": found.duration,
        "topics": {
            topic.name: {
                "type": topic.msgtype,
                "count": topic.count,
                "rate_hz": finite(topic.rate),
                "longest_gap_s": topic.longest_gap,
                "lateness_s": finite(topic.lateness),
                "stamped": topic.stamped,
                "unit": topic.unit,
                "reason": topic.reason,
            }
            for topic in found.topics.values()
        },
        "signals": {
            name: {"topic": one.topic.name, "field": one.field, "unit": one.unit, "scale": one.scale, "note": one.note}
            for name, one in found.signals.items()
        },
        "missing": list(found.missing),
        "notes": list(found.notes),
        "findings": [finding.model_dump() for finding in found.findings],
    }
