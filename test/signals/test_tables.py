"""Tables as logs: the recording of a bag with the same numbers, whatever the file; and one line for what is none."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq
import pytest
import scipy.io

from dynssm_ros.errors import BagError, ConfigurationError, UserError
from dynssm_ros.signals.decoding import decoders
from dynssm_ros.signals.extraction import extract
from dynssm_ros.signals.inspection import inspect
from dynssm_ros.signals.logs import open_log
from dynssm_ros.signals.recording import Recording
from dynssm_ros.signals.signal_map import SignalMap, load_signal_map
from dynssm_ros.signals.tables import open_table

START = 1_700_000_000_123_456_789
DEFAULT = load_signal_map("default")
N = 60


def table_map(**columns: Any) -> SignalMap:
    """A map of columns that are named as their signals, with other sources for ``columns``."""
    sources = {name: {"column": name} for name in DEFAULT.signals} | {
        name: source for name, source in columns.items() if name != "time"
    }
    return SignalMap(name="own", time=columns.get("time"), signals={k: v for k, v in sources.items() if v})


def write_csv(path: Path, columns: dict[str, Any], **options: Any) -> None:
    pa.csv.write_csv(pa.table(columns), path, pa.csv.WriteOptions(**options))


def write_blanks(path: Path, columns: dict[str, Any], width: int = 24) -> None:
    rows = [columns, *zip(*(values.tolist() for values in columns.values()), strict=True)]
    path.write_text("# a log\n" + "".join("".join(f"{cell!s:>{width}}" for cell in row) + "\n" for row in rows))


def write_struct(path: Path, columns: dict[str, Any]) -> None:
    scipy.io.savemat(path, {"log": columns, "car": "orca"})


def write_nested(path: Path, columns: dict[str, Any]) -> None:
    inner, outer = dict(list(columns.items())[::2]), dict(list(columns.items())[1::2])
    scipy.io.savemat(path, {"log": outer | {"car": "orca"}, "ins": {"rear": inner, "car": "orca"}})


WRITERS: dict[str, Callable[[Path, dict[str, Any]], None]] = {
    "log.csv": write_csv,
    "tab.txt": lambda path, columns: write_csv(path, columns, delimiter="\t", quoting_style="none"),
    "blanks.txt": write_blanks,
    "log.parquet": lambda path, columns: pq.write_table(pa.table(columns), path),
    "log.mat": scipy.io.savemat,
    "packed.mat": lambda path, columns: scipy.io.savemat(path, columns, do_compression=True, oned_as="column"),
    "struct.mat": write_struct,
    "nested.mat": write_nested,
    "log.npz": lambda path, columns: np.savez(path, **columns, T_s=0.01),
    "packed.npz": lambda path, columns: np.savez_compressed(path, **columns),
}


def assert_same(found: Recording, expected: Recording) -> None:
    np.testing.assert_array_equal(found.time, expected.time)
    np.testing.assert_array_equal(found.segment, expected.segment)
    np.testing.assert_allclose(found.matrix, expected.matrix, rtol=0, atol=1e-15)
    for name in ("x", "y", "theta"):
        np.testing.assert_allclose(found[name], expected[name], rtol=0, atol=1e-15)


@pytest.mark.parametrize("name", WRITERS)
def test_a_table_gives_the_recording_of_a_bag_with_the_same_numbers(
    make_bag: Any, make_ros1_bag: Any, drive: Any, tmp_path: Path, columns: Any, name: str
) -> None:
    WRITERS[name](tmp_path / name, columns)
    found = extract([tmp_path / name], table_map(), 40.0)
    assert_same(found, extract([make_bag(drive(N))], DEFAULT, 40.0))
    assert_same(found, extract([make_ros1_bag(drive(N))], DEFAULT, 40.0))
    assert (found.info.commands, found.info.signal_map, found.info.source) == ("topics", "own", (name,))


@pytest.mark.parametrize(
    "lines", ["# t v_x\n0.0 1.5\n", "t   v_x\n  0.0   1.5\n", "0.0  1.5\n", "\ufefft  v_x\n0,0  1,5\n"]
)
def test_columns_apart_by_blanks_are_found(tmp_path: Path, lines: str) -> None:
    text = lines + "".join(f"{0.1 * k:.1f}   {1 + k}.25 \n" for k in range(1, 40))
    text = text.replace(".", ",") if "," in lines else text
    (tmp_path / "log.txt").write_text(text, encoding="utf-8")
    with open_log(tmp_path / "log.txt") as table:
        names = list(table.headings)
        read = table.read(names)
    assert names == (["t", "v_x"] if "v_x" in lines else ["column_1", "column_2"])
    np.testing.assert_array_equal(read[names[1]].values[[0, 1, -1]], [1.5, 2.25, 40.25])


@pytest.mark.parametrize("name", ["log.csv", "log.parquet", "log.mat", "log.npz"])
def test_what_a_table_is_follows_from_its_content(tmp_path: Path, columns: Any, name: str) -> None:
    WRITERS[name](tmp_path / name, columns)
    (tmp_path / name).rename(tmp_path / "data.log")
    assert len(extract([tmp_path / "data.log"], table_map(), 40.0)) == 24


@pytest.mark.parametrize("name", ["log.npz", "log.mat"])
@pytest.mark.parametrize("turned", [False, True])
def test_rows_or_columns_of_a_matrix_are_columns(tmp_path: Path, columns: Any, name: str, turned: bool) -> None:
    write_csv(tmp_path / "log.csv", columns)
    states = np.stack([columns.pop(one) for one in ("v_x", "v_y", "omega")])
    WRITERS[name](tmp_path / name, columns | {"states": states.T if turned else states, "other": np.ones((3, 4))})
    named = {one: {"column": f"states[{k}]"} for k, one in enumerate(("v_x", "v_y", "omega"))}
    found = extract([tmp_path / name], table_map(**named), 40.0)
    assert_same(found, extract([tmp_path / "log.csv"], table_map(), 40.0))
    assert found.info.notes[-1] == "other is left out: a matrix of 3 x 4"
    assert inspect(tmp_path / name).topics["states[1]"].unit == ""


@pytest.mark.parametrize("name", ["log.npz", "log.mat", "log.npy"])
def test_a_matrix_alone_is_a_table(tmp_path: Path, columns: Any, name: str) -> None:
    write_csv(tmp_path / "log.csv", columns)
    columns["time"] = (columns["time"] - START) / 1e9
    matrix = np.stack(list(columns.values()), axis=1)
    if name.endswith("npy"):
        np.save(tmp_path / name, matrix)
    else:
        WRITERS[name](tmp_path / name, {"array": matrix})
    named = {one: {"column": f"array[{k}]"} for k, one in enumerate(columns) if one != "time"}
    found = extract([tmp_path / name], table_map(**named), 40.0)
    np.testing.assert_allclose(found.matrix, extract([tmp_path / "log.csv"], table_map(), 40.0).matrix, atol=1e-12)


def test_units_curves_and_offsets_are_those_of_the_map(tmp_path: Path, columns: Any) -> None:
    as_logged = {
        **columns, "v_x": columns["v_x"] * 3.6, "omega": np.degrees(columns["omega"]), "y": columns["y"] * 100,
        "theta": np.degrees(columns["theta"]) % 360, "throttle_feedback": columns["throttle_feedback"] * 100 + 5,
        "steering_feedback": -np.degrees(columns["steering_feedback"]) * 14,
    }  # fmt: skip
    write_csv(tmp_path / "log.csv", as_logged)
    sources = {
        "v_x": {"unit": "km/h"}, "omega": {"unit": "deg/s"}, "y": {"unit": "cm"}, "theta": {"unit": "deg"},
        "throttle_feedback": {"unit": "%", "curve": [[0, -5], [105, 100]]},
        "steering_feedback": {"unit": "deg", "scale": -1 / 14},
    }  # fmt: skip
    mapped = table_map(**{name: {"column": name} | source for name, source in sources.items()})
    write_csv(tmp_path / "plain.csv", columns)
    found, plain = (extract([tmp_path / f"{k}.csv"], m, 40.0) for k, m in (("log", mapped), ("plain", table_map())))
    np.testing.assert_allclose(found.matrix, plain.matrix, atol=1e-12)
    np.testing.assert_allclose(found["theta"], plain["theta"], atol=1e-12)


def test_cells_without_a_value_are_no_samples(tmp_path: Path, columns: Any) -> None:
    """As where slow sensors share a table with fast ones."""
    sparse = [f"{value!r}" if k % 5 == 0 else "" for k, value in enumerate(columns["steering_feedback"].tolist())]
    write_csv(tmp_path / "log.csv", columns | {"steering_feedback": sparse})
    recording = extract([tmp_path / "log.csv"], table_map(), 100.0)
    assert recording.info.held_periods["steering_feedback"] == pytest.approx(0.05)


def test_samples_that_are_held_until_the_next_count_once(tmp_path: Path, columns: Any) -> None:
    """As where 50 Hz are written at 100 Hz; what stays longer than that, as at standstill, is kept."""
    slow = ("v_x", "v_y", "omega", "x", "y", "theta")
    first = np.arange(N) % 2 == 0
    held = columns | {name: np.where(first, columns[name], np.roll(columns[name], 1)) for name in slow}
    blank = columns | {name: pa.array(columns[name], mask=~first) for name in slow}
    for name, each in (("held", held), ("blank", blank)):
        write_csv(tmp_path / f"{name}.csv", each)
    found, expected = (extract([tmp_path / f"{name}.csv"], table_map(), 100.0) for name in ("held", "blank"))
    rows = slice(0, min(len(found), len(expected)))
    np.testing.assert_array_equal(found.matrix[rows], expected.matrix[rows])
    assert "v_x, v_y, omega: 30 samples that repeat the one before left out" in found.info.notes
    assert found.info.interpolated["v_x"] > 0.4
    still = columns | {name: np.where(np.arange(N) < 40, columns[name][0], columns[name]) for name in slow}
    write_csv(tmp_path / "still.csv", still)
    assert len(extract([tmp_path / "still.csv"], table_map(), 100.0)) >= N - 1


def test_cells_that_are_no_numbers_are_told_or_left_out(tmp_path: Path, columns: Any) -> None:
    odd = ["ERR" if k in (20, 30) else f"{value!r}" for k, value in enumerate(columns["v_x"].tolist())]
    write_csv(tmp_path / "log.csv", columns | {"v_x": odd})
    with pytest.raises(
        BagError, match=r"column 'v_x' for v_x: 2 of its cells are no number, first 'ERR' in row 21;.*--drop-bad"
    ):
        extract([tmp_path / "log.csv"], table_map(), 40.0)
    recording = extract([tmp_path / "log.csv"], table_map(), 40.0, drop_bad=True)
    assert recording.info.notes == ("v_x: dropped 2 samples not finite",)
    write_csv(tmp_path / "log.csv", columns | {"v_x": ["yes"] * N})
    with pytest.raises(BagError, match="column 'v_x' for v_x: text, 'yes' first; expected numbers"):
        extract([tmp_path / "log.csv"], table_map(), 40.0, drop_bad=True)


def test_stamps_that_run_backwards_are_told_or_left_out(tmp_path: Path, columns: Any) -> None:
    columns["time"][10] -= 10**9
    write_csv(tmp_path / "log.csv", columns)
    with pytest.raises(BagError, match=r"column 'v_x': v_x: sample 10 .* is with a stamp that runs backwards"):
        extract([tmp_path / "log.csv"], table_map(), 40.0)
    assert len(extract([tmp_path / "log.csv"], table_map(), 40.0, drop_bad=True)) == 24


def test_a_last_line_that_was_cut_off_is_left_out(tmp_path: Path, columns: Any) -> None:
    write_csv(tmp_path / "log.csv", columns)
    text = (tmp_path / "log.csv").read_text()
    (tmp_path / "log.csv").write_text(text[:-60])
    recording = extract([tmp_path / "log.csv"], table_map(), 40.0)
    assert len(recording) == 24
    assert recording.info.notes == (f"left out 1 line with another number of cells, first line {N + 1}",)


# --- what is no table, or does not fit the map --------------------------------------------------

REFUSED = {
    "empty": ("", "the file is empty"),
    "blank": ("\n \n", "the file is empty"),
    "text": ("Dear all,\nthis is a text, with commas, here.\nYours\n" * 4, "neither a table nor a bag; expected columns of"),
    "one column": ("v\n1\n2\n3\n", "neither a table"),
    "headings alone": ("time,v_x,v_y\n", "neither a table"),
    "json": (json.dumps({"a": [1, 2], "b": {"c": "x"}}, indent=1), "neither a table"),
    "twice": ("time,v,time\n" + "1,2,3\n" * 5, "columns 1 and 3 are all named 'time'"),
    "other lengths": ("t,v\n" + "".join(f"{k},2{',3' * (k % 3)}\n" for k in range(40)), "lines with another number of cells"),
    "no time": ("a,b\n1,2\n3,1\n2,2\n", "no time column among a, b"),
    "time stands": ("time,b\n" + "1,2\n" * 9, "'time' rises in 0% of the rows"),
    "time falls": ("time,b\n" + "".join(f"{-k},{k % 3}\n" for k in range(9)), "'time' rises in 0% of the rows"),
}  # fmt: skip


@pytest.mark.parametrize("what", REFUSED)
def test_what_is_no_table_is_one_line(tmp_path: Path, what: str) -> None:
    content, said = REFUSED[what]
    path = tmp_path / "log.csv"
    path.write_text(content)
    with pytest.raises(BagError, match=r"^[^\n]*$") as caught:
        inspect(path)
    assert said in str(caught.value)
    assert str(caught.value).startswith(f"{path}: ")


def zipped(path: Path, name: str) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(name, "text")


@pytest.mark.parametrize(
    ("write", "said"),
    [
        (lambda path: path.write_bytes(bytes(range(256)) * 9), "not a bag and not a table"),
        (
            lambda path: path.write_bytes(b"MDF     4.10    " + bytes(50)),
            "an MDF file, which is not read; expected .* CSV",
        ),
        (lambda path: path.write_bytes(b"\x1f\x8b\x08"), "a gzip file"),
        (lambda path: zipped(path, "[Content_Types].xml"), "an Excel workbook, which is not read"),
        (lambda path: zipped(path, "notes.txt"), "a zip file with notes.txt, not of NumPy; expected it unpacked"),
        (lambda path: path.write_bytes(b"PAR1" + bytes(50)), "cannot be read"),
        (lambda path: path.write_bytes(b"PK\x03\x04" + bytes(50)), "a zip file that cannot be read as NumPy's .npz"),
        (lambda path: path.write_bytes(b"MATLAB 7.3 MAT-file, Platform"), r"version 7.3 \(HDF5\); expected .*'-v7'"),
        (
            lambda path: path.write_bytes(b"MATLAB 5.0 MAT-file" + bytes(300)),
            "cannot be read as a MATLAB file|not a table",
        ),
        (lambda path: np.savez(path.open("wb"), time=np.arange(9), v=np.arange(8)), "v of 8 values, time of 9 values"),
        (lambda path: np.savez(path.open("wb"), a=np.ones((9, 2, 2)), b=1.0), "b: a single value; a: a matrix of 9"),
        (
            lambda path: np.savez(path.open("wb"), a=np.array([{}, {}])),
            "not a table .a: Python objects, which are not",
        ),
        (lambda path: np.save(path.open("wb"), np.array([{}, {}])), r"cannot be read as NumPy's .npy"),
        (lambda path: np.savez_compressed(path.open("wb"), a=np.zeros(9_000_000)), "unpacks to 68 MB"),
        (
            lambda path: scipy.io.savemat(path, {"s": {"t": 1.0}, "w": {"t": 1}}, appendmat=False),
            r"not a table \(s\.t: a single value",
        ),
        (lambda path: scipy.io.savemat(path, {"a": "x", "b": 1.0}, appendmat=False), "not a table"),
        (lambda path: pq.write_table(pa.table({"time": pa.array([], pa.int64())}), path), "a table without rows"),
    ],
)
def test_files_that_hold_no_table_are_one_line(tmp_path: Path, write: Any, said: str) -> None:
    write(tmp_path / "data")
    with pytest.raises(BagError, match=said) as caught, open_log(tmp_path / "data"):
        pass
    assert "\n" not in str(caught.value)


def test_a_damaged_matlab_file_ends_its_reader_and_not_us(tmp_path: Path, columns: Any, monkeypatch: Any) -> None:
    scipy.io.savemat(tmp_path / "log.mat", columns)
    monkeypatch.setattr("sys.executable", "/bin/false")
    with pytest.raises(BagError, match=r"cannot be read as a MATLAB file \(its reader ended with status 1\)"):
        inspect(tmp_path / "log.mat")


def test_tables_and_maps_of_topics_do_not_go_together(make_bag: Any, drive: Any, tmp_path: Path, columns: Any) -> None:
    write_csv(tmp_path / "log.csv", columns)
    with pytest.raises(
        BagError, match=r"log.csv: a table, and signal map default names topics; expected one with columns"
    ):
        extract([tmp_path / "log.csv"], DEFAULT, 40.0)
    with pytest.raises(UserError, match="signal map own: names columns of a table"):
        extract([make_bag(drive(5))], table_map(), 40.0)
    with pytest.raises(ConfigurationError, match="names columns of a table"):
        decoders(table_map())
    with pytest.raises(BagError, match=r"column 'speed' is missing; the table has time, v_x, v_y"):
        extract([tmp_path / "log.csv"], table_map(v_x={"column": "speed"}), 40.0)
    with pytest.raises(BagError, match="time column 'y' rises in 0% of the rows"):
        extract([tmp_path / "log.csv"], table_map(time={"column": "y"}), 40.0)


@pytest.mark.parametrize(
    ("source", "said"),
    [
        ({"column": "v", "topic": "/a"}, "column 'v' and topic '/a'; expected either"),
        ({"topic": "/a", "type": "a/msg/B"}, "field is missing"),
        ({}, "topic is missing; expected topic, type and field, or the column of a table"),
        ({"column": "v", "unit": "furlong"}, "expected one of m/s km/h"),
        ({"topic": "/a", "type": "a/msg/B", "field": "c"}, "some are columns of a table, others fields of topics"),
    ],
)
def test_a_source_is_a_field_or_a_column(source: dict[str, str], said: str) -> None:
    sources: dict[str, Any] = {name: {"column": name} for name in DEFAULT.signals}
    with pytest.raises(ValueError, match=said):
        SignalMap(name="own", signals=sources | {"v_x": source})


def test_without_command_columns_or_topics_there_are_none(
    make_bag: Any, drive: Any, tmp_path: Path, columns: Any
) -> None:
    del columns["throttle_command"], columns["steering_command"]
    write_csv(tmp_path / "log.csv", columns)
    for found in (
        extract([tmp_path / "log.csv"], table_map(), 40.0),
        extract([make_bag([one for one in drive(N) if "command" not in one[0]])], DEFAULT, 40.0),
    ):
        assert found.info.commands == "none"
        (note,) = found.info.notes
        assert note.startswith("no commands in the log (")
        assert not found["r_cmd"].any()


def test_rows_without_a_time_are_left_out_with_a_note(tmp_path: Path, columns: Any) -> None:
    stamps = ["ERR" if k == 7 else "" if k in (20, 21) else str(one) for k, one in enumerate(columns["time"].tolist())]
    write_csv(tmp_path / "log.csv", columns | {"time": stamps})
    recording = extract([tmp_path / "log.csv"], table_map(), 40.0)
    assert (len(recording), recording.info.notes) == (24, ("3 rows have no time in column 'time'; left out",))
    assert "3 rows have no time in column 'time'; left out" in inspect(tmp_path / "log.csv").notes


@pytest.mark.parametrize("turn", [1, -1])
def test_logs_with_and_without_commands_are_joined_without(tmp_path: Path, columns: Any, turn: int) -> None:
    write_csv(tmp_path / "with.csv", columns)
    del columns["throttle_command"], columns["steering_command"]
    write_csv(tmp_path / "without.csv", columns | {"time": columns["time"] + 10**10})
    recording = extract([tmp_path / name for name in ("with.csv", "without.csv")[::turn]], table_map(), 40.0)
    assert (recording.info.commands, recording.info.source[::turn]) == ("none", ("with.csv", "without.csv"))
    assert "no commands in without.csv; commands: none" in recording.info.notes[0]
    assert not recording["r_cmd"].any()


def test_a_table_of_many_rows_is_read_in_pieces(tmp_path: Path) -> None:
    """Cells are never taken one by one: 300 000 of them would take as many microseconds, several times over."""
    n = 100_000
    t = np.arange(n) / 1000.0
    one = pa.array(np.sin(t))
    write_csv(tmp_path / "log.csv", {"time": t} | dict.fromkeys(DEFAULT.signals, one))
    with open_log(tmp_path / "log.csv") as table:
        assert abs(table.rows / n - 1) < 0.2  # type: ignore[union-attr]
    assert len(extract([tmp_path / "log.csv"], table_map(), 100.0)) == n // 10


@pytest.mark.parametrize("dictionary", [True, False])
def test_a_parquet_file_that_unpacks_to_far_more_than_it_is_is_refused_before_it_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, dictionary: bool
) -> None:
    """Of one value, whether its rows or its pages are many bytes."""
    file = tmp_path / "log.parquet"
    table = pa.table({"time": np.zeros(300_000), "v": np.zeros(300_000)})
    pq.write_table(table, file, compression="zstd", use_dictionary=dictionary)
    assert open_table(file).rows == 300_000
    monkeypatch.setattr("dynssm_ros.signals.recover._UNPACKED", 1 << 20)
    with pytest.raises(BagError, match=r"log.parquet: unpacks to \d MB; expected at most 100 times its size"):
        open_table(file)


def test_a_byte_that_no_encoding_has_is_told_in_one_line(tmp_path: Path, columns: Any) -> None:
    file = tmp_path / "log.csv"
    write_csv(file, columns)
    lines = file.read_bytes().split(b"\n")
    lines[5] = lines[5].replace(b".", b"\x81", 1)  # neither UTF-8 nor cp1252
    file.write_bytes(b"\n".join(lines))
    with pytest.raises(BagError, match=r"log.csv: cannot be read \(.*can't decode byte 0x81"):
        open_table(file).read(["y"])
