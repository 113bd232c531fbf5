"""States of effects along measured rows: as the full equations carry them, also where those are left out."""

from __future__ import annotations

import numpy as np
import pytest

from dynssm_ros.vehicle import Applied, Coefficients, State, load_vehicle
from dynssm_ros.vehicle.effects import build_effect, initial_effect_states
from dynssm_ros.vehicle.effects.carried import effect_states_along
from dynssm_ros.vehicle.single_track import increment

CAR = load_vehicle("orca")
THETA = Coefficients(*CAR.nominal)
LAGS = {"steering_lag": 0.05, "throttle_lag": 0.12}
ROWS = 20


def drive() -> tuple[list[State], list[Applied], Applied]:
    rng = np.random.default_rng(3)
    states = [State(*(np.array([v]) for v in (2.0 + 0.02 * k, 0.05, 0.5 + 0.1 * k))) for k in range(ROWS)]
    applied = [Applied(rng.uniform(-0.5, 1.0, 1), rng.uniform(-0.3, 0.3, 1)) for _ in range(ROWS)]
    return states, applied, Applied(np.array([0.3]), np.array([0.1]))


@pytest.mark.parametrize("integrator", ["euler", "rk4"])
@pytest.mark.parametrize("substeps", [1, 3])
@pytest.mark.parametrize(
    "names", [("steering_lag",), ("throttle_lag", "steering_lag"), ("steering_lag", "yaw_rate_lag")]
)
def test_states_are_carried_as_the_whole_car_carries_them(integrator, substeps, names) -> None:
    effects = tuple(build_effect(name, {"time_constant": LAGS.get(name, 0.08)}) for name in names)
    states, applied, feedback = drive()
    how = THETA, CAR.constants, 0.02, effects, integrator, substeps
    found = effect_states_along(np, states, applied, feedback, *how)
    assert len(found) == ROWS
    assert {name for at in found for name in at} == {name for effect in effects for name in effect.carries}
    for k in range(ROWS - 1):
        _, changed = increment(np, states[k], found[k], applied[k], *how)
        for name, value in found[k].items():
            np.testing.assert_allclose(found[k + 1][name], value + changed[name], rtol=1e-12, atol=1e-15)
    settled = initial_effect_states(effects, *feedback)
    assert all(found[0][name] == value for name, value in settled.items())


def test_a_lag_follows_its_exponential_as_far_as_runge_kutta_does() -> None:
    states, _, _ = drive()
    held = [Applied(np.array([0.0]), np.array([0.2]))] * ROWS
    effects = (build_effect("steering_lag", {"time_constant": 0.1}),)
    found = effect_states_along(
        np, states, held, Applied(np.zeros(1), np.zeros(1)), THETA, CAR.constants, 0.02, effects, "rk4"
    )
    steered = [at["steering_lag.delta"][0] for at in found]
    z = 0.02 / 0.1
    kept = 1 - z + z**2 / 2 - z**3 / 6 + z**4 / 24  # the series of exp(-z) to the fourth order
    np.testing.assert_allclose(steered, 0.2 * (1 - kept ** np.arange(ROWS)), rtol=1e-12)
