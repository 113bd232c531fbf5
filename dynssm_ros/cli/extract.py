"""``dynssm extract``: race logs to a recording."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dynssm_ros import api
from dynssm_ros.api.extract import ExtractSettings
from dynssm_ros.api.season import ExtractSeasonSettings
from dynssm_ros.cli.console import progress_bar, say
from dynssm_ros.cli.options import SignalsOption, with_settings
from dynssm_ros.errors import ConfigurationError
from dynssm_ros.signals.standard import recording_to_bag


@with_settings(ExtractSeasonSettings)
def extract(
    bags: Annotated[
        list[Path],
        typer.Argument(
            help="Bags of ROS 2 or ROS 1, or tables (CSV, Parquet, .mat, .npz), in the order of driving.",
            metavar="LOG...",
        ),
    ],
    signals: SignalsOption,
    out: Annotated[
        Path, typer.Option(help="Recording to write (R.parquet); or folder of a season, one recording for each bag.")
    ],
    settings: ExtractSeasonSettings,
    bag: Annotated[
        Path | None,
        typer.Option(
            help="Also write the grid as a rosbag2 with the standard topics, to play it without its own types."
        ),
    ] = None,
) -> None:
    """Turn race logs into a recording: named SI signals on a uniform time grid. Or into a season of recordings."""
    if out.suffix != ".parquet":
        if settings.car is None or settings.track is None or bag is not None:
            raise ConfigurationError(
                f"--out {out}: a season's folder needs --car and --track and takes no --bag; expected those, or R.parquet"
            )
        _extract_season(bags, out, signals, settings)
        return
    one = ExtractSettings(**{name: getattr(settings, name) for name in ExtractSettings.model_fields})
    if settings != ExtractSeasonSettings(**dict(one)):
        raise ConfigurationError(
            f"--out {out}: --car, --track, --jobs, --backend and --address are of a season; expected a folder"
        )
    with progress_bar("reading") as progress:
        recording = api.extract(bags, signals, settings=one, on_progress=progress)
    if bag is not None:
        recording_to_bag(recording, bag)
    recording.save(out)
    for note in recording.info.notes:
        say(f"note: {note}")
    segments = int(recording.segment[-1]) + 1
    say(
        f"{out}: {len(recording)} rows at {one.rate:g} Hz, {recording.duration:.1f} s in {segments} "
        f"segment{'s' if segments > 1 else ''}, commands: {recording.info.commands}"
    )


def _extract_season(bags: list[Path], out: Path, signals: str, settings: ExtractSeasonSettings) -> None:
    with progress_bar("extracting") as progress:
        season, new = api.extract_season(bags, out, signals, settings=settings, on_progress=progress)
    failed = [session for session in season.of_bags(bags) if session.failure]
    for session in failed:
        say(f"{session.bag}: not extracted: {session.failure}")
    read = [session for session in new if not session.failure]
    say(
        f"{season.path}: {len(season.sessions)} sessions; of {len(bags)} bags {len(read)} extracted, "
        f"{len(bags) - len(new)} as they were, {len(failed)} not readable"
    )
    if len(failed) == len(bags):
        raise typer.Exit(1)
