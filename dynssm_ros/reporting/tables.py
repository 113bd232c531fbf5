"""Tables that look the same on the terminal, in Markdown and in HTML: rows of values, and columns that know how."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any, Literal

import rich.box
import rich.table
from rich.markup import escape

from dynssm_ros.evaluation.spread import SeedSpread

Value = float | int | str | SeedSpread | None


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Attributes:
        title: as shown.
        unit: shown behind the title; empty if there is none.
        group: columns side by side of one group share a heading.
        best: which value is marked, if any.
        brief: shown on the terminal too, where there is little room.
    """

    title: str
    unit: str = ""
    group: str = ""
    best: Literal["min", "max"] | None = None
    brief: bool = False

    @property
    def heading(self) -> str:
        """Title and unit."""
        return f"{self.title} ({self.unit})" if self.unit else self.title

    @property
    def full_heading(self) -> str:
        """Group, title and unit, for formats without grouped columns."""
        return f"{self.group} {self.heading}".strip()


ColumnOf = tuple[Column | Sequence[Column], Callable[[Any], Any]]
"""A column, or several side by side, and what gives its value, or theirs, of a row's item."""


@dataclass(frozen=True)
class Cell:
    """A value as shown, its spread (stacked below it where there is little room), and whether it is marked."""

    value: str
    spread: str
    best: bool

    @property
    def text(self) -> str:
        """Value and spread in one line."""
        return f"{self.value} {self.spread}".strip()


@dataclass(frozen=True)
class Table:
    """Values in rows. ``None``, NaN and infinity show as a dash; numbers have three significant digits.

    The :class:`SeedSpread` of several seeds shows as mean ± standard deviation and is compared by its mean.
    """

    columns: tuple[Column, ...]
    rows: Sequence[Sequence[Value]]
    caption: str = ""

    @classmethod
    def of(cls, items: Iterable[Any], *columns: ColumnOf, caption: str = "") -> Table:
        """A row for each of ``items``."""
        rows: list[list[Value]] = []
        for item in items:
            parts = ([value(item)] if isinstance(column, Column) else value(item) for column, value in columns)
            rows.append([value for part in parts for value in part])
        heads = ([column] if isinstance(column, Column) else column for column, _ in columns)
        return cls(tuple(column for head in heads for column in head), rows, caption)

    @property
    def cells(self) -> list[list[Cell]]:
        """The rows as shown, marked what looks like the best value of its column."""
        best = [self._best(k) for k in range(len(self.columns))]
        return [
            [Cell(text(value), _spread(value), text(value) == best[k]) for k, value in enumerate(row)]
            for row in self.rows
        ]

    @property
    def groups(self) -> list[tuple[str, int]]:
        """Headings over columns side by side: ``(group, number of columns)``; empty if no column has a group."""
        spans = groupby(column.group or k for k, column in enumerate(self.columns))
        groups = [(group if isinstance(group, str) else "", len([*same])) for group, same in spans]
        return groups if any(group for group, _ in groups) else []

    @property
    def brief(self) -> Table:
        """The same table with its brief columns only."""
        kept = [k for k, column in enumerate(self.columns) if column.brief]
        rows = [[row[k] for k in kept] for row in self.rows]
        return Table(tuple(self.columns[k] for k in kept), rows, self.caption)

    def rich(self) -> rich.table.Table:
        """The table for the terminal."""
        shown = rich.table.Table(
            box=rich.box.SIMPLE_HEAD, caption=self.caption or None, caption_justify="left", header_style="bold"
        )
        group = ""
        for k, column in enumerate(self.columns):
            heading = "\n".join(["" if column.group == group else column.group, column.title, column.unit])
            group = column.group
            if self.numeric(k):
                shown.add_column(escape(heading), justify="right", no_wrap=True)
            else:
                longest = max((len(row[k].text) for row in self.cells), default=0)
                shown.add_column(escape(heading), overflow="fold", min_width=min(longest, 20))  # names in one piece
        for row in self.cells:
            texts = [escape(f"{cell.value}\n{cell.spread}".strip()) for cell in row]
            shown.add_row(*(f"[bold green]{t}[/]" if c.best else t for t, c in zip(texts, row, strict=True)))
        return shown

    def markdown(self) -> str:
        """The table as Markdown, best values in bold."""
        head = [column.full_heading for column in self.columns]
        rule = ["---:" if self.numeric(k) else "---" for k in range(len(head))]
        body = [[f"**{_plain(c.text)}**" if c.best else _plain(c.text) for c in row] for row in self.cells]
        lines = ["| " + " | ".join(row) + " |" for row in ([_plain(h) for h in head], rule, *body)]
        return "\n".join(lines) + (f"\n\n{self.caption}" if self.caption else "") + "\n"

    def numeric(self, k: int) -> bool:
        """Whether column ``k`` holds numbers, which are aligned at the right."""
        return any(not isinstance(row[k], str) for row in self.rows)

    def _best(self, k: int) -> str | None:
        """The best value of a column as shown; ``None`` where nothing is best."""
        goal = self.columns[k].best
        numbers = [_number(row[k]) for row in self.rows]
        known = [number for number in numbers if number is not None and math.isfinite(number)]
        if goal is None or len(known) < 2:
            return None
        return text(min(known) if goal == "min" else max(known))


def text(value: Value) -> str:
    """A value as shown: integers and large numbers in full, others with three significant digits; the mean of a spread."""
    if isinstance(value, SeedSpread):
        return text(value.mean)
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "–"
    if isinstance(value, str):
        return value
    if isinstance(value, int):
        return f"{value:,}"
    return f"{value:,.0f}" if abs(value) >= 999.5 else f"{value:#.3g}".rstrip(".")


def percent(share: float) -> str:
    """A share in whole percent."""
    return f"{100 * share:.0f} %"


def _spread(value: Value) -> str:
    """The standard deviation over several seeds, with as many decimals as the mean."""
    if not isinstance(value, SeedSpread) or value.n == 1 or not math.isfinite(value.std):
        return ""
    mean = text(value.mean)
    return f"± {value.std:.1e}" if "e" in mean else f"± {value.std:,.{len(mean.partition('.')[2])}f}"


def _number(value: Value) -> float | None:
    """What ``value`` is compared by; ``None`` for words and dashes."""
    if isinstance(value, SeedSpread):
        return value.mean
    return None if isinstance(value, str) else value


def _plain(cell: str) -> str:
    return cell.replace("|", "\\|")
