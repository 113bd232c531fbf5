"""Residuals: the anatomy of one-step errors."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dynssm_ros.api.inputs import Log, PathLike, centre_line, joined, opened, several, vehicle_in_windows
from dynssm_ros.api.settings import MIN_SPEED, CommandsSettings, keywords, setting
from dynssm_ros.extras import require
from dynssm_ros.progress import NamedProgress
from dynssm_ros.signals.recording import Recording
from dynssm_ros.vehicle import Vehicle

if TYPE_CHECKING:
    from dynssm_ros.evaluation.residuals.anatomy import Anatomy
    from dynssm_ros.runtime.contract import WindowModel

_PRIOR_S = 60.0
"""Of the drive that the weak prior of ``rls`` is fitted to (s): it counts for 10 to 160 rows, and the rest takes its time."""


class ResidualsSettings(CommandsSettings):
    """Settings of :func:`residuals`."""

    min_speed: float | None = MIN_SPEED
    track: Any = setting(
        None,
        "Track along which places are counted: built-in name or file, in the recording's coordinates.",
        otherwise="the first full lap in the recording",
    )
    learner: bool = setting(
        True, "Ask boosted trees what can still be learned of the errors.", option="--learner/--no-learner"
    )


@keywords(ResidualsSettings)
def residuals(
    recordings: Log | Sequence[Log],
    vehicle: Vehicle | PathLike,
    models: Sequence[WindowModel | PathLike] = (),
    *,
    settings: ResidualsSettings,
    name: str = "",
    on_progress: NamedProgress | None = None,
) -> Anatomy:
    """Takes the one-step errors of the physics, and of the best model beside it, apart.

    Args:
        recordings: of one car, in the order of driving.
        vehicle: the car whose single-track model is the physics; calibrate it before, or its coefficients are the patterns.
        models: folders, names of baselines, or models; if there are none, ``rls``, which learns along the drive.
        settings: all keywords as one object.
        name: of the recording, for people; that of its file, or its sources, if not given.
        on_progress: called with models done, all models and the name of the one at work.

    Raises:
        RecordingError: less than 24 s of whole windows at the vehicle's minimum speed.

    Example:
        >>> noise = (0.005, 0.005, 0.02)
        >>> laps = recorded(simulate("orca", "club", duration=40.0, noise=noise))
        >>> found = residuals(laps, "orca", ["single_track"], learner=False)
        >>> found.models["single_track"].patterns
        ()
    """
    require("residuals", "train", "residuals")
    from dynssm_ros.evaluation.residuals.anatomy import anatomy
    from dynssm_ros.runtime.registry import load_model, open_models

    s, car = settings, vehicle_in_windows(vehicle)
    log = joined(opened(recordings, car), s.commands)
    line = None if s.track is None else centre_line(s.track, log)
    physics = load_model("single_track", car)
    known = open_models(list(models), car) or {"rls": _rls(log, car)}
    if not name:
        name = ", ".join(Path(each).name for each in several(recordings) if isinstance(each, (str, Path)))
    return anatomy(
        log, {physics.name: physics} | known, physics, name=name, min_speed=s.min_speed, line=line, learn=s.learner,
        progress=on_progress,
    )  # fmt: skip


def _rls(log: Recording, car: Vehicle) -> WindowModel:
    """The online layer on the physics as the file has it, its prior of the first minute."""
    from dynssm_ros.learning.export import save_artifact
    from dynssm_ros.learning.models.physics import PhysicsConfig
    from dynssm_ros.learning.models.registry import load_model_config
    from dynssm_ros.learning.stages import train
    from dynssm_ros.runtime.registry import load_model

    fast = log["v_x"] >= car.minimum_speed
    first = int(fast.argmax())
    part = log.select(slice(first, first + round(_PRIOR_S / log.T_s)))
    shipped = load_model_config("rls")
    config = shipped.model_copy(update={"physics": PhysicsConfig(nominal="vehicle")})
    with tempfile.TemporaryDirectory() as folder:
        trained = train(part, config, car, Path(folder) / "rls.checkpoint.pt")
        save_artifact(trained, Path(folder) / "rls", {})
        return load_model(Path(folder) / "rls")
