"""``dynssm train``: recordings to a model folder; continues where a kill left it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dynssm_ros import api
from dynssm_ros.api.train import TrainSettings
from dynssm_ros.cli.console import errors, progress_bar, say
from dynssm_ros.cli.options import ModelFileOption, RecordingsArgument, VehicleOption, with_settings
from dynssm_ros.errors import ConfigurationError
from dynssm_ros.extras import missing_libraries

if TYPE_CHECKING:
    from dynssm_ros.learning.stages import Trained


@with_settings(TrainSettings)
def train(
    recordings: RecordingsArgument,
    vehicle: VehicleOption,
    out: Annotated[Path, typer.Option(help="Model folder to write.", file_okay=False)],
    settings: TrainSettings,
    model: ModelFileOption = "dynssm",
) -> None:
    """Train a model on recordings and write its folder: card, weights, ONNX, metrics, loss picture."""
    with progress_bar("training") as progress:
        try:
            trained, artifact = api.train(
                recordings, model, vehicle, out, settings=settings, on_progress=progress,
                picture=None if missing_libraries("report") else _draw_losses,
            )  # fmt: skip
        except KeyboardInterrupt:
            folder = out.absolute()
            states = folder.parent.glob(f"{folder.name}.checkpoint*.pt")
            kept = sorted(states, key=lambda path: path.stat().st_mtime_ns)
            name = kept[-1].name if kept else "the beginning"
            errors.print(f"interrupted; the same command continues from {name}")
            raise typer.Exit(130) from None
    if trained.restarts:
        say(f"began anew {trained.restarts} times: it was no better than predicting the mean change")
    if trained.resumed_from:
        say(f"continued from epoch {trained.resumed_from}")
    v_x, v_y, omega = trained.validation_rmse
    say(
        f"{artifact.path}: {artifact.card.parameters} parameters, best epoch {trained.best_epoch}, "
        f"seed {trained.config.training.seed}; one-step RMSE on {trained.windows[1]} validation windows: v_x {v_x:.4g} m/s, "
        f"v_y {v_y:.4g} m/s, omega {omega:.3g} rad/s (commands: {artifact.card.commands})"
    )
    if trained.failure:
        raise ConfigurationError(trained.failure)
    layout = trained.features.layout if trained.features else None
    if trained.throttle_gain is not None and layout is not None and layout.throttle:
        say(
            f"steps of the throttle take {100 * trained.throttle_gain:.1f} % off the online layer's error on left-out "
            "stretches of the laps, so they are used"
        )
    if trained.network_gain is not None:
        used = layout is not None and layout.network
        say(
            f"beside physics and online layer the network takes {100 * trained.network_gain:.1f} % off the error on "
            f"left-out parts of the laps, so it is {'used' if used else 'left out of the online layer'}"
        )


def _draw_losses(trained: Trained, file: Path) -> None:
    from dynssm_ros.reporting.evaluation_figures import loss_components

    loss_components(trained.history, trained.best_epoch).savefig(file, dpi=150)
