"""What a model does not say of the car, followed from step to step: offset-free model predictive control.

The error of each one-step prediction moves an estimate of a constant disturbance of the velocities, which is then added to
the model over the whole horizon. A model without error is left as it is; one with a constant error loses it.

Pannocchia, Rawlings, "Disturbance models for offset-free model-predictive control", AIChE Journal 49, 2003.
"""

from __future__ import annotations

import math

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.control.nmpc import Adapted
from dynssm_ros.control.settings import Settings

SETTLING = 1.0  # in units of the car's time: that after which 63 % of a constant disturbance are found


class Disturbance:
    """An estimate of what is to be added to a model's step in ``v_x, v_y, omega`` (m/s, m/s, rad/s).

    Args:
        share: of the error of each prediction by which the estimate moves; 0: it stays at nothing.
        largest: error of ``v_x, v_y, omega`` up to which a prediction counts, shape ``(3,)``; what is beyond is no error of a
            model, but of the measurement.
    """

    def __init__(self, share: float, largest: Vector) -> None:
        self._share = share
        self._largest = largest
        self.forget()

    @classmethod
    def none(cls) -> Disturbance:
        """One that stays at nothing."""
        return cls(0.0, np.zeros(3))

    @classmethod
    def of(cls, settings: Settings, T_s: float) -> Disturbance:
        """With the controller's settings; an error counts up to what all the grip of the car makes in a step of T_s (s)."""
        length, time = settings.scale.length, settings.scale.time
        velocity = length / time**2 * T_s
        share = -math.expm1(-T_s / (SETTLING * time)) if settings.offset_free else 0.0
        return cls(share, np.array([velocity, velocity, 2 * velocity / length]))

    def forget(self) -> None:
        """Begins anew, as after a gap in what was measured: at nothing."""
        self.value = np.zeros(3)
        """The estimate, shape ``(3,)``."""
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
                self.value = self.value + self._share * error
        self.interrupted()
