"""Models that need no training: persistence and the single-track model."""

from __future__ import annotations

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.runtime.contract import Untrained, WindowPrediction
from dynssm_ros.runtime.operations import count_operations
from dynssm_ros.signals.inputs import WINDOW_COLUMNS, applied_inputs
from dynssm_ros.vehicle import Applied, CarModel, Coefficients, State, Vehicle
from dynssm_ros.vehicle.car import CARRIED_S
from dynssm_ros.vehicle.integrators import Integrator


class Persistence(Untrained):
    """The next state is the present one: the mark that every model must pass."""

    name = "persistence"
    T_s = 0.0
    H = 1
    vehicle = None
    origin = "the next state is the present one"
    flops = 0

    def predict(self, windows: Vector) -> WindowPrediction:
        """Returns the last state of each window."""
        return WindowPrediction(windows[:, -1, :3].copy(), None, None)


class SingleTrack(Untrained):
    """The nominal single-track model of a vehicle file, without learning.

    Where effects of the vehicle have states (a lagging steering, relaxing tyres), these are carried over a window of
    ``CARRIED_S``.
    """

    name = "single_track"

    def __init__(self, vehicle: Vehicle, integrator: Integrator | None = None, substeps: int = 1) -> None:
        self.vehicle = vehicle
        self.T_s = vehicle.sampling_time
        self._theta = vehicle.nominal
        self._car = CarModel.of(vehicle, integrator, substeps)
        self.H = 1 + (round(CARRIED_S / self.T_s) if self._car.effect_states else 0)
        self.flops = count_operations(self.predict, np.ones((1, self.H, len(WINDOW_COLUMNS))))

    @property
    def origin(self) -> str:
        """The vehicle file."""
        return f"nominal single-track model of vehicle {self.vehicle.name}, no learning"

    def predict(self, windows: Vector) -> WindowPrediction:
        """Steps the physics from the last row of each window."""
        predicted = self._following(windows, 1)[:, 0]
        return WindowPrediction(predicted, np.tile(self._theta, (len(windows), 1)), predicted)

    def _following(self, windows: Vector, latest: int) -> Vector:
        """Next states ``(N, latest, 3)`` from the latest rows of windows ``(N, H, 7)``."""
        columns = np.moveaxis(windows, -1, 0)
        moved = self._car.over(
            State(*columns[:3]), applied_inputs(columns), Applied(*columns[3:5]), Coefficients(*self._theta), latest
        )
        following: Vector = windows[:, -latest:, :3] + np.stack(moved, axis=-1)
        return following


class SingleTrackEwma(SingleTrack):
    """The single-track model less an exponential average of its own recent one-step errors.

    Banking, offsets and another set-up make the physics err the same way step after step; these errors are known at run
    time, so the honest baseline takes them off.
    """

    name = "single_track_ewma"
    rows = 31
    decay = 0.9

    def __init__(self, vehicle: Vehicle, integrator: Integrator | None = None, substeps: int = 1) -> None:
        super().__init__(vehicle, integrator, substeps)
        self.H += self.rows - 1
        self.flops = count_operations(self.predict, np.ones((1, self.H, len(WINDOW_COLUMNS))))

    def predict(self, windows: Vector) -> WindowPrediction:
        """Steps the physics from the last row and corrects it by the mean of its errors over the window."""
        following = self._following(windows, min(self.rows, windows.shape[1]))
        count, rows, _ = following.shape
        errors = following[:, :-1] - windows[:, windows.shape[1] - rows + 1 :, :3]
        weights = self.decay ** np.arange(rows - 2, -1, -1.0)
        physics = following[:, -1]
        corrected = physics - ((weights / weights.sum())[:, None] * errors).sum(axis=1)
        return WindowPrediction(corrected, np.tile(self._theta, (count, 1)), physics)
