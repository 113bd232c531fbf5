"""Recordings: windows, splits, command protocols, and the file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dynssm_ros.errors import RecordingError
from dynssm_ros.signals.inputs import WINDOW_COLUMNS
from dynssm_ros.signals.recording import COLUMN_UNITS, METADATA_KEY, Recording, RecordingInfo, concatenate


def recording(segments: list[int], commands: Any = "topics", pose: bool = True, source: str = "bag") -> Recording:
    """Rows whose column ``k`` counts ``100 k + row``; v_x is the row number."""
    n = len(segments)
    names = [*WINDOW_COLUMNS, *(("x", "y", "theta") if pose else ())]
    info = RecordingInfo(sampling_time=0.04, commands=commands, source=(source,), signal_map="default", notes=("a",))
    gaps = 10**9 * np.array(segments, dtype=np.int64)
    time = 1_700_000_000_000_000_001 + gaps + 40_000_000 * np.arange(n)
    return Recording(
        info, time, np.array(segments, dtype=np.int32), {name: 100.0 * k + np.arange(n) for k, name in enumerate(names)}
    )


def test_a_file_of_more_rows_than_anybody_drives_is_refused_unread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dynssm_ros.signals.recording._MOST_ROWS", 4)
    recording([0] * 5).save(tmp_path / "r.parquet")
    with pytest.raises(RecordingError, match=r"r.parquet: 5 rows; expected at most 4"):
        Recording.load(tmp_path / "r.parquet")


def test_saving_and_loading_gives_the_same_recording(tmp_path: Path) -> None:
    original = recording([0, 0, 1, 1, 1])
    file = tmp_path / "new" / "r.parquet"
    original.save(file)
    again = Recording.load(file)
    assert again.info == original.info
    assert again.columns.keys() == original.columns.keys()
    for name in original.columns:
        np.testing.assert_array_equal(again[name], original[name])
    np.testing.assert_array_equal(again.time, original.time)
    np.testing.assert_array_equal(again.segment, original.segment)
    assert (again.time.dtype, again.segment.dtype) == (np.int64, np.int32)
    assert [p.name for p in file.parent.iterdir()] == ["r.parquet"]


def test_saving_replaces_an_older_file(tmp_path: Path) -> None:
    for n in (3, 5):
        recording([0] * n).save(tmp_path / "r.parquet")
    assert len(Recording.load(tmp_path / "r.parquet")) == 5
    assert [p.name for p in tmp_path.iterdir()] == ["r.parquet"]


def test_the_file_says_the_unit_of_every_column(tmp_path: Path) -> None:
    recording([0, 0]).save(tmp_path / "r.parquet")
    schema = pq.read_schema(tmp_path / "r.parquet")
    units = {name: schema.field(name).metadata[b"unit"].decode() for name in schema.names}
    assert units | {"v_y_std": "m/s", "gear": "1", "engine_speed": "rad/s"} == COLUMN_UNITS | {
        "time": "ns",
        "segment": "",
    }


def test_a_folder_that_looks_like_a_partition_adds_no_column(tmp_path: Path) -> None:
    recording([0, 0]).save(tmp_path / "time=3" / "r.parquet")
    assert len(Recording.load(tmp_path / "time=3" / "r.parquet")) == 2


def rewritten(tmp_path: Path, change: Any, metadata: dict[bytes, bytes] | None = None) -> Path:
    file = tmp_path / "r.parquet"
    recording([0, 0, 0]).save(file)
    table = pq.read_table(file)
    table = change(table).replace_schema_metadata(table.schema.metadata if metadata is None else metadata)
    pq.write_table(table, file)
    return file


def with_column(table: pa.Table, name: str, values: Any) -> pa.Table:
    return table.set_column(table.column_names.index(name), name, values)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda t: t.drop_columns(["omega"]), "column omega is missing"),
        (lambda t: t.drop_columns(["time"]), "column time is missing"),
        (
            lambda t: with_column(t, "v_x", pa.array([1.0, float("nan"), 2.0])),
            "column v_x, row 1: nan; expected a finite",
        ),
        (lambda t: with_column(t, "v_x", pa.array([1.0, 2.0, float("inf")])), "column v_x, row 2: inf"),
        (lambda t: with_column(t, "v_x", pa.array([1.0, None, 2.0])), "column v_x: 1 empty rows; expected double"),
        (lambda t: with_column(t, "v_x", pa.array(["a", "b", "c"])), "column v_x: string; expected double"),
        (lambda t: with_column(t, "time", pa.array([0, None, 2])), "column time: 1 empty rows; expected int64"),
        (lambda t: t.slice(0, 0), "the recording is empty"),
        (
            lambda t: with_column(t, "time", pa.array([0, 40_000_000, 120_000_000])),
            "column time, row 2: 0.08 s after the row before; expected the sampling time 0.04 s within a segment",
        ),
        (lambda t: with_column(t, "time", pa.array([0, 40_000_000, 40_000_000])), "column time, row 2: 0 s after"),
        (lambda t: with_column(t, "time", pa.array([80_000_000, 40_000_000, 0])), "column time, row 1: -0.04 s after"),
        (
            lambda t: with_column(t, "segment", pa.array([0, 1, 0], pa.int32())),
            "column segment, row 2: 0 after 1; expected no less",
        ),
    ],
)
def test_a_damaged_recording_names_file_and_column(tmp_path: Path, change: Any, expected: str) -> None:
    file = rewritten(tmp_path, change)
    with pytest.raises(RecordingError) as caught:
        Recording.load(file)
    assert str(caught.value).startswith(f"{file}: ")
    assert expected in str(caught.value)


@pytest.mark.parametrize(
    ("metadata", "expected"),
    [
        ({b"other": b"1"}, "Parquet, but not a dynssm recording"),
        ({METADATA_KEY: b"{"}, "metadata not understood: Invalid JSON"),
        ({METADATA_KEY: b'{"commands": "none"}'}, "metadata not understood: sampling_time: Field required"),
        ({METADATA_KEY: b'{"version": 2, "commands": "none", "sampling_time": 0.1}'}, r"version: .* \(got 2\)"),
    ],
)
def test_metadata_that_does_not_fit_is_told(tmp_path: Path, metadata: dict[bytes, bytes], expected: str) -> None:
    with pytest.raises(RecordingError, match=expected):
        Recording.load(rewritten(tmp_path, lambda table: table, metadata))


@pytest.mark.parametrize("content", [b"", b"PAR1", b"not parquet at all" * 10])
def test_what_is_not_parquet_is_told_in_one_line(tmp_path: Path, content: bytes) -> None:
    file = tmp_path / "r.parquet"
    file.write_bytes(content)
    with pytest.raises(RecordingError, match="not a readable Parquet file") as caught:
        Recording.load(file)
    assert "\n" not in str(caught.value)


def test_a_flipped_bit_changes_nothing_or_is_told(tmp_path: Path) -> None:
    file, damaged = tmp_path / "r.parquet", tmp_path / "damaged.parquet"
    original = recording([0, 0, 0])
    original.save(file)
    content, refusals = file.read_bytes(), []
    for position in range(0, len(content), 11):
        bits = content[position] ^ 1 << position % 8
        damaged.write_bytes(content[:position] + bytes([bits]) + content[position + 1 :])
        try:
            again = Recording.load(damaged)
        except RecordingError as error:
            refusals.append(str(error))
            continue
        assert again.info == original.info
        assert again.columns.keys() == original.columns.keys()
        np.testing.assert_array_equal(again.matrix, original.matrix)
        np.testing.assert_array_equal(again.time, original.time)
    assert len(refusals) > len(content) / 11 / 2
    assert all(words.startswith(f"{damaged}: ") for words in refusals)


def test_a_recording_without_checksums_opens(tmp_path: Path) -> None:
    file = rewritten(tmp_path, lambda table: table)
    assert Recording.load(file)["v_x"].tolist() == [0, 1, 2]


def test_a_cut_off_file_is_told(tmp_path: Path) -> None:
    file = tmp_path / "r.parquet"
    recording([0] * 50).save(file)
    file.write_bytes(file.read_bytes()[:-20])
    with pytest.raises(RecordingError, match="not a readable Parquet file"):
        Recording.load(file)


@pytest.mark.parametrize("what", ["missing.parquet", ".", "x" * 300])
def test_a_missing_recording_says_how_to_make_one(tmp_path: Path, what: str) -> None:
    with pytest.raises(RecordingError, match="no such recording; `dynssm extract` makes one"):
        Recording.load(tmp_path / what)


@given(
    st.lists(st.integers(1, 12), min_size=1, max_size=5),
    st.integers(1, 6),
    st.integers(0, 4),
    st.floats(-1, 30),
)
def test_window_ends_are_those_found_by_looking_at_every_window(
    lengths: list[int], H: int, horizon: int, min_speed: float
) -> None:
    segments = [number for number, length in enumerate(lengths) for _ in range(length)]
    r = recording(segments)
    r.columns["v_x"][::2] *= -1.0  # backwards
    expected = [
        t
        for t in range(len(segments))
        if t - H + 1 >= 0
        and t + horizon < len(segments)
        and len(set(segments[t - H + 1 : t + horizon + 1])) == 1
        and all(np.abs(r["v_x"][t - H + 1 : t + horizon + 1]) >= min_speed)
    ]
    assert r.window_ends(H, horizon, min_speed).tolist() == expected


def test_a_recording_shorter_than_its_window_has_no_windows() -> None:
    assert recording([0, 0]).window_ends(15).tolist() == []


def test_the_matrix_holds_the_window_columns_in_order() -> None:
    r = recording([0, 0, 0])
    assert r.matrix.shape == (3, 7)
    np.testing.assert_array_equal(r.matrix[0], 100.0 * np.arange(7))


def test_duration_counts_recorded_time_without_gaps() -> None:
    assert recording([0, 0, 5, 5]).duration == pytest.approx(0.16)


def test_the_last_part_is_split_off_as_one_block() -> None:
    r = recording([0] * 7 + [1] * 3)
    first, last = r.split_last(0.2)
    assert (len(first), len(last)) == (8, 2)
    np.testing.assert_array_equal(np.concatenate([first.time, last.time]), r.time)
    assert first.segment.tolist() == [0] * 7 + [1]
    assert last.segment.tolist() == [0, 0]


@pytest.mark.parametrize(("fraction", "sizes"), [(0.0, (10, 0)), (1.0, (0, 10)), (0.33, (7, 3))])
def test_any_fraction_can_be_split_off(fraction: float, sizes: tuple[int, int]) -> None:
    assert tuple(len(part) for part in recording([0] * 10).split_last(fraction)) == sizes


def test_a_selection_that_cuts_a_segment_apart_makes_several() -> None:
    r = recording([0, 0, 0, 0, 0, 1, 1])
    kept = r.select(r["v_x"] != 2)
    assert kept["v_x"].tolist() == [0, 1, 3, 4, 5, 6]
    assert kept.segment.tolist() == [0, 0, 1, 1, 2, 2]
    assert kept.window_ends(2, 0).tolist() == [1, 3, 5]


def test_a_selection_by_slice_mask_and_index_is_the_same() -> None:
    r = recording([0, 0, 1, 1])
    for rows in (slice(1, 3), np.array([False, True, True, False]), np.array([1, 2])):
        kept = r.select(rows)
        assert kept["v_x"].tolist() == [1, 2]
        assert kept.segment.tolist() == [0, 1]


@pytest.mark.parametrize("count", [1, 3, 4])
def test_stretches_are_all_rows_one_after_the_other(count: int) -> None:
    r = recording([0] * 10)
    parts = [r.select(stretch)["v_x"].tolist() for stretch in r.stretches(count)]
    assert [value for part in parts for value in part] == r["v_x"].tolist()
    assert max(map(len, parts)) - min(map(len, parts)) <= 1


def test_lookahead_commands_are_the_next_feedback_inside_a_segment() -> None:
    r = recording([0, 0, 0, 1, 1]).with_commands("lookahead")
    assert r.info.commands == "lookahead"
    assert r["r_cmd"].tolist() == r["delta_cmd"].tolist() == [1, 1, 0, 1, 0]


def test_commands_can_be_left_out_and_kept() -> None:
    r = recording([0, 0])
    assert r.with_commands(None) is r
    assert r.with_commands("topics") is r
    bare = r.with_commands("none")
    assert bare["r_cmd"].tolist() == bare["delta_cmd"].tolist() == [0, 0]
    assert r["r_cmd"].tolist() == [500, 501]


def test_recorded_commands_cannot_be_made_up() -> None:
    with pytest.raises(RecordingError, match=r"recording run7: commands 'topics' asked for.*'none'.*extract"):
        recording([0], "none", source="run7").with_commands("topics")


def test_joined_recordings_keep_their_segments_apart() -> None:
    joined = concatenate([recording([0, 0, 1]), recording([0, 1], source="second")])
    assert joined.segment.tolist() == [0, 0, 1, 2, 3]
    assert joined.info.source == ("bag", "second")
    assert joined.info.notes == ("a", "a")
    assert joined["v_x"].tolist() == [0, 1, 2, 0, 1]


def test_a_pose_that_only_some_recordings_have_is_left_out() -> None:
    joined = concatenate([recording([0]), recording([0], pose=False)])
    assert not joined.has_pose
    assert recording([0]).has_pose


@pytest.mark.parametrize(
    ("update", "expected"),
    [
        ({"sampling_time": 0.02}, "sampling_time 0.02, but bag has 0.04"),
        ({"commands": "none"}, "commands none, but bag"),
    ],
)
def test_recordings_that_do_not_match_are_not_joined(update: dict[str, Any], expected: str) -> None:
    first, second = recording([0]), recording([0], source="second")
    other = Recording(second.info.model_copy(update=update), second.time, second.segment, second.columns)
    with pytest.raises(RecordingError, match=f"recording second: {expected}"):
        concatenate([first, other])


def test_nothing_cannot_be_joined() -> None:
    with pytest.raises(RecordingError, match="no recording given"):
        concatenate([])


def test_windows_are_the_rows_up_to_each_end_and_over_the_horizon() -> None:
    r = recording([0] * 20)
    ends = r.window_ends(4, horizon=3)
    found = r.windows(ends, 4, 3)
    assert found.shape == (14, 7, 7)
    np.testing.assert_array_equal(found[0], r.matrix[0:7])
    np.testing.assert_array_equal(found[5], r.matrix[5:12])
    np.testing.assert_array_equal(r.windows(ends, 4)[:, -1, :3], r.states(ends))


def test_drives_of_other_days_follow_each_other_where_time_is_told() -> None:
    one = recording([0] * 5)
    other = recording([1] * 5)
    later = Recording(other.info, one.time + 3 * 86_400 * 10**9, other.segment, other.columns)
    rows = 0.04 * np.arange(5)
    np.testing.assert_allclose(concatenate([one, later]).elapsed, [*rows, *(rows[-1] + 1.0 + rows)], atol=1e-9)
