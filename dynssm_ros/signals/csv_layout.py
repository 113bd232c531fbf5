"""How a text file is laid out as a table: encoding, delimiter, decimal comma, headings, units, and where its rows begin."""

from __future__ import annotations

import codecs
import csv
import io
from collections import Counter
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

from dynssm_ros.errors import BagError
from dynssm_ros.signals.columns import ABSENT, is_value, known_unit

_SAMPLE = 1 << 18  # bytes that are looked at
_JUDGED = 60  # lines by which delimiters are judged
_DELIMITERS = {",": "comma", ";": "semicolon", "\t": "tab", "|": "bar", " ": "blanks"}
_NONE = "neither a table nor a bag; expected columns of numbers apart by comma, semicolon, tab or blanks, or a bag"
_OTHERS = {
    b"\xd0\xcf\x11\xe0": "an Excel workbook", b"\x89HDF\r\n": "an HDF5 file", b"MDF     ": "an MDF file",
    b"UnFinMF ": "an MDF file", b"ULog\x01\x12\x35": "a ULog file", b"LOGG": "a BLF file", b"ARROW1": "a Feather file",
    b"\x1f\x8b": "a gzip file", b"BZh": "a bzip2 file", b"\xfd7zXZ": "an xz file",
}  # fmt: skip
"""Files of other kinds that hold logs, by their first bytes."""
_LIKE_OTHERS = 0.75  # of the share of values that other rows have
_LEAST = 0.5  # share of cells that are values


@dataclass(frozen=True)
class TextLayout:
    """The layout of a text table."""

    encoding: str
    delimiter: str
    comma: bool  # decimal comma
    names: tuple[str, ...]
    units: tuple[str, ...]  # of a row of units; empty where there is none
    above: int  # lines above the first row
    row_bytes: float  # mean length of a row

    @property
    def told(self) -> str:
        """What a user may want to know of it, in words."""
        decimal = ", decimal comma" if self.comma else ""
        coded = "" if self.encoding == "utf-8" else f", {self.encoding}"
        lines = (
            f"{self.above} line{'' if self.above == 1 else 's'} above the first row" if self.above else "no headings"
        )
        return f"text, columns apart by {_DELIMITERS[self.delimiter]}{decimal}{coded}, {lines}"


def layout_of(path: Path) -> TextLayout:
    """Finds the layout by the first 256 KB of a file.

    Raises:
        BagError: empty, binary, or not a table.
    """
    with path.open("rb") as file:
        head = file.read(_SAMPLE)
    if not head.strip():
        raise BagError(f"{path}: the file is empty; expected a bag or a table")
    lines, encoding = _lines(path, head)
    delimiter, comma, count, share = _delimiter(path, lines)
    rows = [_cells(line, delimiter) for line in lines]
    data = [len(row) == count and _is_row(row, comma, _LIKE_OTHERS * share) for row in rows]
    filled = [k for k, row in enumerate(rows) if any(row)]
    first = next((k for k in filled if data[k]), None)
    if first is None:
        raise BagError(f"{path}: {_NONE}")
    names, units = _headings(path, [rows[k] for k in filled if k < first], count)
    names = [name or f"column_{k + 1}" for k, name in enumerate(names)]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        places = " and ".join(str(k + 1) for k, name in enumerate(names) if name == twice)
        raise BagError(f"{path}: columns {places} are all named '{twice}'; expected different names")
    written = [len(lines[k].encode(encoding, errors="replace")) + 1 for k in filled if k >= first]
    return TextLayout(encoding, delimiter, comma, tuple(names), tuple(units), first, sum(written) / len(written))


class OneBlank(io.RawIOBase):
    """A text file whose columns are apart by any number of blanks, read as UTF-8 with one blank between them."""

    def __init__(self, path: Path, encoding: str) -> None:
        self._file = path.open(encoding="utf-8-sig" if encoding == "utf-8" else encoding, errors="replace")
        self._left = b""

    def readable(self) -> bool:
        """True."""
        return True

    def readinto(self, buffer: Any) -> int:
        """Fills ``buffer`` as far as there is text left; the number of bytes."""
        while not self._left and (lines := self._file.readlines(_SAMPLE)):
            self._left = "".join(f"{' '.join(line.split())}\n" for line in lines).encode()
        count = min(len(buffer), len(self._left))
        buffer[:count], self._left = self._left[:count], self._left[count:]
        return count

    def close(self) -> None:
        """Closes the file."""
        self._file.close()
        super().close()


def _lines(path: Path, head: bytes) -> tuple[list[str], str]:
    """The whole lines of a file's beginning, and its encoding."""
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        encoding, text = "utf-16", head[: len(head) // 2 * 2].decode("utf-16", "replace")
    elif (other := next((name for magic, name in _OTHERS.items() if head.startswith(magic)), None)) is not None:
        raise BagError(f"{path}: {other}, which is not read; expected it unpacked, or exported as CSV")
    elif b"\0" in head:
        raise BagError(
            f"{path}: not a bag and not a table (binary); expected rosbag2, ROS 1, CSV, Parquet, .mat or .npz"
        )
    else:
        encoding = "utf-8"
        try:
            codecs.getincrementaldecoder("utf-8")().decode(head)
        except UnicodeDecodeError:
            encoding = "cp1252"
        text = head.decode(encoding, "replace").removeprefix("\ufeff")
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    return lines[:-1] if len(head) == _SAMPLE or not lines[-1] else lines, encoding


def _cells(line: str, delimiter: str) -> list[str]:
    if delimiter == " ":
        return line.lstrip("#% ").split() if "\t" not in line else []
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter), [])]
    except csv.Error:
        return []


def _is_row(cells: list[str], comma: bool, share: float) -> bool:
    there = [cell for cell in cells if cell not in ABSENT]
    return bool(there) and sum(is_value(cell, comma) for cell in there) >= max(share, _LEAST) * len(there)


def _delimiter(path: Path, lines: list[str]) -> tuple[str, bool, int, float]:
    """Delimiter, decimal comma, and number of columns that make most of the last lines rows of values, and the share of
    values among their cells.
    """
    last = [line for line in lines if line.strip()][-_JUDGED:]
    best = (0.0, 0, False, "", 0.0)
    for delimiter, comma in product(_DELIMITERS, (False, True)):
        rows = [_cells(line, delimiter) for line in last]
        ((count, times),) = Counter(map(len, rows)).most_common(1) or [(0, 0)]
        if count < 2:
            continue
        cells = [cell for row in rows if len(row) == count for cell in row if cell not in ABSENT]
        values = sum(is_value(cell, comma) for cell in cells) / max(len(cells), 1)
        best = max(best, (round(values * times / len(rows), 3), count, not comma, delimiter, values))
    score, count, point, delimiter, share = best
    if score < _LEAST / 2:
        raise BagError(f"{path}: {_NONE}")
    return delimiter, not point, count, share


def _headings(path: Path, above: list[list[str]], count: int) -> tuple[list[str], list[str]]:
    """The names of the columns, and their units if a row has them; ``above`` are the lines above the first row."""
    fitting = [row + [""] * (count - len(row)) for row in above if count - 1 <= len(row) <= count]
    if not fitting:
        return [f"column_{k + 1}" for k in range(count)], []
    names, units = fitting[-1], []
    if len(fitting) > 1 and _are_units(names):
        names, units = fitting[-2], names
    names[0] = names[0].lstrip("#% ") or names[0]
    return names, units


def _are_units(cells: list[str]) -> bool:
    there = [cell for cell in cells if cell not in ABSENT]
    unit = [known_unit(cell) is not None or (cell[0] in "[(" and cell[-1] in "])") for cell in there]
    return bool(there) and sum(unit) >= _LEAST * len(there)
