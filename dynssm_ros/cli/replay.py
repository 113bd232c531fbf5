"""``dynssm replay``: offline prediction into a new bag, the same as the node live."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dynssm_ros import api
from dynssm_ros.api.replay import ReplaySettings
from dynssm_ros.cli.console import progress_bar, say
from dynssm_ros.cli.options import SignalsOption, with_settings


@with_settings(ReplaySettings)
def replay(
    bag: Annotated[Path, typer.Argument(help="rosbag2 folder or file, or ROS 1 bag.")],
    model: Annotated[Path, typer.Option(help="Model folder.")],
    out: Annotated[Path, typer.Option(help="rosbag2 folder to write.")],
    settings: ReplaySettings,
    signals: SignalsOption = "default",
) -> None:
    """Predict offline what the node would have published for a bag."""
    with progress_bar("replaying") as progress:
        count, refusals, notes = api.replay(bag, model, out, signals, settings=settings, on_progress=progress)
    for note in notes:
        say(f"note: {note}")
    reasons = ", ".join(f"{number} x {refusal.value}" for refusal, number in refusals.items())
    say(f"{out}: {count} predictions" + (f"; none for: {reasons}" if reasons else ""))
