"""The time column of a table: which it is, in which unit, and the stamps of the rows."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from dynssm_ros.errors import BagError
from dynssm_ros.signals.columns import LogColumn, known_unit
from dynssm_ros.signals.signal_map import TIME_UNITS, TimeColumn
from dynssm_ros.signals.tables import LogTable

_CERTAIN = re.compile(
    r"^[%# ]*(time|t|timestamp|time_?stamp|stamp|zeit|utc|datetime|date_?time|.*[/.]stamp)$", re.IGNORECASE
)
_POSSIBLE = re.compile(r"time|stamp|zeit|clock|utc|date|datum|elapsed", re.IGNORECASE)
_OTHER = re.compile(
    r"lap(?!sed)|delta|diff|duration|left|best|rate|index|frame|sample|count|\bnr\b|\bid\b|dist|odom|row", re.IGNORECASE
)
_SECONDS, _NANOSECONDS = (
    re.compile(r"sec(s|onds)?$", re.IGNORECASE),
    ("nsec", "nsecs", "nanosec", "nanosecs", "nanoseconds"),
)
_RISES = 0.3  # share of rows that are later than the one before, in a time column at all: each may be there three times
_STEPS = {"days": 0.0, "s": 5e-5, "ms": 0.3, "us": 300.0, "ns": 3e5}  # least step of a log, 0.3 ms, in each unit
_EPOCH_S, _SLOWEST_S = (9e8, 4.1e9), 10.0  # seconds since 1970 of the years 1998 to 2099; between rows
_DAY, _HOUR = 86_400_000_000_000, 3_600_000_000_000
_DATENUM, _EXCEL = 719_529, 25_569  # 1970-01-01 in days of MATLAB and of Excel
_PANDAS = "__index_level_"  # how pandas begins the name of an index that has none
_MIDNIGHT = 240_000  # in hhmmss
_LARGEST = 2**62


@dataclass(frozen=True)
class Clock:
    """When the rows of a table were measured."""

    column: str
    unit: str | None  # of its numbers; None for dates and times of day
    stamps: npt.NDArray[np.int64]  # ns since 1970, midnight, or what the column counts from, (N,)
    known: npt.NDArray[np.bool_]  # rows that have a time, (N,)
    told: str  # what it is, in words
    nanoseconds: str | None = None  # column of the ns beside whole seconds

    @property
    def as_given(self) -> TimeColumn:
        """As a signal map gives it."""
        return TimeColumn.model_validate({"column": self.column, "unit": self.unit, "nanoseconds": self.nanoseconds})


def clock_of(table: LogTable, given: TimeColumn | None) -> Clock:
    """The time of the rows, by the column that is ``given`` or else by name and steps.

    Raises:
        BagError: there is no time column, or it does not rise.
    """
    clock = _chosen(table, given)
    lost = int((~clock.known).sum())
    if lost:
        note = f"{lost} row{' has' if lost == 1 else 's have'} no time in column '{clock.column}'; left out"
        table.notes.extend([note] if note not in table.notes else [])
    return clock


def _chosen(table: LogTable, given: TimeColumn | None) -> Clock:
    """The clock of the column that is given, or else found."""
    if given is not None:
        clock = _clock(table, given.column, table.read([given.column])[given.column], given.unit)
        clock = _with_nanoseconds(table, clock, given.nanoseconds)
        if _rising(clock) <= _RISES:
            raise BagError(
                f"{table.path}: time column '{clock.column}' rises in {_rising(clock):.0%} of the rows; expected one that "
                f"rises"
            )
        return clock
    named = [name for name in table.headings if _possible(table, name)]
    pairs = {name: beside for name in table.headings if (beside := _nanoseconds_beside(table, name)) is not None}
    named = [name for name in dict.fromkeys([*pairs, *named]) if name not in pairs.values()]
    columns = table.read(named)
    found = [
        _with_nanoseconds(table, _clock(table, name, column, "s" if name in pairs else None), pairs.get(name))
        for name, column in columns.items()
        if not column.reason
    ]
    found.sort(key=lambda clock: (_rising(clock) < 0.99, not _certain(table, clock.column), -_rising(clock)))
    if found and _rising(found[0]) > _RISES:
        return found[0]
    for name in named:
        if not found and _certain(table, name):
            raise BagError(f"{table.path}: time column '{name}': {columns[name].reason}; expected numbers or times")
    unnamed = [] if found else _unnamed(table)
    if unnamed:
        return unnamed[0]
    if found:
        raise BagError(
            f"{table.path}: no time column: '{found[0].column}' rises in {_rising(found[0]):.0%} of the rows; expected one "
            f"that rises (`time: {{column: NAME}}` in the signal map names it)"
        )
    raise BagError(
        f"{table.path}: no time column among {table.told_columns}; expected one that rises and is no number of the row, such "
        f"as 'time'"
    )


def _possible(table: LogTable, name: str) -> bool:
    """Whether a heading is one that a time may have."""
    bare = table.headings[name].bare
    return not _OTHER.search(bare) and bool(_POSSIBLE.search(bare) or _certain(table, name))


def _unnamed(table: LogTable) -> list[Clock]:
    """What always rises and is no counter, such as an index without a name: times first, then numbers by their headings."""
    found = []
    for group in table.groups():
        for name, column in group.items():
            other = _OTHER.search(name.removeprefix(_PANDAS)) and not column.is_time
            if column.reason or other or not column.present.all():
                continue
            clock = _clock(table, name, column, None)
            if _rising(clock) == 1.0 and not (np.diff(column.values) == 1.0).all():
                found.append(clock)
    return sorted(found, key=lambda clock: clock.unit is not None)


def _nanoseconds_beside(table: LogTable, name: str) -> str | None:
    """The column with the ns of a column of whole seconds, such as ``stamp.nanosec`` of ``stamp.sec``."""
    if not _SECONDS.search(name):
        return None
    return next(
        (each for end in _NANOSECONDS if (each := _SECONDS.sub(end, name)) != name and each in table.headings), None
    )


def _with_nanoseconds(table: LogTable, clock: Clock, name: str | None) -> Clock:
    """The clock with the ns that stand in a column of their own."""
    if name is None:
        return clock
    column = table.read([name])[name]
    if column.reason:
        raise BagError(f"{table.path}: column '{name}' of nanoseconds: {column.reason}; expected numbers")
    known = clock.known & np.isfinite(column.values)
    stamps = clock.stamps + np.rint(np.where(known, column.values, 0.0)).astype(np.int64)
    return replace(clock, stamps=stamps, known=known, told=f"{clock.told} and ns from '{name}'", nanoseconds=name)


def _certain(table: LogTable, name: str) -> bool:
    return bool(_CERTAIN.match(table.headings[name].bare.strip()))


def _rising(clock: Clock) -> float:
    """Share of rows that are later than the one before."""
    steps = np.diff(clock.stamps[clock.known])
    return float((steps > 0).mean()) if len(steps) else 0.0


def _clock(table: LogTable, name: str, column: LogColumn, unit: str | None) -> Clock:
    """The clock that a column is.

    Raises:
        BagError: nothing in it is a time.
    """
    if column.reason:
        raise BagError(f"{table.path}: time column '{name}': {column.reason}; expected numbers, dates or times of day")
    known = np.isfinite(column.values)
    if column.is_time:
        stamps = np.zeros(len(known), np.int64) if column.exact is None else column.exact.copy()
        for kind, turn in (("time of day", _DAY), ("minutes", _HOUR)):
            if kind in column.type:
                stamps[known] = _turned_over(stamps[known], turn)
        return Clock(name, None, stamps, known, f"time from column '{name}' ({column.type})")
    if unit is None and (digits := _of_digits(column.values[known])) is not None:
        stamps = np.zeros(len(known), np.int64)
        stamps[known] = digits
        return Clock(name, None, stamps, known, f"time of day, hhmmss, from column '{name}'")
    written = table.headings[name].unit
    headed = known_unit(written)
    by_heading = headed if headed in TIME_UNITS and _may_be(column.values[known], TIME_UNITS[headed]) else None
    chosen = unit or by_heading or _unit_by_steps(column.values[known])
    values = np.where(known, column.values, 0.0)
    exact = column.exact
    if chosen == "days":
        first = float(values[known][0]) if known.any() else 0.0
        zero = _DATENUM if first > _DATENUM else _EXCEL if first > _EXCEL else 0
        values, exact = values - zero, None
    factor = TIME_UNITS[chosen]
    known &= np.abs(values) < _LARGEST / factor
    if exact is not None:
        stamps = np.where(known, exact, 0) * factor
    else:
        whole = np.floor(np.where(known, values, 0.0))
        stamps = whole.astype(np.int64) * factor + np.rint((np.where(known, values, 0.0) - whole) * factor).astype(
            np.int64
        )
    strange = f", as nobody knows its unit '{written}'" if written and headed not in TIME_UNITS else ""
    guessed = "" if unit or by_heading else f", by its steps{strange}"
    return Clock(name, chosen, stamps, known, f"time in {chosen} from column '{name}'{guessed}")


def _turned_over(stamps: npt.NDArray[np.int64], turn: int) -> npt.NDArray[np.int64]:
    """Times of day that go on after midnight, or minutes after the full hour (ns)."""
    back = np.diff(stamps, prepend=stamps[:1]) < -turn // 2
    return stamps + np.cumsum(back) * turn


def _of_digits(values: npt.NDArray[np.float64]) -> npt.NDArray[np.int64] | None:
    """Times of day (ns) that numbers such as 135959.98 write, as GNSS receivers do; ``None`` where 59 is not followed by
    100 or nothing tells.
    """
    if not ((values >= 0) & (values < _MIDNIGHT)).all():
        return None
    whole = np.floor(values).astype(np.int64)
    hours, minutes, seconds = whole // 10_000, whole // 100 % 100, whole % 100
    next_minute = (np.diff(seconds) == -59) & (np.diff(60 * hours + minutes) % 1440 == 1)
    if (minutes > 59).any() or (seconds > 59).any() or not next_minute.any():
        return None
    stamps = np.rint((3600 * hours + 60 * minutes + seconds + values - whole) * 1e9).astype(np.int64)
    return _turned_over(stamps, _DAY)


def _may_be(values: npt.NDArray[np.float64], factor: int) -> bool:
    """Whether times are possible in a unit of ``factor`` ns."""
    return bool((np.abs(values) < _LARGEST / factor).mean() > _RISES) if len(values) else True


def _unit_by_steps(values: npt.NDArray[np.float64]) -> str:
    """The unit in which times since 1970 are of our days, and else that in which rows are 0.3 ms or more apart."""
    steps = np.diff(values)
    step = float(np.median(steps[steps > 0])) if (steps > 0).any() else 1.0
    for unit in ("s", "ms", "us", "ns"):
        seconds = TIME_UNITS[unit] / 1e9
        if _EPOCH_S[0] < float(values[0]) * seconds < _EPOCH_S[1] and step * seconds < _SLOWEST_S:
            return unit
    return max((unit for unit, least in _STEPS.items() if step >= least), key=lambda unit: _STEPS[unit])
