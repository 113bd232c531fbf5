"""The tables of an inspection, for terminal and page."""

from __future__ import annotations

from dynssm_ros.reporting.tables import Column, Table, Value
from dynssm_ros.signals.inspection import Inspection
from dynssm_ros.signals.season import Season


def topic_table(found: Inspection) -> Table:
    """All topics, with how regularly they come."""
    columns = (
        Column("topic", brief=True),
        Column("type"),
        Column("messages", brief=True),
        Column("rate", "Hz", brief=True),
        Column("longest gap", "s", brief=True),
        Column("stamp to log", "s"),
    )
    rows: list[list[Value]] = [
        [topic.name, topic.msgtype, topic.count, topic.rate, topic.longest_gap, topic.lateness]
        for topic in found.topics.values()
    ]
    return Table(columns, rows)


def signal_table(found: Inspection) -> Table:
    """The suggested sources, with what they were in the log."""
    columns = (
        Column("signal"),
        Column("topic"),
        Column("field"),
        Column("scale"),
        Column("least"),
        Column("largest"),
    )
    rows: list[list[Value]] = []
    for name, one in found.signals.items():
        known = one.values[one.values == one.values]
        rows.append([name, one.topic.name, one.field, one.scale, float(known.min()), float(known.max())])
    return Table(columns, rows)


def season_table(season: Season) -> Table:
    """All sessions, in the order of driving, those that could not be read last."""
    columns = (
        Column("car"), Column("track"), Column("session"), Column("start"), Column("rows"), Column("duration", "s"),
        Column("segments"), Column("notes"),
    )  # fmt: skip
    sessions = sorted(season.sessions.values(), key=lambda each: (bool(each.failure), each.start, each.place))
    rows: list[list[Value]] = [
        [each.car, each.track, each.session, each.start, each.rows, each.seconds, each.segments,
         f"not read: {each.failure}" if each.failure else "; ".join(each.notes)]
        for each in sessions
    ]  # fmt: skip
    return Table(columns, rows, f"{len(sessions)} sessions, {sum(each.seconds for each in sessions) / 3600:.3g} h.")
