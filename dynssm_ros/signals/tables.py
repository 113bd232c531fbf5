"""Tables as logs: CSV, Parquet, MATLAB and NumPy files, read column by column."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq

from dynssm_ros.errors import BagError
from dynssm_ros.signals.array_files import mat_arrays, npy_arrays, npz_arrays
from dynssm_ros.signals.columns import Heading, LogColumn, heading, kind_of, parsed, told_bad, typed_column
from dynssm_ros.signals.csv_layout import OneBlank, TextLayout, layout_of
from dynssm_ros.signals.recover import vast_table

_GROUP_BYTES, _CELL_BYTES = 512 << 20, 16  # of columns that are in memory at once, and of a cell of them
_MOST_ROWS = 50_000_000  # as of recordings
_TOLD = 30  # columns that a message names
_RAGGED = 0.01  # share of lines with another number of cells, from which on a file is no table
_PARQUET, _ZIP, _MATLAB, _NUMPY = b"PAR1", b"PK\x03\x04", b"MATLAB ", b"\x93NUMPY"


@dataclass(frozen=True)
class LogTable:
    """A table whose columns are read when they are asked for. Use :func:`open_table`."""

    path: Path
    kind: str  # what it is and how it is laid out, in words
    rows: int  # about
    headings: dict[str, Heading]  # by column
    read_columns: Callable[[Sequence[str]], dict[str, LogColumn]]
    notes: list[str] = field(default_factory=list)

    @property
    def told_columns(self) -> str:
        """Names of the columns, not all of very many."""
        names = list(self.headings)
        return ", ".join(names[:_TOLD]) + (f" and {len(names) - _TOLD} more" if len(names) > _TOLD else "")

    def read(self, names: Sequence[str]) -> dict[str, LogColumn]:
        """The columns ``names``.

        Raises:
            BagError: one is missing, or the file cannot be read to its end.
        """
        for name in names:
            if name not in self.headings:
                raise BagError(f"{self.path}: column '{name}' is missing; the table has {self.told_columns}")
        try:
            found = self.read_columns(list(dict.fromkeys(names)))
        except (OSError, pa.ArrowException, ValueError, KeyError) as error:
            raise BagError(f"{self.path}: cannot be read ({_one_line(error)})") from error
        return found

    def groups(self) -> Iterator[dict[str, LogColumn]]:
        """Yields all columns, as many at once as may be in memory."""
        names = list(self.headings)
        size = max(1, _GROUP_BYTES // (_CELL_BYTES * max(self.rows, 1)))
        for first in range(0, len(names), size):
            yield self.read(names[first : first + size])


def open_table(path: str | Path) -> LogTable:
    """Opens a table; what it is follows from its content.

    Raises:
        BagError: not a table, or one that cannot be read.
        MissingExtraError: a MATLAB file, and there is no scipy.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            head = file.read(len(_MATLAB))
        if head.startswith(_PARQUET):
            table = _parquet_table(path)
        elif head.startswith(_ZIP):
            table = _array_table(path, "NumPy archive", *npz_arrays(path))
        elif head.startswith(_NUMPY):
            table = _array_table(path, "NumPy array", *npy_arrays(path))
        elif head.startswith(_MATLAB) or path.suffix == ".mat":
            table = _array_table(path, "MATLAB file", *mat_arrays(path))
        else:
            table = _text_table(path, layout_of(path))
    except (OSError, pa.ArrowException) as error:
        raise BagError(f"{path}: cannot be read ({_one_line(error)})") from error
    if table.rows > _MOST_ROWS:
        raise BagError(f"{path}: {table.rows} rows; expected at most {_MOST_ROWS}")
    if not table.rows or not table.headings:
        raise BagError(f"{path}: a table without rows; expected some")
    return table


def _parquet_table(path: Path) -> LogTable:
    with pq.ParquetFile(path) as file:
        names, rows = file.schema_arrow.names, file.metadata.num_rows
        is_recording = b"dynssm" in (file.schema_arrow.metadata or {})
        vast = vast_table(path, file.metadata)
    if vast:
        raise BagError(f"{path}: {vast}")
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise BagError(f"{path}: two columns are named '{twice}'; expected different names")
    notes = ["this is a recording of dynssm, which other commands take as it is"] if is_recording else []

    def read(wanted: Sequence[str]) -> dict[str, LogColumn]:
        table = pq.read_table(path, columns=list(wanted), partitioning=None, page_checksum_verification=True)
        return {name: typed_column(table[name], str(table[name].type)) for name in wanted}

    return LogTable(path, "Parquet", rows, {name: heading(name) for name in names}, read, notes)


def _array_table(path: Path, kind: str, arrays: dict[str, npt.NDArray[Any]], left_out: dict[str, str]) -> LogTable:
    """A table of equally long vectors; ``left_out`` has what the file holds besides, with the reason."""
    lengths = {name: len(values) for name, values in arrays.items()}
    if not lengths:
        told = "; ".join(f"{name}: {reason}" for name, reason in left_out.items()) or "it is empty"
        raise BagError(f"{path}: not a table ({told}); expected vectors of the same length")
    if len(set(lengths.values())) > 1:
        one, other = (f"{n} of {length} values" for n, length in _extremes(lengths))
        raise BagError(f"{path}: not a table: {one}, {other}; expected vectors of the same length")

    def read(wanted: Sequence[str]) -> dict[str, LogColumn]:
        return {name: typed_column(_arrow(arrays[name]), str(arrays[name].dtype)) for name in wanted}

    notes = [f"{name} is left out: {reason}" for name, reason in left_out.items()]
    return LogTable(path, kind, next(iter(lengths.values())), {name: heading(name) for name in arrays}, read, notes)


def _extremes(lengths: dict[str, int]) -> tuple[tuple[str, int], tuple[str, int]]:
    return min(lengths.items(), key=lambda item: item[1]), max(lengths.items(), key=lambda item: item[1])


def _arrow(values: npt.NDArray[Any]) -> Any:
    native = values.astype(values.dtype.newbyteorder("="))
    return pa.array(native.astype("datetime64[ns]") if native.dtype.kind == "M" else native)


def _text_table(path: Path, layout: TextLayout) -> LogTable:
    units = layout.units or ("",) * len(layout.names)
    headings = {name: heading(name, unit) for name, unit in zip(layout.names, units, strict=True)}
    rows = max(1, round(os.stat(path).st_size / layout.row_bytes))
    table = LogTable(path, layout.told, rows, headings, lambda wanted: _text_columns(path, layout, wanted, table.notes))
    return table


def _text_columns(path: Path, layout: TextLayout, wanted: Sequence[str], notes: list[str]) -> dict[str, LogColumn]:
    """Reads columns of a text table, a piece of the file at a time."""
    ragged: list[pa.csv.InvalidRow] = []

    def skip(row: pa.csv.InvalidRow) -> str:
        ragged.append(row)
        return "skip" if len(ragged) < 1000 else "error"

    blanks = layout.delimiter == " "
    encoding = {"utf-8": "utf8"}.get("utf-8" if blanks else layout.encoding, layout.encoding)
    reader = pa.csv.open_csv(
        OneBlank(path, layout.encoding) if blanks else path,
        pa.csv.ReadOptions(
            use_threads=False, skip_rows=layout.above, column_names=list(layout.names), encoding=encoding
        ),
        pa.csv.ParseOptions(delimiter=layout.delimiter, invalid_row_handler=skip),
        pa.csv.ConvertOptions(column_types=dict.fromkeys(wanted, pa.string()), include_columns=list(wanted)),
    )
    kinds: dict[str, str] = {}
    chunks: dict[str, list[Any]] = {name: [] for name in wanted}
    bad = dict.fromkeys(wanted, "")
    row = 0
    for batch in reader:
        for name in wanted:
            text = batch.column(name)
            if name not in kinds:
                found = _kind(text, layout.comma)
                if found is None:  # nothing in it yet
                    chunks[name].append(pa.nulls(len(text)))
                    continue
                kinds[name] = found
            if kinds[name] == "text":
                chunks[name].append(text)
                continue
            values, wrong = parsed(text, kinds[name], layout.comma)
            chunks[name].append(values)
            bad[name] = bad[name] or told_bad(text, wrong, row)
        row += len(batch)
    if ragged:
        one = ragged[0]
        told = (
            f"{len(ragged)} line{'' if len(ragged) == 1 else 's'} with another number of cells, first line {one.number}"
        )
        if len(ragged) > max(1.0, _RAGGED * row):
            raise BagError(
                f"{path}: not a table: {told} with {one.actual_columns}; expected {one.expected_columns} cells in each line"
            )
        if (note := f"left out {told}") not in notes:
            notes.append(note)
    return {name: _joined(chunks[name], kinds.get(name, "empty"), bad[name]) for name in wanted}


def _kind(text: Any, comma: bool) -> str | None:
    """What the first cells with a value are; ``None`` if there is none."""
    there = pa.compute.filter(
        text, pa.compute.greater(pa.compute.utf8_length(pa.compute.utf8_trim_whitespace(text)), 0)
    )
    return kind_of([str(cell) for cell in there[:50]], comma) if len(there) else None


def _joined(chunks: list[Any], kind: str, bad: str) -> LogColumn:
    if kind == "text":
        first = next(str(cell) for chunk in chunks if chunk.type == pa.string() for cell in chunk if str(cell).strip())
        count = sum(map(len, chunks))
        return LogColumn(kind, np.full(count, np.nan), np.ones(count, bool), reason=f"text, '{first[:20]}' first")
    types = {chunk.type for chunk in chunks if chunk.type != pa.null()}
    common = pa.null() if not types else types.pop() if len(types) == 1 else pa.float64()
    return typed_column(pa.chunked_array([chunk.cast(common) for chunk in chunks], common), kind, bad)


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
