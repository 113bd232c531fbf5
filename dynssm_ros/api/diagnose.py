"""Diagnosis: what the simulation gets wrong about measured laps, and why."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from dynssm_ros.api.inputs import Log, PathLike, opened, track_of, vehicle_of
from dynssm_ros.api.settings import MIN_SPEED, CommandsSettings, WorkerSettings, keywords, setting
from dynssm_ros.extras import require
from dynssm_ros.parallel import connected
from dynssm_ros.progress import OnProgress
from dynssm_ros.vehicle import Vehicle
from dynssm_ros.vehicle.integrators import Integrator

if TYPE_CHECKING:
    from dynssm_ros.evaluation.residuals.diagnosed import ExaminedDiagnosis


class DiagnoseSettings(CommandsSettings, WorkerSettings):
    """Settings of :func:`diagnose`."""

    horizon: float = setting(0.5, "Time that is simulated from a measured state on (s).", ge=0.0)
    holdout: float | None = setting(
        None,
        "Share at the end that only measures the improvement; whole laps if there are three.",
        otherwise="what the vehicle file left out of the same recording, else 0.25",
        le=0.8,
    )
    min_speed: float | None = MIN_SPEED
    integrator: Integrator | None = setting(
        None, "How the model steps.", otherwise="the file's, else rk4; others if clearly closer"
    )
    track: Any = setting(
        None,
        "Track along which places are counted: built-in name or file, in the recording's coordinates.",
        otherwise="the first full lap in the recording",
    )
    exclude: tuple[str, ...] = setting(
        (), "Effect that is impossible there, such as crosswind in a hall; repeat for more."
    )


@keywords(DiagnoseSettings)
def diagnose(
    recordings: Log | Sequence[Log],
    vehicle: Vehicle | PathLike,
    *,
    settings: DiagnoseSettings,
    suspect: Log | Sequence[Log] = (),
    on_progress: OnProgress | None = None,
) -> ExaminedDiagnosis:
    """Finds out what the simulation gets wrong about measured laps, and why, and what the answer leaves.

    Args:
        recordings: of one car. What only one of several has is named with it.
        vehicle: the simulated car; how well it is known decides whether a coefficient that has to move is a cause.
        settings: all keywords as one object.
        suspect: recordings of the same car in which something may have changed since ``recordings``.
        on_progress: called with what is being done.

    Example:
        >>> hidden = {"steering_offset": {"offset": 0.03}}
        >>> noise = (0.005, 0.005, 0.02)
        >>> laps = recorded(simulate("orca", "club", duration=25.0, plant="euler", effects=hidden, noise=noise))
        >>> [cause.effect for cause in diagnose(laps, "orca", integrator="euler").causes]
        ['steering_offset']
    """
    require("diagnose", "train")
    from dynssm_ros.evaluation.residuals.diagnosed import ExaminedDiagnosis
    from dynssm_ros.identification.result.diagnose import diagnose

    s, car, tell = settings, vehicle_of(vehicle), on_progress or (lambda words: None)
    line = None if s.track is None else track_of(s.track).centre
    data, changed = ([log.with_commands(s.commands) for log in opened(logs, car)] for logs in (recordings, suspect))
    with connected(s.workers) as pool:
        found = diagnose(
            data, car, horizon=s.horizon, holdout=s.holdout, min_speed=s.min_speed, integrator=s.integrator, line=line,
            on_progress=tell, exclude=s.exclude, suspect=changed, pool=pool,
        )  # fmt: skip
    tell("looking at what is left")
    return ExaminedDiagnosis.of(found)
