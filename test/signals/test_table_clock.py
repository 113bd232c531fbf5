"""The time of a table: its column, unit and form are found."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from dynssm_ros.errors import BagError
from dynssm_ros.signals.extraction import extract
from dynssm_ros.signals.inspection import inspect
from test.signals.test_tables import START, N, table_map, write_csv


@pytest.mark.parametrize(
    ("unit", "time"),
    [("s", lambda t: t), ("ms", lambda t: np.round(t * 1e3).astype(int)), ("us", lambda t: t * 1e6), 
     ("ns", lambda t: t * 1e9),
     ("days", lambda t: 739_000 + t / 86400), ("days", lambda t: 46_000 + t / 86400), ("s", lambda t: 1.7e9 + t),
     ("ms", lambda t: 1_700_000_000_000 + np.round(t * 1e3).astype(int)), ("us", lambda t: 1.7e15 + t * 1e6)],
)  # fmt: skip
def test_the_unit_of_time_follows_from_its_steps(tmp_path: Path, columns: Any, unit: str, time: Any) -> None:
    write_csv(tmp_path / "log.csv", columns | {"time": time(np.arange(N) / 100.0)})
    found, told = (
        extract([tmp_path / "log.csv"], table_map(time=one), 40.0) for one in (None, {"column": "time", "unit": unit})
    )
    assert found.duration == pytest.approx(0.6, abs=1e-5)
    np.testing.assert_array_equal(found.time, told.time)


def test_a_unit_of_time_that_cannot_be_is_not_taken_at_its_word(tmp_path: Path, columns: Any) -> None:
    stamps = columns.pop("time")
    write_csv(tmp_path / "log.csv", columns | {"time_s": stamps})
    assert extract([tmp_path / "log.csv"], table_map(), 40.0).time[0] == START


@pytest.mark.parametrize("begin", ["10:59:59.7", "23:59:59.7", "07:03:59.7"])
def test_times_of_gnss_receivers_are_those_of_the_day(tmp_path: Path, columns: Any, begin: str) -> None:
    first = sum(float(part) * 60**power for part, power in zip(begin.split(":"), (2, 1, 0), strict=True))
    seconds = (first + np.arange(N) / 100) % 86_400
    digits = seconds // 3600 * 10_000 + seconds // 60 % 60 * 100 + seconds % 60
    write_csv(tmp_path / "log.csv", columns | {"time": [f"{one:010.3f}" for one in digits]})
    for time in (None, inspect(tmp_path / "log.csv").time):
        found = extract([tmp_path / "log.csv"], table_map(time=time), 40.0)
        assert (round(found.time[0] / 1e9, 3), len(found), set(found.segment)) == (first, 24, {0})


def test_a_number_of_the_row_is_no_time(tmp_path: Path, columns: Any) -> None:
    """As pandas writes in front of each row, with nothing above."""
    time = columns.pop("time")
    write_csv(tmp_path / "log.csv", {"": np.arange(N)} | columns | {"elapsed": (time - START) / 1e9})
    assert extract([tmp_path / "log.csv"], table_map(), 40.0).duration == pytest.approx(0.6, abs=0.03)
    write_csv(tmp_path / "none.csv", {"": np.arange(N), "v_x": np.sin(columns["v_x"])})
    with pytest.raises(BagError, match=r"no time column among column_1, v_x.*and is no number of the row"):
        inspect(tmp_path / "none.csv")


def test_an_index_that_pandas_gave_no_name_is_the_time(tmp_path: Path, columns: Any) -> None:
    stamps = pa.array(columns.pop("time"), pa.timestamp("ns"))
    pq.write_table(pa.table(columns | {"__index_level_0__": stamps}), tmp_path / "log.parquet")
    assert extract([tmp_path / "log.parquet"], table_map(), 40.0).time[0] == START


DATES = {
    "2026-11-29 23:59:59.{:03d}": 1_795_996_799, "2026-11-29T23:59:59.{:03d}Z": 1_795_996_799,
    "2026-11-30T01:59:59.{:03d}+02:00": 1_795_996_799, "29.11.2026 23:59:59,{:03d}": 1_795_996_799,
    "11/29/2026 11:59:59.{:03d} PM": 1_795_996_799, "29/11/2026 23:59:59.{:03d}": 1_795_996_799, "23:59:59.{:03d}": 86_399,
    "2026-11-30T01:59:59.{:03d}+02": 1_795_996_799, "2026-11-29 19:29:59.{:03d} -0430": 1_795_996_799,
    "2026-11-29 23:59:59.{:03d} UTC": 1_795_996_799, "23:59:59:{:03d}": 86_399, "59:59.{:03d}": 3_599,
    "11:59:59.{:03d} pm": 86_399,
}  # fmt: skip


@pytest.mark.parametrize("form", DATES)
def test_dates_and_times_of_day_are_read(tmp_path: Path, columns: Any, form: str) -> None:
    write_csv(tmp_path / "log.csv", columns | {"time": [form.format(10 * k) for k in range(N)]}, delimiter=";")
    found = extract([tmp_path / "log.csv"], table_map(), 40.0)
    assert found.time[0] == DATES[form] * 1_000_000_000
    assert len(found) == 24


@pytest.mark.parametrize(
    ("heading", "seconds"), [("Time [min]", 60.0), ("elapsed (h)", 3600.0), ("Time [minutes]", 60.0)]
)
def test_minutes_and_hours_are_units_of_time(tmp_path: Path, columns: Any, heading: str, seconds: float) -> None:
    del columns["time"]
    write_csv(tmp_path / "log.csv", columns | {heading: np.arange(N) / 100.0 / seconds})
    for time in (None, inspect(tmp_path / "log.csv").time):
        assert extract([tmp_path / "log.csv"], table_map(time=time), 40.0).duration == pytest.approx(0.6, abs=1e-3)


def test_a_unit_of_time_that_is_unknown_is_told(tmp_path: Path, columns: Any) -> None:
    del columns["time"]
    write_csv(tmp_path / "log.csv", columns | {"Time [tick]": np.arange(N) / 100.0})
    (note,) = [each for each in inspect(tmp_path / "log.csv").notes if "time in s" in each]
    assert "nobody knows its unit 'tick'" in note


def test_minutes_go_on_past_the_hour(tmp_path: Path, columns: Any) -> None:
    stamps = [f"{'59:59' if k < 30 else '00:00'}.{(700 + 10 * k) % 1000:03d}" for k in range(N)]
    write_csv(tmp_path / "log.csv", columns | {"time": stamps})
    found = extract([tmp_path / "log.csv"], table_map(), 40.0)
    assert (len(found), set(found.segment)) == (24, {0})


@pytest.mark.parametrize("times", [2, 3])
def test_rows_that_are_there_several_times_can_be_dropped(tmp_path: Path, columns: Any, times: int) -> None:
    write_csv(tmp_path / "log.csv", {name: np.repeat(each, times) for name, each in columns.items()})
    with pytest.raises(BagError, match=r"with a repeated stamp \(\d+ such\).*--drop-bad"):
        extract([tmp_path / "log.csv"], table_map(), 40.0)
    assert len(extract([tmp_path / "log.csv"], table_map(), 40.0, drop_bad=True)) == 24


def test_two_drives_in_one_table_are_told(tmp_path: Path, columns: Any) -> None:
    write_csv(
        tmp_path / "log.csv", columns | {"time": np.r_[0:25, 0 : N - 25] / 100.0 + np.r_[25 * [9.0], (N - 25) * [0.0]]}
    )
    with pytest.raises(BagError, match=r"25 such; the clock starts anew at sample 25"):
        extract([tmp_path / "log.csv"], table_map(), 40.0)


def test_seconds_and_nanoseconds_may_stand_in_two_columns(tmp_path: Path, columns: Any) -> None:
    stamps = columns.pop("time")
    write_csv(tmp_path / "log.csv", columns | {"stamp.sec": stamps // 10**9, "stamp.nanosec": stamps % 10**9})
    found = inspect(tmp_path / "log.csv").time
    assert found is not None
    assert (found.column, found.unit, found.nanoseconds) == ("stamp.sec", "s", "stamp.nanosec")
    for time in (None, found):
        assert extract([tmp_path / "log.csv"], table_map(time=time), 40.0).time[0] == START


@pytest.mark.parametrize(("start", "form"), [(0, ",.1f"), (999_900, ",.1f"), (999_900, ","), (12_345_000, ",")])
def test_commas_between_thousands_are_read(tmp_path: Path, columns: Any, start: int, form: str) -> None:
    del columns["time"]
    american = {name: [f"{one:,.3f}" for one in column.tolist()] for name, column in columns.items()}
    stamps = [format(start + 10 * k, form) for k in range(N)]
    write_csv(tmp_path / "log.csv", american | {"Time [ms]": stamps}, quoting_style="all_valid")
    recording = extract([tmp_path / "log.csv"], table_map(), 40.0)
    assert (recording.time[0], len(recording)) == (start * 10**6, 24)
    german = {name: [f"{one:.3f}".replace(".", ",") for one in column.tolist()] for name, column in columns.items()}
    write_csv(
        tmp_path / "german.csv",
        german | {"time": [f"{0.01 * k:.3f}".replace(".", ",") for k in range(N)]},
        delimiter=";",
    )
    assert extract([tmp_path / "german.csv"], table_map(), 40.0).duration < 1.0


@pytest.mark.parametrize("start", [0, 999_000, 12_345_000])
def test_points_between_thousands_are_none_of_decimals(tmp_path: Path, columns: Any, start: int) -> None:
    stamps = [f"{start + 10 * k:,}".replace(",", ".") for k in range(N)]
    german = {name: [f"{one!r}".replace(".", ",") for one in column.tolist()] for name, column in columns.items()}
    write_csv(tmp_path / "log.csv", german | {"time": stamps}, delimiter=";", quoting_style="none")
    recording = extract([tmp_path / "log.csv"], table_map(), 40.0)
    assert (recording.time[0], len(recording)) == (start * 10**6, 24)


def test_a_time_of_day_goes_on_past_midnight(tmp_path: Path, columns: Any) -> None:
    stamps = [f"{'23:59:59' if k < 30 else '00:00:00'}.{(700 + 10 * k) % 1000:03d}" for k in range(N)]
    write_csv(tmp_path / "log.csv", columns | {"time": stamps})
    found = extract([tmp_path / "log.csv"], table_map(), 40.0)
    assert (len(found), set(found.segment)) == (24, {0})


@pytest.mark.parametrize("kind", ["ns", "us", "ms"])
def test_timestamps_of_parquet_are_read(tmp_path: Path, columns: Any, kind: str) -> None:
    stamps = pa.array(columns["time"]).cast(pa.timestamp("ns")).cast(pa.timestamp(kind), safe=False)
    pq.write_table(pa.table(columns | {"time": stamps}), tmp_path / "log.parquet")
    assert len(extract([tmp_path / "log.parquet"], table_map(), 40.0)) in (23, 24)
