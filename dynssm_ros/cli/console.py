"""What all subcommands share: the consoles, the common options and the progress bar."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Protocol

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from dynssm_ros.files import write_json
from dynssm_ros.parallel import Backend
from dynssm_ros.signals.signal_map import Commands
from dynssm_ros.vehicle.effects import parse_effect

console = Console(highlight=False)
errors = Console(stderr=True, highlight=False)
_LINE_EVERY_S, _SHOWN_EVERY_S = 10.0, 0.1

VehicleOption = Annotated[
    str, typer.Option("--vehicle", help="Vehicle: name of a shipped one (orca, av21, ...) or a file.")
]
SignalsOption = Annotated[str, typer.Option("--signals", help="Signal map: name of a shipped one or a file.")]
CommandsOption = Annotated[
    Commands | None,
    typer.Option("--commands", help="Source of the command inputs; the signal map's or recording's own if not given."),
]
CourseOption = Annotated[
    str,
    typer.Option("--track", help="Track: oval, road_course, club, club_b, or a file x_m,y_m,w_tr_right_m,w_tr_left_m."),
]
MinSpeedOption = Annotated[
    float | None,
    typer.Option(
        "--min-speed",
        help="Leave out stretches below this speed (m/s).",
        show_default="the vehicle file's minimum_speed",
    ),
]
PlantOption = Annotated[
    str,
    typer.Option(
        "--plant",
        help="euler: one step per T_s, as in the published data; rk4: steps of 1 ms; double_track: four wheels.",
    ),
]
EffectOption = Annotated[
    list[str] | None,
    typer.Option("--effect", help="Physics that no model knows of; repeatable.", metavar="NAME[:k=v,...]"),
]
WhereOption = Annotated[
    str | None,
    typer.Option(
        "--where",
        help="Sessions of a season's folder: car, track, session, start, rate, rows, seconds, segments, as in "
        "\"track == 'putnam' and seconds > 60\".",
    ),
]
JobsOption = Annotated[
    int | None, typer.Option(help="Pieces of work at a time; all that a cluster has if not given, else one.", min=1)
]
BackendOption = Annotated[Backend, typer.Option(help="Where they are done: processes here, or a Ray or Dask cluster.")]
AddressOption = Annotated[
    str | None,
    typer.Option(
        help="Of the cluster: Ray's auto or ray://HOST:10001, Dask's tcp://HOST:8786.",
        show_default="one is started here, for as long as the work takes",
    ),
]
JsonOption = Annotated[Path | None, typer.Option("--json", help="Also write the result as JSON.", dir_okay=False)]


def write_results(content: dict[str, Any], out: Path, also: Path | None) -> None:
    """Writes the result for programs: ``results.json`` in the folder ``out``, and the file of ``--json`` if given."""
    for path in (out / "results.json", also):
        if path is not None:
            write_json(path, content)


def as_effects(texts: list[str] | None) -> dict[str, dict[str, float]]:
    """``NAME[:k=v,...]`` of ``--effect`` as names and parameters."""
    return dict(map(parse_effect, texts or []))


class Update(Protocol):
    """Moves a progress bar."""

    def __call__(self, done: int, total: int, words: str = "") -> None:
        """Shows how much is done, of how much, and a few words about it."""


def _progress_lines(description: str) -> Update:
    """Writes how much is done at most every :data:`_LINE_EVERY_S`; nothing for what is done sooner."""
    last = time.monotonic()

    def update(done: int, total: int, words: str = "") -> None:
        nonlocal last
        now = time.monotonic()
        if now - last >= _LINE_EVERY_S:
            last = now
            errors.print(
                f"{description}: {100 * done / max(total, 1):.0f} % {words}".rstrip(), markup=False, soft_wrap=True
            )

    return update


@contextmanager
def progress_bar(description: str) -> Iterator[Update]:
    """Shows a progress bar on stderr, or a line now and then if that is no terminal; yields the function that moves it."""
    if not errors.is_terminal:
        yield _progress_lines(description)
        return
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:3.0f} %"),
        TextColumn("{task.fields[words]}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=errors, transient=True) as progress:
        task = progress.add_task(description, total=None, words="")
        shown = -math.inf

        def update(done: int, total: int, words: str = "") -> None:
            nonlocal shown
            now = time.monotonic()
            if done >= total or now - shown >= _SHOWN_EVERY_S:  # drawing costs more than reading a message does
                shown = now
                progress.update(task, completed=done, total=total, words=words)

        yield update
