"""What the driving would show: promises that are kept."""

from __future__ import annotations

import numpy as np
import pytest

from dynssm_ros.identification.result.diagnose import diagnose
from dynssm_ros.identification.result.diagnosis import Diagnosis
from dynssm_ros.simulation.laps import as_recording, simulate
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import COEFFICIENTS, load_vehicle
from dynssm_ros.vehicle.effects import EFFECTS

ORCA = load_vehicle("orca")
SHIFTS = np.char.startswith(COEFFICIENTS, "S_")
KNOWN = ORCA.with_nominal(ORCA.nominal, np.where(SHIFTS, 0.002, 0.02 * np.abs(ORCA.nominal)))
CLUB = load_track("club")


def diagnosed(**effects: dict[str, float]) -> Diagnosis:
    car = ORCA.with_effects(effects.items())
    run = simulate(car, CLUB, duration=60.0, plant="rk4", noise=(0.01, 0.01, 0.03), seed=5)
    return diagnose(as_recording(run), KNOWN, integrator="rk4", line=CLUB.centre)


@pytest.fixture(scope="module")
def promised() -> dict[str, float]:
    """Least sizes by a healthy drive."""
    healthy = diagnosed()
    assert healthy.causes == ()
    return dict(healthy.minimum_detectable)


@pytest.mark.slow
@pytest.mark.parametrize("effect", ["steering_lag", "drag", "yaw_inertia", "downforce", "front_grip", "steering_curve"])
def test_an_effect_of_the_least_size_is_named_and_a_third_of_it_is_not(promised: dict[str, float], effect: str) -> None:
    name, parameter = next(iter(EFFECTS[effect].PARAMETERS.items()))
    for times, named in ((1.4, True), (0.33, False)):
        size = parameter.neutral + parameter.direction * times * promised[effect]
        found = diagnosed(**{effect: {name: size}})
        reported = {cause.effect for cause in found.causes} | {a for cause in found.causes for a in cause.alternatives}
        assert (effect in reported) == named, f"{size:.3g}: {[cause.effect for cause in found.found]}"
