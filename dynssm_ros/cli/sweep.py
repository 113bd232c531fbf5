"""``dynssm sweep``: settings of a model that predict laps best which were left out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
import yaml

from dynssm_ros import api
from dynssm_ros.api.sweep import SweepSettings
from dynssm_ros.cli.console import console, progress_bar, say, write_results
from dynssm_ros.cli.options import JsonOption, ModelFileOption, RecordingsArgument, VehicleOption, with_settings
from dynssm_ros.extras import require
from dynssm_ros.files import replacing


@with_settings(SweepSettings)
def sweep(
    *,
    recordings: RecordingsArgument,
    vehicle: VehicleOption,
    out: Annotated[
        Path, typer.Option(help="Folder of the sweep: results.json, best.yaml, all models.", file_okay=False)
    ],
    settings: SweepSettings,
    model: ModelFileOption = "dynssm",
    validation: Annotated[
        list[Path] | None, typer.Option(help="Recording or season to score on instead; repeat for more.")
    ] = None,
    json: JsonOption = None,
) -> None:
    """Train a model with other settings again and again, and see which predict laps best that were left out."""
    require("sweep", "sweep", "train", "report")
    from dynssm_ros.learning.models.registry import load_model_config, overrides
    from dynssm_ros.reporting.sweep_table import CAUTION, trial_table, verdict

    with progress_bar("trying") as progress:
        found = api.sweep(
            recordings, model, vehicle, out, settings=settings, validation=validation or (), on_progress=progress
        )
    best = load_model_config(model, overrides(found.best.settings))
    with replacing(out / "best.yaml") as aside:
        aside.write_text(yaml.safe_dump(best.model_dump(mode="json"), sort_keys=False), encoding="utf-8")
    write_results(found.to_json(), out, json)
    console.print(trial_table(found).brief.rich())
    say(f"{verdict(found)} {CAUTION}")
    say(f"{out / 'best.yaml'}: its model file")
