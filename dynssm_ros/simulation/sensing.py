"""What comes between a car and whoever drives it: noise on what is measured, and the time until it arrives."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.errors import ConfigurationError
from dynssm_ros.vehicle import State
from dynssm_ros.vehicle.kinematics import Pose

MOST_LATE = 20  # steps


@dataclass(frozen=True)
class Sensing:
    """How a car is measured. The controller knows the delay."""

    noise: tuple[float, float, float] = (0.0, 0.0, 0.0)  # standard deviations on v_x, v_y (m/s), omega (rad/s)
    pose_noise: tuple[float, float, float] = (0.0, 0.0, 0.0)  # likewise on x, y (m), theta (rad)
    delay: float = 0.0  # of what is measured (s), at most MOST_LATE sampling times; rounded up to whole ones
    seed: int = 0  # of the noise

    def steps(self, T_s: float) -> int:
        """The delay in sampling times (s).

        Raises:
            ConfigurationError: it is negative, not finite or too long, or a deviation is.
        """
        for name, deviations in (("noise", self.noise), ("pose_noise", self.pose_noise)):
            if not (len(deviations) == 3 and all(0.0 <= std < math.inf for std in deviations)):
                given = ", ".join(f"{std:g}" for std in deviations)
                raise ConfigurationError(f"{name} {given}: expected three finite numbers of at least 0")
        return steps_late(self.delay, T_s)


def steps_late(delay: float, T_s: float) -> int:
    """A delay (s) in sampling times ``T_s`` (s), rounded up to whole ones.

    Raises:
        ConfigurationError: it is negative, not finite or more than :data:`MOST_LATE` of them.
    """
    if not 0.0 <= delay <= MOST_LATE * T_s:
        raise ConfigurationError(f"delay {delay:g} s: expected 0 to {MOST_LATE * T_s:g} s")
    return math.ceil(delay / T_s - 1e-6)


class Sensors:
    """A car's sensors on its way, asked once per ``T_s`` (s).

    Raises:
        ConfigurationError: the noise or the delay cannot be.
    """

    def __init__(self, sensing: Sensing, T_s: float) -> None:
        steps = sensing.steps(T_s)
        self._deviations = np.array([*sensing.pose_noise, *sensing.noise])
        self._rng = np.random.default_rng([sensing.seed, 2])  # apart from other draws of the same seed
        self._seen: deque[Vector] = deque(maxlen=1 + steps)

    def measure(self, pose: Pose, state: State) -> None:
        """Takes what is to be measured at an instant."""
        self._seen.append(np.array([*pose, *state]) + self._deviations * self._rng.standard_normal(6))

    @property
    def newest(self) -> tuple[Pose, State]:
        """What was measured last, whether or not it has arrived."""
        return Pose(*self._seen[-1][:3]), State(*self._seen[-1][3:])

    @property
    def arrived(self) -> tuple[Pose, State, int]:
        """The newest that has arrived, and how many steps old it is; at the start the first."""
        oldest = self._seen[0]
        return Pose(*oldest[:3]), State(*oldest[3:]), len(self._seen) - 1

    @property
    def is_full(self) -> bool:
        """Whether what has arrived is a delay old."""
        return len(self._seen) == self._seen.maxlen
