"""``dynssm train``: recordings to a model folder; continues where a kill left it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dynssm_ros.cli.console import CommandsOption, VehicleOption, console, errors, progress_bar
from dynssm_ros.files import replacing
from dynssm_ros.signals.recording import Recording, concatenate
from dynssm_ros.vehicle import load_vehicle


def train(
    recordings: Annotated[list[Path], typer.Argument(help="Recordings of one car.", metavar="R.parquet...")],
    model: Annotated[str, typer.Option(help="Model: name of a shipped one (dynssm_av21, ddm_av21, ...) or a file.")],
    vehicle: VehicleOption,
    out: Annotated[Path, typer.Option(help="Model folder to write.", file_okay=False)],
    holdout: Annotated[
        float,
        typer.Option(help="Leave the last fraction of each recording out, for `evaluate --holdout`.", min=0.0, max=0.9),
    ] = 0.0,
    commands: CommandsOption = None,
    seed: Annotated[int | None, typer.Option(help="Instead of the model file's.", min=0)] = None,
    epochs: Annotated[int | None, typer.Option(help="Instead of the model file's, in each stage.", min=1)] = None,
    device: Annotated[str, typer.Option(help="cpu or cuda.")] = "cpu",
) -> None:
    """Train a model on recordings and write its folder: card, weights, ONNX, metrics, loss picture."""
    from dynssm_ros.learning.calibration import calibrate
    from dynssm_ros.learning.export import check_replaceable, save_artifact
    from dynssm_ros.learning.models.registry import load_model_config
    from dynssm_ros.learning.stages import check_device, checkpoints
    from dynssm_ros.learning.stages import train as fit
    from dynssm_ros.reporting.evaluation_figures import loss_components

    check_device(device)
    out = out if out.name else out.absolute()  # "." has no name to put the checkpoint beside
    check_replaceable(out)
    given = {key: value for key, value in (("seed", seed), ("epochs", epochs)) if value is not None}
    config = load_model_config(model).with_training(**given)
    data = concatenate([Recording.load(path).with_commands(commands).split_last(holdout)[0] for path in recordings])
    checkpoint = out.with_name(f"{out.name}.checkpoint.pt")
    with progress_bar("training") as progress:
        try:
            trained = fit(
                data, config, load_vehicle(vehicle), checkpoint, device, progress,
                lambda log, car: calibrate(log, car, min_speed=car.minimum_speed).vehicle,
            )  # fmt: skip
        except KeyboardInterrupt:
            kept = [path for path in checkpoints(config, checkpoint) if path.is_file()] or [checkpoint]
            errors.print(f"interrupted; the same command continues from {kept[-1].name}")
            raise typer.Exit(130) from None
    artifact = save_artifact(trained, out, {"holdout": holdout, "device": device})
    if trained.history:
        with replacing(out / "losses.png") as aside:
            loss_components(trained.history, trained.best_epoch).savefig(aside, dpi=150)
    for path in checkpoints(config, checkpoint):
        path.unlink(missing_ok=True)
    if trained.resumed_from:
        console.print(f"continued from epoch {trained.resumed_from}")
    v_x, v_y, omega = trained.validation_rmse
    console.print(
        f"{out}: {artifact.card.parameters} parameters, best epoch {trained.best_epoch}, seed {config.training.seed}; "
        f"one-step RMSE on {trained.windows[1]} validation windows: v_x {v_x:.4g} m/s, v_y {v_y:.4g} m/s, "
        f"omega {omega:.3g} rad/s (commands: {data.info.commands})",
        soft_wrap=True,
    )
