"""Manoeuvres to plan from where the last plan may be caught in a local optimum: the starting points of a multistart
method.

With the front wheels beyond the slip that their tyres make use of, no small change of a plan leads out of a turn that
has become too tight, where a large one does, such as steering to the other side at once.

Ugray et al., "Scatter search and local NLP solvers: a multistart framework for global optimization", 2007.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.vehicle import Applied
from dynssm_ros.vehicle.parameters import InputLimits

_STEERING = (-1.0, -0.4, 0.0, 0.4, 1.0)
"""Shares of the steering's range on that side to which it is turned as fast as can be, and held there."""
_BRAKES = (False, True)
"""The throttle is held, or the brakes are full on."""
COUNT = len(_STEERING) * len(_BRAKES)


def manoeuvres(now: Applied, limits: InputLimits, N: int, T_s: float) -> Vector:
    """Increments of throttle (fraction) and steering (rad) over ``N`` steps of ``T_s`` (s) within ``limits``, ``(COUNT,
    N, 2)``.

    ``now`` is what the actuators do.
    """
    increments = np.zeros((COUNT, N, 2))
    right, left = limits.steering
    reach = limits.steering_rate * T_s * np.arange(1, N + 1)
    for each, (share, brakes) in zip(increments, product(_STEERING, _BRAKES), strict=True):
        turn = share * left if share >= 0 else -share * right
        each[:, 1] = np.diff(now.delta + np.clip(turn - now.delta, -reach, reach), prepend=now.delta)
        if brakes:
            each[0, 0] = limits.throttle[0] - now.r
    return increments
