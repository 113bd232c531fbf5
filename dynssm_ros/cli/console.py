"""What all subcommands share: the consoles, the progress bar and the file of results."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from dynssm_ros.files import write_json

if TYPE_CHECKING:
    from dynssm_ros.reporting.page import Report
    from dynssm_ros.reporting.tables import Table

console = Console(highlight=False)
errors = Console(stderr=True, highlight=False)
_LINE_EVERY_S, _SHOWN_EVERY_S = 10.0, 0.1


def say(words: str) -> None:
    """Prints words as they are; the terminal breaks the line."""
    console.print(words, markup=False, soft_wrap=True)


def warn(words: str) -> None:
    """Prints a warning as a line on stderr."""
    errors.print(f"[yellow]warning:[/yellow] {escape(words)}", soft_wrap=True, highlight=False)


def write_results(content: dict[str, Any], out: Path, also: Path | None) -> None:
    """Writes the result for programs: ``results.json`` in the folder ``out``, and the file of ``--json`` if given."""
    for path in (out / "results.json", also):
        if path is not None:
            write_json(path, content)


def publish(report: Report, content: dict[str, Any], out: Path, also: Path | None, *shown: Table | str) -> None:
    """Writes the page and the result for programs to the folder ``out``; prints tables in brief, words, and where it is."""
    report.save(out / "report.html")
    write_results(content, out, also)
    for each in shown:
        say(each) if isinstance(each, str) else console.print(each.brief.rich())
    say(f"{out / 'report.html'}: figures and how to read them")


class Update(Protocol):
    """Moves a progress bar."""

    def __call__(self, done: int, total: int, words: str = "") -> None:
        """Shows how much is done, of how much, and a few words about it."""


@contextmanager
def progress_bar(description: str) -> Iterator[Update]:
    """Shows a progress bar on stderr, or a line now and then if that is no terminal; yields the function that moves it."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:3.0f} %"),
        TextColumn("{task.fields[words]}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    drawn, shown = errors.is_terminal, time.monotonic()
    where = errors if drawn else Console(quiet=True)  # at its end it would print a blank line there
    with Progress(*columns, console=where, transient=True, disable=not drawn) as progress:
        task = progress.add_task(description, total=None, words="")

        def update(done: int, total: int, words: str = "") -> None:
            nonlocal shown
            now = time.monotonic()
            if now - shown < (_SHOWN_EVERY_S if drawn else _LINE_EVERY_S) and not (drawn and done >= total):
                return  # drawing costs more than reading a message does
            shown = now
            progress.update(task, completed=done, total=total, words=words)
            if not drawn:
                share = 100 * done / max(total, 1)
                errors.print(f"{description}: {share:.0f} % {words}".rstrip(), markup=False, soft_wrap=True)

        yield update
