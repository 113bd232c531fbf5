"""``dynssm replay``: offline prediction into a new bag, the same as the node live."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dynssm_ros import api
from dynssm_ros.cli.console import console, progress_bar


def replay(
    bag: Annotated[Path, typer.Argument(help="rosbag2 folder or file.")],
    model: Annotated[Path, typer.Option(help="Model folder.")],
    out: Annotated[Path, typer.Option(help="rosbag2 folder to write.")],
    signals: Annotated[str, typer.Option(help="Signal map: name of a shipped one or a file.")] = "default",
    with_inputs: Annotated[
        bool, typer.Option("--with-inputs", help="Also copy the topics of the bag, to look at them together.")
    ] = False,
    max_age: Annotated[
        float, typer.Option(help="Oldest actuator sample that a prediction may rest on (s).", min=0.0)
    ] = 0.2,
    online: Annotated[
        bool, typer.Option("--online/--offline", help="Whether the model's online layer learns and corrects.")
    ] = True,
    online_state: Annotated[
        Path | None,
        typer.Option(
            help="File of what the online layer has learned: read first if it is there, and written at the end.",
            dir_okay=False,
        ),
    ] = None,
) -> None:
    """Predict offline what the node would have published for a bag."""
    with progress_bar("replaying") as progress:
        count, refusals, notes = api.replay(
            bag, model, out, signals, with_inputs, max_age, progress, online, online_state
        )
    for note in notes:
        console.print(f"note: {note}", markup=False, soft_wrap=True)
    reasons = ", ".join(f"{number} x {refusal.value}" for refusal, number in refusals.items())
    console.print(f"{out}: {count} predictions" + (f"; none for: {reasons}" if reasons else ""), soft_wrap=True)
