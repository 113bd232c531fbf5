"""Recordings: named SI columns on a uniform grid, in segments without gaps; on disk as Parquet with metadata."""

from __future__ import annotations

import base64
import hashlib
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import Field, ValidationError

from dynssm_ros.arrays import Indices, Vector
from dynssm_ros.configuration import StrictModel, describe
from dynssm_ros.errors import RecordingError
from dynssm_ros.files import replacing, require_replaceable
from dynssm_ros.signals.findings import Finding, merged
from dynssm_ros.signals.inputs import WINDOW_COLUMNS, lookahead_commands
from dynssm_ros.signals.recover import vast_table
from dynssm_ros.signals.signal_map import POSE_SIGNALS, STATE_SIGNALS, Commands
from dynssm_ros.vehicle.single_track import SetPoint

METADATA_KEY = b"dynssm"
V_Y_DEVIATION = "v_y_std"
_ARROW_SCHEMA = b"ARROW:schema"
"""Under which pyarrow keeps names and metadata a second time."""
_UNREADABLE = (pa.ArrowException, OSError, ValueError, KeyError)  # names that are no text, or those of several columns
_ROWS_AT_ONCE = 65536  # that are written
_FINGERPRINT_NS, _FINGERPRINT_ROWS = 10_000_000_000, 5
_MOST_ROWS = 50_000_000  # five days at 100 Hz
_OFF_GRID = 0.01  # of T_s that rows may be off their grid
COLUMN_UNITS = {
    "v_x": "m/s", "v_y": "m/s", "omega": "rad/s", "r_fb": "1", "delta_fb": "rad", "r_cmd": "1", "delta_cmd": "rad",
    "x": "m", "y": "m", "theta": "rad", "v_y_std": "m/s",
    "gear": "1", "engine_speed": "rad/s",
}  # fmt: skip


_INPUTS: dict[SetPoint, str] = {"throttle": "a throttle", "speed": "a speed set-point"}
PAUSE_S = 1.0
"""Between drives, at most, where their time is told (s)."""
_IN_SPEED = {"r_fb": "m/s", "r_cmd": "m/s"}


def without_pauses(time: Vector) -> Vector:
    """Ascending times (s) with longer pauses than :data:`PAUSE_S` cut to that, ``(N,)``."""
    return np.asarray(time[:1] + np.cumsum(np.minimum(np.diff(time, prepend=time[:1]), PAUSE_S)))


def require_set_point(what: str, given: SetPoint, taken: SetPoint, of: str) -> None:
    """Checks that the first input that ``what`` gives is the one that is taken by ``of``, something that shall use it.

    Raises:
        RecordingError: it is not.
    """
    if given != taken:
        raise RecordingError(
            f"{what}: its first input is {_INPUTS[given]}, but {of} takes {_INPUTS[taken]} (inputs.set_point: {taken}); "
            f"`dynssm vehicle new --set-point {given}` writes a file that fits"
        )


class RecordingInfo(StrictModel):
    """What a recording says of itself."""

    version: int = Field(default=1, ge=1, le=1, description="format version")
    sampling_time: float = Field(gt=0, description="T_s (s)")
    commands: Commands = Field(description="where u_t comes from")
    set_point: SetPoint = Field(default="throttle", description="what r_fb and r_cmd are: fractions, or speeds in m/s")
    source: tuple[str, ...] = Field(default=(), description="names of the bags or simulations")
    signal_map: str = ""
    held: tuple[str, ...] = Field(
        default=(), description="signals that keep their last sample until the next; the others are interpolated"
    )
    held_periods: dict[str, float] = Field(
        default_factory=dict, description="usual time from one sample of a held signal to the next (s)"
    )
    stamped: dict[str, str] = Field(
        default_factory=dict, description="by what each signal of a bag is stamped: header, stamp, log time"
    )
    interpolated: dict[str, float] = Field(
        default_factory=dict, description="share of the rows that lie between slower samples, by signal"
    )
    standard_deviations: dict[str, float] = Field(
        default_factory=dict, description="of estimated velocities, root mean square over the rows (m/s, rad/s)"
    )
    notes: tuple[str, ...] = Field(default=(), description="what was recovered, dropped or bridged")
    findings: tuple[Finding, ...] = Field(default=(), description="what of the signals cannot be right")


@dataclass(frozen=True)
class Recording:
    """Signals of a run on a uniform time grid.

    Attributes:
        info: sampling time, source and history.
        time: header-stamp time of each row (int64 ns), shape ``(N,)``; uniform inside a segment.
        segment: number of the gap-free stretch a row belongs to, non-decreasing, shape ``(N,)``.
        columns: ``WINDOW_COLUMNS`` and, where known, the pose ``x y theta`` (m, m, rad unwrapped), the
            standard deviation ``v_y_std`` of an estimated ``v_y`` (m/s), ``gear`` and ``engine_speed`` (rad/s), each
            ``(N,)``.
    """

    info: RecordingInfo
    time: npt.NDArray[np.int64]
    segment: npt.NDArray[np.int32]
    columns: dict[str, Vector] = field(repr=False)

    def __len__(self) -> int:
        return len(self.time)

    def __getitem__(self, column: str) -> Vector:
        return self.columns[column]

    @property
    def T_s(self) -> float:
        """Sampling time (s)."""
        return self.info.sampling_time

    @cached_property
    def elapsed(self) -> Vector:
        """Time of each row since the start (s), pauses cut to a second: drives of other days follow each other; ``(N,)``."""
        return without_pauses((self.time - self.time[:1]) / 1e9)

    @property
    def has_pose(self) -> bool:
        """Whether ``x y theta`` were recorded."""
        return all(name in self.columns for name in POSE_SIGNALS)

    @property
    def duration(self) -> float:
        """Recorded time without the gaps (s)."""
        return len(self) * self.T_s

    @property
    def matrix(self) -> Vector:
        """The model's input rows, shape ``(N, 7)`` in the order of ``WINDOW_COLUMNS``; a copy of them all."""
        return self.rows(slice(None))

    def rows(self, at: slice | Indices) -> Vector:
        """Some of the model's input rows, by numbers of any shape ``(...)``: ``(..., 7)``."""
        return np.stack([self.columns[name][at] for name in WINDOW_COLUMNS], axis=-1)

    def states(self, at: slice | Indices) -> Vector:
        """``v_x, v_y, omega`` of some rows, by numbers of any shape ``(...)``: ``(..., 3)``."""
        return np.stack([self.columns[name][at] for name in STATE_SIGNALS], axis=-1)

    @property
    def fingerprints(self) -> tuple[str, ...]:
        """Of the first rows in every ten seconds, by which the same laps are known again, whole or in part; sorted."""
        first = np.flatnonzero(np.diff(self.time // _FINGERPRINT_NS, prepend=-1))
        return tuple(sorted(set(map(self._fingerprint, first.tolist()))))

    @property
    def beginning(self) -> str:
        """Fingerprint of the first rows; the recording is known by it if its end is cut off."""
        return self._fingerprint(0)

    def _fingerprint(self, row: int) -> str:
        return hashlib.sha256(self.states(slice(row, row + _FINGERPRINT_ROWS)).tobytes()).hexdigest()[:8]

    def window_ends(self, H: int, horizon: int = 1, min_speed: float = -np.inf, least: float = -np.inf) -> Indices:
        """Rows ``t`` such that rows ``t-H+1 .. t+horizon`` lie in one segment, nowhere slower than ``min_speed`` (m/s),
        forwards or backwards, and nowhere with a ``v_x`` below ``least`` (m/s).

        Windows are formed from these by indexing; no ``(N, H, 7)`` array is ever stored.
        """
        rows = np.arange(H - 1, len(self) - horizon)
        if len(rows) == 0:
            return rows
        v_x = self.columns["v_x"]
        slow = np.concatenate([[0], np.cumsum((np.abs(v_x) < min_speed) | (v_x < least))])
        first, last = rows - H + 1, rows + horizon
        usable = (self.segment[first] == self.segment[last]) & (slow[last + 1] == slow[first])
        return np.asarray(rows[usable])

    def windows(self, ends: Indices, H: int, horizon: int = 0) -> Vector:
        """The model's input rows ``t-H+1 .. t+horizon`` around each ``t`` of ``ends``, ``(n, H + horizon, 7)``."""
        return self.rows(ends[:, None] + np.arange(1 - H, horizon + 1))

    def select(self, rows: slice | npt.NDArray[np.bool_] | Indices) -> Recording:
        """The given rows, as a view where they are a slice; a segment that the selection cuts apart becomes several."""
        index = np.arange(len(self))[rows]
        cut = np.flatnonzero((np.diff(index) != 1) | (np.diff(self.segment[index]) != 0)) + 1
        segment = np.zeros(len(index), dtype=np.int32)
        segment[cut] = 1
        return replace(
            self,
            time=self.time[rows],
            segment=np.cumsum(segment, dtype=np.int32),
            columns={name: values[rows] for name, values in self.columns.items()},
        )

    def stretches(self, count: int) -> list[slice]:
        """Rows of ``count`` stretches of equal length, one after the other."""
        edges = [-(-k * len(self) // count) for k in range(count + 1)]
        return [slice(*edge) for edge in pairwise(edges)]

    def split_last(self, fraction: float) -> tuple[Recording, Recording]:
        """Splits off the last ``fraction`` of the rows as one block (blocked split): ``(first, last)``."""
        cut = len(self) - round(len(self) * fraction)
        return self.select(slice(None, cut)), self.select(slice(cut, None))

    def with_commands(self, commands: Commands | None) -> Recording:
        """The same recording under another command protocol; ``None`` keeps it.

        Raises:
            RecordingError: ``topics`` asked of a recording without them.
        """
        if commands is None or commands == self.info.commands:
            return self
        if commands == "topics":
            raise RecordingError(
                f"recording {', '.join(self.info.source)}: commands 'topics' asked for, but it was extracted with "
                f"'{self.info.commands}'; extract the bag again with --commands topics"
            )
        columns = dict(self.columns)
        for feedback, command in (("r_fb", "r_cmd"), ("delta_fb", "delta_cmd")):
            ahead = lookahead_commands(columns[feedback], self.segment)
            columns[command] = ahead if commands == "lookahead" else np.zeros_like(ahead)
        return replace(self, info=self.info.model_copy(update={"commands": commands}), columns=columns)

    def require_sampling_time(self, T_s: float, of: str) -> None:
        """Checks that this recording has the sampling time ``T_s`` (s) ``of`` something that shall use it.

        Raises:
            RecordingError: it has another.
        """
        if abs(self.T_s - T_s) > 1e-9:
            raise RecordingError(
                f"recording {', '.join(self.info.source)}: sampling time {self.T_s:g} s, but {of} has {T_s:g} s; "
                f"extract with --rate {1 / T_s:g}"
            )

    def require_set_point(self, set_point: SetPoint, of: str) -> None:
        """Checks that this recording's first input is what ``of`` something that shall use it takes.

        Raises:
            RecordingError: it is not.
        """
        require_set_point(f"recording {', '.join(self.info.source)}", self.info.set_point, set_point, of)

    def save(self, path: str | Path) -> None:
        """Writes Parquet with the metadata and checksums of its pages inside, atomically."""
        arrays = {"time": pa.array(self.time), "segment": pa.array(self.segment)}
        arrays |= {name: pa.array(values) for name, values in self.columns.items()}
        units = COLUMN_UNITS | (_IN_SPEED if self.info.set_point == "speed" else {})
        fields = [
            pa.field(name, array.type, metadata={b"unit": units.get(name, "ns" if name == "time" else "").encode()})
            for name, array in arrays.items()
        ]
        schema = pa.schema(fields, metadata={METADATA_KEY: self.info.model_dump_json().encode()})
        require_replaceable(path, _is_recording(path), "a recording")
        with replacing(path) as aside:
            table = pa.table(list(arrays.values()), schema=schema)
            # measured numbers hardly repeat: a dictionary of them costs memory and is larger
            pq.write_table(
                table, aside, row_group_size=_ROWS_AT_ONCE, compression="zstd", use_dictionary=["segment"],
                write_page_checksum=True,
            )  # fmt: skip

    @classmethod
    def load(cls, path: str | Path) -> Recording:
        """Reads a recording.

        Raises:
            RecordingError: missing, not Parquet, not a recording, or damaged.
        """
        with _opened(path) as file:
            return cls._read(Path(path), file)

    @classmethod
    def _read(cls, path: Path, file: pq.ParquetFile) -> Recording:
        raw = (file.schema_arrow.metadata or {}).get(METADATA_KEY)
        if raw is None:
            raise RecordingError(f"{path}: Parquet, but not a dynssm recording (no '{METADATA_KEY.decode()}' metadata)")
        try:
            info = RecordingInfo.model_validate_json(raw)
        except ValidationError as error:
            raise RecordingError(f"{path}: metadata not understood: {describe(error)}") from error
        missing = [name for name in ("time", "segment", *WINDOW_COLUMNS) if name not in file.schema_arrow.names]
        if missing:
            raise RecordingError(f"{path}: column {missing[0]} is missing")
        _require_undamaged(path, file)
        if file.metadata.num_rows == 0:
            raise RecordingError(f"{path}: the recording is empty")
        if file.metadata.num_rows > _MOST_ROWS:
            raise RecordingError(f"{path}: {file.metadata.num_rows} rows; expected at most {_MOST_ROWS}")
        if vast := vast_table(path, file.metadata):
            raise RecordingError(f"{path}: {vast}")
        time, segment = (_column(file, name, kind, path) for name, kind in (("time", "int64"), ("segment", "int32")))
        known = [name for name in COLUMN_UNITS if name in file.schema_arrow.names]
        columns = {name: _column(file, name, "double", path) for name in known}
        for name, values in columns.items():
            bad = np.flatnonzero(~np.isfinite(values))
            if len(bad):
                raise RecordingError(f"{path}: column {name}, row {bad[0]}: {values[bad[0]]}; expected a finite number")
        _require_grid(path, time, segment, info.sampling_time)
        return cls(info, time, segment, columns)


def _require_undamaged(path: Path, file: pq.ParquetFile) -> None:
    """Checks what a file says twice; its pages have checksums, but its footer has none.

    Raises:
        RecordingError: it contradicts itself.
    """
    footer, metadata = file.metadata, file.metadata.metadata
    if sum(footer.row_group(k).num_rows for k in range(footer.num_row_groups)) != footer.num_rows:
        raise RecordingError(f"{path}: its footer contradicts itself about the number of rows; damaged")
    if _ARROW_SCHEMA in metadata:  # by other writers than pyarrow it may be missing
        second = pa.ipc.read_schema(pa.py_buffer(base64.b64decode(metadata[_ARROW_SCHEMA])))
        for what, first, again in (
            ("names of columns", file.schema.names, second.names),
            ("metadata", metadata.get(METADATA_KEY), (second.metadata or {}).get(METADATA_KEY)),
        ):
            if again != first:
                raise RecordingError(f"{path}: its footer contradicts itself about the {what}; damaged")


def _require_grid(path: Path, time: npt.NDArray[Any], segment: npt.NDArray[Any], T_s: float) -> None:
    """Checks that within each segment the rows are ``T_s`` (s) apart, and that segments are numbered upwards.

    Raises:
        RecordingError: they are not; names the first row.
    """
    backwards = np.flatnonzero(np.diff(segment) < 0)
    if len(backwards):
        row = backwards[0] + 1
        raise RecordingError(
            f"{path}: column segment, row {row}: {segment[row]} after {segment[row - 1]}; expected no less"
        )
    steps = np.diff(time) / 1e9
    off = np.flatnonzero((np.diff(segment) == 0) & (np.abs(steps - T_s) > _OFF_GRID * T_s))
    if len(off):
        row = off[0] + 1
        raise RecordingError(
            f"{path}: column time, row {row}: {steps[row - 1]:.6g} s after the row before; expected the sampling time "
            f"{T_s:g} s within a segment"
        )


def _is_recording(path: str | Path) -> bool:
    """Whether a file is Parquet with our metadata."""
    try:
        return METADATA_KEY in (pq.read_schema(path).metadata or {})
    except _UNREADABLE:
        return False


@contextmanager
def _opened(path: str | Path) -> Iterator[pq.ParquetFile]:
    """A recording's file; errors, also of reading it, say which file it is."""
    if not os.path.isfile(path):
        raise RecordingError(f"{path}: no such recording; `dynssm extract` makes one from a bag")
    try:
        with pq.ParquetFile(path, page_checksum_verification=True) as file:
            yield file
    except _UNREADABLE as error:
        raise RecordingError(f"{path}: not a readable Parquet file ({' '.join(str(error).split())})") from error


def _column(file: pq.ParquetFile, name: str, kind: str, path: Path) -> npt.NDArray[Any]:
    """A column, read alone: a long recording is not held twice."""
    column = file.read(columns=[name], use_threads=False)[name]
    if len(column) != file.metadata.num_rows:
        raise RecordingError(f"{path}: column {name}: {len(column)} rows; expected {file.metadata.num_rows}")
    if str(column.type) != kind or column.null_count:
        have = f"{column.null_count} empty rows" if column.null_count else str(column.type)
        raise RecordingError(f"{path}: column {name}: {have}; expected {kind} in every row")
    return np.asarray(column.to_numpy())


def row_count(path: str | Path) -> int:
    """Rows of a recording's file, whose columns are not read.

    Raises:
        RecordingError: missing, not Parquet, or damaged.
    """
    with _opened(path) as file:
        return int(file.metadata.num_rows)


def concatenate(recordings: Sequence[Recording]) -> Recording:
    """Joins recordings of one car, one after the other; segments stay apart.

    Raises:
        RecordingError: sampling times or command protocols differ, or nothing to join.
    """
    if not recordings:
        raise RecordingError("no recording given")
    first = recordings[0]
    if len(recordings) == 1:
        return first
    for other in recordings[1:]:
        for name in ("sampling_time", "commands", "set_point"):
            have, want = getattr(other.info, name), getattr(first.info, name)
            if have != want:
                raise RecordingError(
                    f"recording {', '.join(other.info.source)}: {name} {have}, but {', '.join(first.info.source)} "
                    f"has {want}; expected the same"
                )
    names = [name for name in first.columns if all(name in other.columns for other in recordings)]
    offsets = np.cumsum([0] + [int(r.segment[-1]) + 1 if len(r) else 0 for r in recordings[:-1]])
    infos = [r.info for r in recordings]
    info = first.info.model_copy(
        update={
            "source": tuple(s for r in recordings for s in r.info.source),
            "notes": tuple(n for r in recordings for n in r.info.notes),
            "findings": merged([info.findings for info in infos]),
            "held": tuple(dict.fromkeys(name for r in recordings for name in r.info.held)),
            "held_periods": _largest([info.held_periods for info in infos]),
            "interpolated": _largest([info.interpolated for info in infos]),
            "standard_deviations": _largest([info.standard_deviations for info in infos]),
            "stamped": {name: by for info in infos for name, by in info.stamped.items()},
        }
    )
    return Recording(
        info,
        np.concatenate([r.time for r in recordings]),
        np.concatenate([r.segment + offset for r, offset in zip(recordings, offsets, strict=True)]).astype(np.int32),
        {name: np.concatenate([r.columns[name] for r in recordings]) for name in names},
    )


def _largest(values: Sequence[dict[str, float]]) -> dict[str, float]:
    """The largest of several values by name, 0 where one has none."""
    return {name: max(each.get(name, 0.0) for each in values) for name in sorted(set().union(*values))}
