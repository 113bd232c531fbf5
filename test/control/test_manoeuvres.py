"""Manoeuvres to plan from: within the actuators, to each side, and the brakes."""

import numpy as np
import pytest

from dynssm_ros.control.nmpc import COUNT, manoeuvres
from dynssm_ros.vehicle import Applied


@pytest.mark.parametrize("now", [Applied(0.3, 0.0), Applied(-0.1, 0.35), Applied(1.0, -0.2)])
def test_each_steers_as_fast_as_can_be_holds_and_stays_within_the_actuators(orca, now):
    increments = manoeuvres(now, orca.inputs, 15, 0.02)
    assert increments.shape == (COUNT, 15, 2)
    r, delta = (now + np.cumsum(increments, axis=1)).T
    assert np.min(delta) >= orca.inputs.steering[0] - 1e-12
    assert np.max(delta) <= orca.inputs.steering[1] + 1e-12
    assert np.max(np.abs(increments[..., 1])) <= orca.inputs.steering_rate * 0.02 + 1e-12
    np.testing.assert_allclose(np.unique(delta[-1].round(9)), [-0.35, -0.14, 0.0, 0.14, 0.35])
    np.testing.assert_allclose(np.unique(r.round(9)), np.unique([orca.inputs.throttle[0], now.r]))
    assert np.all(increments[:, 8:, 1] == 0), "the stop is reached in seven steps, from the other stop"
