"""A speed controller's constants from laps of the car: planted ones come back, a limit that was never reached does not."""

from __future__ import annotations

import numpy as np
import pytest

from dynssm_ros.identification.result.calibration import calibrate
from dynssm_ros.signals.recording import Recording
from dynssm_ros.simulation.laps import as_recording, simulate
from dynssm_ros.track.driver import Style
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import COEFFICIENTS, Vehicle, load_vehicle

TRUE = load_vehicle("f1tenth")
GAIN, LIMIT = COEFFICIENTS.index("C_m2"), COEFFICIENTS.index("C_m1")


def drive(share: float) -> Recording:
    """25 s with a share of what the car can do."""
    style, noise = Style(share, 0.8), (0.01, 0.01, 0.03)
    return as_recording(
        simulate(TRUE, load_track("club").scaled(10.0), duration=25.0, seed=2, style=style, noise=noise)
    )


def found(recording: Recording) -> Vehicle:
    """By a file that is off by 40 % in the gain and 15 % in the limit."""
    factors = np.ones(len(COEFFICIENTS))
    factors[[GAIN, LIMIT]] = 0.6, 1.15
    given = TRUE.with_nominal(factors * TRUE.nominal)
    return calibrate(recording, given, integrator="euler", starts=1).vehicle


@pytest.mark.slow
def test_gain_and_limit_are_found_to_5_per_cent_where_the_drive_shows_them() -> None:
    car = found(drive(0.7))
    for name, true in (("C_m2", 24.0), ("C_m1", 35.6)):
        known = car.coefficients[name]
        assert known.std is not None
        assert known.nominal == pytest.approx(true, rel=0.05)
        assert abs(known.nominal - true) < 4 * known.std


@pytest.mark.slow
def test_a_limit_that_is_never_reached_is_left_open() -> None:
    car = found(drive(0.25))
    gain, limit = car.coefficients["C_m2"], car.coefficients["C_m1"]
    assert gain.nominal == pytest.approx(24.0, rel=0.05)
    assert limit.std is not None
    assert limit.std > 0.5 * 9.0
