"""Columns of tables: cells to numbers, dates and times of day to nanoseconds, units as headings name them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc

from dynssm_ros.arrays import Vector
from dynssm_ros.signals.signal_map import TIME_UNITS, UNITS

ABSENT = ("", "-", "n/a", "N/A", "NA", "#N/A", "#NV", "null", "NULL", "None", "NaT")
"""Cells without a value."""
_NUMBER = r"^[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?$|^[+-]?(?i:nan|inf|infinity)$"
_THOUSANDS = r"^[+-]?\d{1,3}(?:\.\d{3})+(?:,\d*)?$"  # with a decimal comma
_COMMAS = r"^[+-]?\d{1,3}(?:,\d{3})+(?:\.\d*)?$"  # between thousands, with a decimal point
_SURELY_COMMAS = re.compile(r"^[+-]?\d{1,3}(?:(?:,\d{3})+\.\d*|(?:,\d{3}){2,})$")  # where 1,234 may be a decimal
_SWITCHES = {"true": "1", "false": "0"}
_TOLD = 40  # characters of a cell that are told, as long as a date with its zone
_WHOLE_HOURS = 24  # a time zone below is written without minutes
_LONG = 15  # digits, from which on a double is no longer exact
_CLOCK = r"(?P<hour>\d{1,2}):(?P<minute>\d{1,2}):(?P<second>\d{1,2})(?:[.,:](?P<fraction>\d{1,9}))?"
_HALF, _ZONE = r"(?: ?(?P<half>[AaPp])[Mm])?", r" ?(?:Z|UTC|GMT|(?P<zone>[+-]\d{2}(?::?\d{2})?))?"
_DATES = {
    "date": rf"^(?P<year>\d{{4}})[-/.](?P<month>\d{{1,2}})[-/.](?P<day>\d{{1,2}})[T ]+{_CLOCK}{_ZONE}$",
    "date, day first": rf"^(?P<day>\d{{1,2}})[.](?P<month>\d{{1,2}})[.](?P<year>\d{{4}}),? +{_CLOCK}$",
    "date, month first": rf"^(?P<month>\d{{1,2}})/(?P<day>\d{{1,2}})/(?P<year>\d{{4}}),? +{_CLOCK}{_HALF}$",
    "time of day": rf"^{_CLOCK}{_HALF}$",
    "minutes": r"^(?P<minute>\d{1,3}):(?P<second>\d{1,2})[.,](?P<fraction>\d{1,9})$",
}
_ALIASES = {
    "m/s²": "m/s^2", "m/s2": "m/s^2", "m/s/s": "m/s^2", "mps2": "m/s^2",
    "1/min": "rpm", "u/min": "rpm", "min-1": "rpm",
    "kmh": "km/h", "kph": "km/h", "kmph": "km/h", "mps": "m/s", "m/sec": "m/s", "kn": "kt", "knots": "kt",
    "°": "deg", "degree": "deg", "degrees": "deg", "radian": "rad", "radians": "rad", "°/s": "deg/s", "deg/sec": "deg/s",
    "dps": "deg/s", "degps": "deg/s", "radps": "rad/s", "rad/sec": "rad/s", "percent": "%", "pct": "%", "prozent": "%",
    "meter": "m", "meters": "m", "metres": "m", "sec": "s", "second": "s", "seconds": "s", "msec": "ms",
    "milliseconds": "ms", "usec": "us", "µs": "us", "μs": "us", "nsec": "ns", "nanoseconds": "ns", "day": "days",
    "minute": "min", "minutes": "min", "mins": "min", "hour": "h", "hours": "h", "hr": "h", "hrs": "h",
}  # fmt: skip
_BRACKETS = re.compile(r"^(?P<bare>.*?)\s*[\[(<{]\s*(?P<unit>[^\[\](){}<>]*?)\s*[\])>}]\s*$")
_UNIT_LIKE = re.compile(r"^(?:[^\W\d]{1,4}|.*[/^²°%·*].*)$")
_ENDING = re.compile(
    r"^(?P<bare>.+)_(?P<unit>m|cm|mm|s|us|ns|(?i:kmh|kph|mps|mps2|mph|deg|rad|pct|percent|degps|dps|radps|rpm|sec|ms|nsec))$"
)


class Heading(NamedTuple):
    """What stands above a column."""

    bare: str  # the name without its unit
    unit: str  # as written, without brackets; empty if none is


@dataclass(frozen=True)
class LogColumn:
    """A column that was read."""

    type: str
    values: Vector  # (N,), NaN where a cell is absent or no number; of dates in s
    present: npt.NDArray[np.bool_]  # whether there is something in the cell, (N,)
    exact: npt.NDArray[np.int64] | None = None  # of integers, and of dates and times of day (ns); zero where absent
    bad: str = ""  # which cells are no numbers; empty if all are
    reason: str = ""  # why nothing can be made of it
    is_time: bool = False  # whether it is of dates, times of day or durations


def heading(name: str, unit: str = "") -> Heading:
    """Name and unit of a heading such as ``Speed (km/h)``, ``Speed [km/h]`` or ``speed_kmh``; ``unit`` is that of a row of
    units.
    """
    match = _BRACKETS.match(name)
    unit_like = match is not None and (known_unit(match["unit"]) or _UNIT_LIKE.match(match["unit"]))
    if match is None or match["unit"].isdigit() or not unit_like:  # as in position[steering] and states[0]
        match = _ENDING.match(name)
    bare = match["bare"] if match and match["bare"] else name
    return Heading(bare, unit.strip(" []()<>{}") or (match["unit"] if match else ""))


def known_unit(text: str) -> str | None:
    """The unit of a signal map that a heading means; ``None`` if it is none of them."""
    text = text.strip(" []()<>{}").lower()
    unit = _ALIASES.get(text, text)
    return unit if unit in UNITS or unit in TIME_UNITS else None


def kind_of(cells: list[str], comma: bool) -> str:
    """What the cells of a text column are: ``number``, ``integer``, a date, ``time of day`` or ``text``."""
    cells = [cell for cell in (cell.strip() for cell in cells) if cell not in ABSENT]
    dated, cells = cells, [_with_point(cell) if comma else _without_commas(cell) for cell in cells]
    numbers = [bool(re.match(_NUMBER, cell)) or cell.lower() in _SWITCHES for cell in cells]
    if sum(numbers) * 2 >= len(cells):
        whole = all(cell.lstrip("+-").isdigit() for cell in cells)
        return "integer" if whole and any(len(cell) > _LONG for cell in cells) else "number"
    for kind, pattern in _DATES.items():
        if sum(bool(re.match(pattern, cell)) for cell in dated) * 2 >= len(cells):
            return kind
    return "text"


def _with_point(cell: str) -> str:
    """A number that is written with a decimal comma and points between thousands; a lone point makes it none."""
    cell = cell.replace(".", "") if re.match(_THOUSANDS, cell) else cell.replace(".", "?")
    return cell.replace(",", ".")


def _without_commas(cell: str) -> str:
    """A number with a decimal point whose thousands are apart by commas."""
    return cell.replace(",", "") if _SURELY_COMMAS.match(cell) else cell


def is_value(cell: str, comma: bool) -> bool:
    """Whether a cell is a number, a date or a time of day."""
    return kind_of([cell], comma) != "text"


def parsed(text: Any, kind: str, comma: bool) -> tuple[Any, Any]:
    """The cells of a text column of one ``kind`` as numbers or timestamps, and whether a cell is none, both ``(N,)``."""
    trimmed = pc.utf8_trim_whitespace(text)
    trimmed = pc.if_else(pc.is_in(trimmed, value_set=pa.array(ABSENT)), None, trimmed)
    if kind in _DATES:
        found = _nanoseconds(trimmed, kind).cast(pa.timestamp("ns"))
        return found, pc.and_(pc.is_valid(trimmed), pc.is_null(found))
    plain = trimmed
    if comma:
        grouped = pc.match_substring_regex(trimmed, _THOUSANDS)
        points = pc.replace_substring(trimmed, ".", "?")
        plain = pc.replace_substring(pc.if_else(grouped, pc.replace_substring(trimmed, ".", ""), points), ",", ".")
    try:
        return pc.cast(plain, pa.int64() if kind == "integer" else pa.float64()), pa.array(np.zeros(len(text), bool))
    except pa.ArrowInvalid:
        if not comma:
            apart = pc.match_substring_regex(plain, _COMMAS)
            plain = pc.if_else(apart, pc.replace_substring(plain, ",", ""), plain)
        lower = pc.utf8_lower(plain)
        for word, number in _SWITCHES.items():
            plain = pc.if_else(pc.equal(lower, word), number, plain)
        good = pc.fill_null(pc.match_substring_regex(plain, _NUMBER), True)
        return pc.if_else(good, pc.cast(pc.if_else(good, plain, None), pa.float64()), np.nan), pc.invert(good)


def _nanoseconds(text: Any, kind: str) -> Any:
    """Dates and times of day in ns since 1970 or midnight; null where a cell is none."""
    parts = pc.extract_regex(text, _DATES[kind])
    valid = np.asarray(pc.is_valid(parts))
    fields = {
        parts.type.field(k).name: pc.if_else(pa.array(valid), parts.field(k), "") for k in range(parts.type.num_fields)
    }

    def whole(name: str) -> npt.NDArray[np.int64]:
        return np.asarray(pc.cast(_or_zero(fields[name]), pa.int64()))

    hour, month, day = np.zeros(len(text), np.int64), np.ones(len(text), np.int64), np.ones(len(text), np.int64)
    if "hour" in fields:
        hour = whole("hour")
    year = np.full(len(text), 1970)
    if "year" in fields:
        year, month, day = whole("year"), whole("month"), whole("day")
        valid &= (month > 0) & (day > 0)
        if month.max(initial=0) > 12:
            month, day = day, month
        valid &= month <= 12
    if "half" in fields:
        half = pc.utf8_lower(fields["half"])
        hour = np.where(np.asarray(pc.equal(half, "")), hour, hour % 12 + 12 * np.asarray(pc.equal(half, "p")))
    months = (year - 1970).astype("datetime64[Y]").astype("datetime64[M]") + (month - 1)
    days = (months.astype("datetime64[D]") + (day - 1)).astype(np.int64)
    fraction = np.asarray(pc.cast(pc.utf8_rpad(fields["fraction"], 9, "0"), pa.int64()))
    seconds = ((days * 24 + hour) * 60 + whole("minute")) * 60 + whole("second")
    if "zone" in fields:
        zone = np.asarray(pc.cast(pc.replace_substring_regex(_or_zero(fields["zone"]), "[+:]", ""), pa.int64()))
        zone = np.where(np.abs(zone) < _WHOLE_HOURS, 100 * zone, zone)
        seconds -= np.sign(zone) * (np.abs(zone) // 100 * 60 + np.abs(zone) % 100) * 60
    return pa.array(seconds * 1_000_000_000 + fraction, mask=~valid)


def _or_zero(cells: Any) -> Any:
    return pc.if_else(pc.equal(cells, ""), "0", cells)


def typed_column(array: Any, kind: str, bad: str = "") -> LogColumn:
    """The column of a pyarrow array whose type says what it holds; ``kind`` is what a user reads of it."""
    array = array.combine_chunks() if isinstance(array, pa.ChunkedArray) else array
    array = array.combine_chunks() if isinstance(array, pa.ChunkedArray) else array  # of no chunk
    if pa.types.is_dictionary(array.type):
        array = array.dictionary_decode()
    nothing, present = np.full(len(array), np.nan), np.asarray(pc.is_valid(array))
    if not present.any():
        return LogColumn(kind, nothing, present, reason="no cell has a value")
    if pa.types.is_string(array.type) or pa.types.is_large_string(array.type):
        first = str(array[int(np.argmax(present))])[:_TOLD]
        found = kind_of([str(one) for one in array.drop_null()[:50]], False)
        if found == "text":
            return LogColumn(kind, nothing, present, reason=f"text, '{first}' first")
        numbers, wrong = parsed(array, found, False)
        return typed_column(numbers, f"{kind}, {found}", told_bad(array, wrong))
    if pa.types.is_temporal(array.type):
        return _time_column(array, kind, present, bad)
    try:
        values = np.asarray(pc.fill_null(pc.cast(array, pa.float64(), safe=False), np.nan), np.float64)
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError):
        return LogColumn(kind, nothing, present, reason=f"{array.type}, no number")
    exact = None
    if pa.types.is_integer(array.type):
        exact = np.asarray(pc.fill_null(pc.cast(array, pa.int64(), safe=False), 0), np.int64)
    return LogColumn(kind, values, present, exact, bad)


def _time_column(array: Any, kind: str, present: npt.NDArray[np.bool_], bad: str) -> LogColumn:
    """Of timestamps, dates, times of day and durations."""
    try:
        if pa.types.is_date(array.type):
            array = pc.cast(array, pa.timestamp("ns"))
        elif pa.types.is_time(array.type):
            array = pc.cast(array, pa.time64("ns"))
        elif pa.types.is_duration(array.type):
            array = pc.cast(array, pa.duration("ns"))
        else:
            array = pc.cast(array, pa.timestamp("ns", array.type.tz))
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError) as error:
        return LogColumn(kind, np.full(len(array), np.nan), present, reason=" ".join(str(error).split()))
    exact = np.asarray(pc.fill_null(array.cast(pa.int64()), 0), np.int64)
    return LogColumn(kind, np.where(present, exact / 1e9, np.nan), present, exact, bad, is_time=True)


def told_bad(text: Any, bad: Any, row: int = 0) -> str:
    """Which cells of a column are no numbers; empty if all are. ``row`` is the number of the first one."""
    where = np.flatnonzero(np.asarray(pc.fill_null(bad, False)))
    if not len(where):
        return ""
    first = f"'{str(text[int(where[0])])[:_TOLD]}' in row {row + int(where[0]) + 1}"
    return f"{len(where)} of its cells {'is' if len(where) == 1 else 'are'} no number, first {first}"
