"""Offset-free model predictive control: what a model does not say of the car, followed from step to step.

The error of each one-step prediction moves an estimate of a constant disturbance of the velocities, which is added to
the model over the whole horizon. Estimates of several rates run side by side; the one that has expected the last errors
best is added, unless nothing does as well. So noise alone adds nothing.

Pannocchia, Rawlings, "Disturbance models for offset-free model-predictive control", AIChE Journal 49, 2003.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.control.nmpc import Adapted
from dynssm_ros.control.settings import Settings
from dynssm_ros.control.state_estimator import Observers

SETTLING = 1.0
"""Time after which 63 % of a constant disturbance are found if it is asked for, in units of the car's time."""
_SHARES = (0.0, 0.05, 0.15, 0.4)  # among which the data choose
_MEMORY = 5.0  # in units of the car's time, over which they are compared
_CLEARLY = 0.7  # of the mean square error without an estimate
_WARM_UP = 5  # errors


class Disturbance:
    """An estimate of what is to be added to a model's step in ``v_x, v_y, omega`` (m/s, m/s, rad/s).

    Args:
        shares: of the error of each prediction by which estimates move, the preferred one first; 0: it stays at
            nothing.
        largest: error up to which a prediction counts, ``(3,)``; more is an error of the measurement.
        forget: share by which each error replaces the mean of those before, in the comparison of the estimates.
    """

    def __init__(self, shares: Sequence[float], largest: Vector, forget: float = 1.0) -> None:
        self._observers = Observers(shares, forget, _CLEARLY, _WARM_UP)
        self._largest = largest
        self.forget()

    @classmethod
    def of(cls, settings: Settings, T_s: float) -> Disturbance:
        """As :attr:`Settings.follows` says; an error counts up to what all the grip of the car makes in a step of T_s
        (s).
        """
        length, time = settings.scale.length, settings.scale.time
        velocity = length / time**2 * T_s
        always = -math.expm1(-T_s / (SETTLING * time))
        shares = {"always": (always,), "chosen": _SHARES, "never": (0.0,)}[settings.follows]
        return cls(shares, np.array([velocity, velocity, 2 * velocity / length]), min(1.0, T_s / (_MEMORY * time)))

    def forget(self) -> None:
        """Begins anew, as after a gap in what was measured: at nothing."""
        self.value = np.zeros(3)
        """The estimate, shape ``(3,)``."""
        self._observers.reset(self.value)
        self.interrupted()

    def interrupted(self) -> None:
        """What is measured next does not follow what was expected last; the estimate is held."""
        self._expected: Vector | None = None

    def added(self, adapted: Adapted) -> Adapted:
        """What a model says with the estimate added to it, for all steps of the horizon alike."""
        return Adapted(adapted.theta, adapted.correction + self.value)

    def expects(self, following: Vector) -> None:
        """Notes what is predicted for the next step, the estimate included, shape ``(3,)``."""
        self._expected = following

    def measured(self, seen: Vector) -> None:
        """Compares what was expected with what came, shape ``(3,)``. What is not finite counts as not measured."""
        if self._expected is not None:
            error = seen - self._expected
            if np.all(np.abs(error) <= self._largest):
                self._observers.correct(error + self.value)  # the model's own
                self.value = self._observers.estimate
        self.interrupted()
