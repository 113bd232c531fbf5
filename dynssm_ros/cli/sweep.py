"""``dynssm sweep``: settings of a model that predict laps best which were left out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
import yaml

from dynssm_ros import api
from dynssm_ros.cli.console import (
    AddressOption,
    BackendOption,
    CommandsOption,
    JobsOption,
    JsonOption,
    VehicleOption,
    WhereOption,
    console,
    progress_bar,
    write_results,
)
from dynssm_ros.extras import require
from dynssm_ros.files import replacing
from dynssm_ros.parallel import Workers
from dynssm_ros.signals.season import recording_files


def sweep(
    recordings: Annotated[
        list[Path], typer.Argument(help="Recordings of one car, or a season.", metavar="R.parquet...")
    ],
    vehicle: VehicleOption,
    out: Annotated[
        Path, typer.Option(help="Folder of the sweep: results.json, best.yaml, all models.", file_okay=False)
    ],
    model: Annotated[str, typer.Option(help="Model: name of a shipped one or a file.")] = "dynssm",
    space: Annotated[
        str, typer.Option(help="Fields of the model file and what they may be: name of a shipped one or a file.")
    ] = "dynssm",
    trials: Annotated[int, typer.Option(help="Trainings in all; more later go on from those.", min=1)] = 24,
    holdout: Annotated[
        float, typer.Option(help="Last fraction of each recording, which is left out and scored on.", min=0.01, max=0.9)
    ] = 0.25,
    validation: Annotated[
        list[Path] | None, typer.Option(help="Recording or season to score on instead; repeat for more.")
    ] = None,
    commands: CommandsOption = None,
    seed: Annotated[int, typer.Option(help="Of the choices.", min=0)] = 0,
    epochs: Annotated[int | None, typer.Option(help="Instead of the model file's, in each stage.", min=1)] = None,
    jobs: JobsOption = None,
    backend: BackendOption = "processes",
    address: AddressOption = None,
    json: JsonOption = None,
    where: WhereOption = None,
) -> None:
    """Train a model with other settings again and again, and see which predict laps best that were left out."""
    require("sweep", "sweep", "train", "report")
    from dynssm_ros.learning.models.registry import load_model_config, overrides
    from dynssm_ros.reporting.sweep_table import CAUTION, trial_table, verdict

    logs, left_out = recording_files(recordings, where), recording_files(validation or [])
    with progress_bar("trying") as progress:
        found = api.sweep(
            logs, model, vehicle, out, space, trials, holdout, left_out, commands, seed, epochs,
            Workers(jobs, backend, address), progress,
        )  # fmt: skip
    best = load_model_config(model, overrides(found.best.settings))
    with replacing(out / "best.yaml") as aside:
        aside.write_text(yaml.safe_dump(best.model_dump(mode="json"), sort_keys=False), encoding="utf-8")
    write_results(found.to_json(), out, json)
    console.print(trial_table(found).brief.rich())
    console.print(f"{verdict(found)} {CAUTION}", markup=False, soft_wrap=True)
    console.print(f"{out / 'best.yaml'}: its model file", markup=False, soft_wrap=True)
