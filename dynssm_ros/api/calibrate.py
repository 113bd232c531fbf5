"""Calibration: nominal parameters of a vehicle by nonlinear least squares, with standard deviations."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from dynssm_ros.api.inputs import Log, PathLike, centre_line, joined, opened, vehicle_of
from dynssm_ros.api.settings import MIN_SPEED, CommandsSettings, keywords, setting
from dynssm_ros.errors import DataWarning
from dynssm_ros.extras import require
from dynssm_ros.progress import Progress
from dynssm_ros.vehicle import Vehicle
from dynssm_ros.vehicle.integrators import Integrator

if TYPE_CHECKING:
    from dynssm_ros.identification.result.calibration import Calibration


class CalibrateSettings(CommandsSettings):
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
    holdout: float = setting(0.0, "Leave the last fraction of each recording out.", ge=0.0, le=0.9)
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

    Example:
        >>> laps = recorded(simulate("orca", "club", duration=20.0))
        >>> found = calibrate(laps, "orca")
        >>> round(found.vehicle.coefficients["D_f"].nominal, 4)
        0.192
    """
    require("calibrate", "train")
    from dynssm_ros.identification.result.calibration import calibrate

    car, s = vehicle_of(vehicle), settings
    data = joined(opened(recordings, car), s.commands, s.holdout)
    line = None if s.track is None else centre_line(s.track, data)
    found = calibrate(
        data, car, horizon=s.horizon, min_speed=s.min_speed, integrator=s.integrator, starts=s.starts, seed=s.seed,
        on_progress=on_progress, line=line,
    )  # fmt: skip
    if found.tells_nothing_of:
        times = ", ".join(f"{name} {ratio:.2g} times" for name, ratio in found.tells_nothing_of.items())
        warnings.warn(
            f"{found.horizon:.2g} s ahead the calibrated car errs more than the prediction that nothing changes ({times}): "
            "signals, units, signs or the vehicle file are wrong, or it lacks an effect (dynssm inspect, dynssm diagnose)",
            DataWarning, stacklevel=3,
        )  # fmt: skip
    return found
