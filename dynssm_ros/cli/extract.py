"""``dynssm extract``: race logs to a recording."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dynssm_ros import api
from dynssm_ros.cli.console import CommandsOption, SignalsOption, console, progress_bar
from dynssm_ros.signals.standard import recording_to_bag


def extract(
    bags: Annotated[
        list[Path],
        typer.Argument(help="rosbag2 folders or .mcap/.db3 files, in the order of driving.", metavar="BAG..."),
    ],
    signals: SignalsOption,
    rate: Annotated[float, typer.Option(help="Rate of the uniform time grid (Hz).", min=1.0, max=1000.0)],
    out: Annotated[Path, typer.Option(help="Recording to write (Parquet).", dir_okay=False)],
    bag: Annotated[
        Path | None,
        typer.Option(
            help="Also write the grid as a rosbag2 with the standard topics, to play it without its own types."
        ),
    ] = None,
    commands: CommandsOption = None,
    drop_bad: Annotated[
        bool,
        typer.Option("--drop-bad", help="Leave out samples that are not finite or out of order instead of stopping."),
    ] = False,
) -> None:
    """Turn race logs into a recording: named SI signals on a uniform time grid."""
    with progress_bar("reading") as progress:
        recording = api.extract(list(bags), signals, rate, commands, drop_bad, progress)
    if bag is not None:
        recording_to_bag(recording, bag)
    recording.save(out)
    for note in recording.info.notes:
        console.print(f"note: {note}", markup=False, soft_wrap=True)
    segments = int(recording.segment[-1]) + 1
    console.print(
        f"{out}: {len(recording)} rows at {rate:g} Hz, {recording.duration:.1f} s in {segments} "
        f"segment{'s' if segments > 1 else ''}, commands: {recording.info.commands}",
        markup=False,
        soft_wrap=True,
    )
