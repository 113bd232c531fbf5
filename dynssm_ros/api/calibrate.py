"""Calibration: nominal parameters of a vehicle by nonlinear least squares, with standard deviations."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from dynssm_ros.api.inputs import Log, PathLike, centre_line, held_out, joined, opened, vehicle_of
from dynssm_ros.api.settings import HOLDOUT, MIN_SPEED, CommandsSettings, StrictSettings, keywords, setting
from dynssm_ros.errors import DataWarning, RecordingError
from dynssm_ros.extras import require
from dynssm_ros.files import forced
from dynssm_ros.progress import Progress
from dynssm_ros.signals.recording import COLUMN_UNITS, Recording
from dynssm_ros.signals.signal_map import STATE_SIGNALS
from dynssm_ros.signals.spans import Drive
from dynssm_ros.vehicle import Vehicle
from dynssm_ros.vehicle.integrators import Integrator
from dynssm_ros.vehicle.single_track import standing_speed

if TYPE_CHECKING:
    from dynssm_ros.identification.result.calibration import Calibration


class CalibrateSettings(CommandsSettings, StrictSettings):
    """Settings of :func:`calibrate`."""

    horizon: float | None = setting(
        None,
        "Length of the simulations that are compared with the laps (s).",
        otherwise="0.5, less for short recordings",
        ge=0.0,
    )
    integrator: Integrator | None = setting(
        None, "Steps of the model.", otherwise="rk4, unless euler is clearly closer to the laps"
    )
    min_speed: float | None = MIN_SPEED
    holdout: float | None = HOLDOUT
    starts: int = setting(3, "Starting points of the search.", ge=1)
    seed: int = setting(0, "Of the random starting points.", ge=0)
    track: Any = setting(
        None,
        "Track along which the places of the vehicle's effects are counted: built-in name or file.",
        otherwise="none; how the road bends is seen from the first full lap",
    )


@keywords(CalibrateSettings)
def calibrate(
    recordings: Log | Sequence[Log],
    vehicle: Vehicle | PathLike,
    *,
    settings: CalibrateSettings,
    on_progress: Progress | None = None,
) -> Calibration:
    """Fits the nominal parameters of a vehicle to measured laps, within their bounds, with standard deviations.

    Args:
        recordings: of one car.
        vehicle: start values, bounds, and what is known before.
        settings: all keywords as one object.
        on_progress: called after each starting point.

    Raises:
        RecordingError: the car stands, or calibrated predicts a state no better than that nothing changes; see ``--force``.

    Example:
        >>> laps = recorded(simulate("orca", "club", duration=20.0))
        >>> found = calibrate(laps, "orca")
        >>> round(found.vehicle.coefficients["D_f"].nominal, 4)
        0.192
    """
    require("calibrate", "train")
    from dynssm_ros.identification.result.calibration import calibrate

    car, s = vehicle_of(vehicle), settings
    logs = opened(recordings, car, strict=s.strict)
    left_out = held_out(logs, s.holdout, car)
    data = joined(logs, s.commands, left_out)
    require_a_drive(data, car)
    line = None if s.track is None else centre_line(s.track, data)
    found = calibrate(
        data, car, horizon=s.horizon, min_speed=s.min_speed, integrator=s.integrator, starts=s.starts, seed=s.seed,
        on_progress=on_progress, line=line,
    )  # fmt: skip
    found = replace(found, vehicle=found.vehicle.with_held_out(left_out))
    require_physics(found)
    return found


def require_physics(found: Calibration) -> None:
    """Checks that the car predicts each state better than that nothing changes.

    Raises:
        RecordingError: it does not; with ``--force`` it is a :class:`DataWarning`.
    """
    if not found.tells_nothing_of:
        return
    errors = zip(STATE_SIGNALS, found.rmse_ahead, found.persistence, strict=True)
    told = ", ".join(
        f"{name} {error:.3g} against {still:.3g} {COLUMN_UNITS[name]}"
        for name, error, still in errors
        if name in found.tells_nothing_of
    )
    words = (
        f"{found.horizon:.2g} s ahead the calibrated car errs no less than the prediction that nothing changes ({told}): "
        "expected less; look at sign, unit and time of these states and of the inputs (dynssm inspect), at the vehicle file, "
        "and at what it lacks (dynssm diagnose)"
    )
    _refuse(words)


def require_a_drive(laps: Recording, car: Vehicle) -> None:
    """Checks that the car drives: standing, its tyres and its motor do nothing that coefficients follow from.

    Raises:
        RecordingError: it stands; with ``--force`` it is a :class:`DataWarning`.
    """
    drive, least = Drive.of(laps), standing_speed(car.constants.wheelbase)
    fastest = drive.speed_but_glitches
    if drive.stands or fastest < least:
        _refuse(
            f"{', '.join(laps.info.source)}: the car stands: hardly a second is faster than {fastest:.2g} m/s; "
            f"expected a drive, {least:.2g} m/s or more"
        )


def _refuse(words: str) -> None:
    """Ends with an error, or warns with ``--force``."""
    if not forced():
        raise RecordingError(f"{words}; --force writes it all the same")
    warnings.warn(words, DataWarning, stacklevel=5)
