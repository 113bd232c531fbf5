"""The single-track model whose states and coefficients an extended Kalman filter follows: textbook online identification.

After Ljung, "Asymptotic Behavior of the Extended Kalman Filter as a Parameter Estimator for Linear Systems", 1979, and what
books on vehicle dynamics do with it. State and coefficients are one vector; coefficients are a random walk. The filter runs
over a window and begins anew in each, from the calibrated car. Nothing is tuned to a car:

- measurement noise: from the second differences of what was measured, which a smooth motion hardly has;
- noise of the motion: what the physics' one-step errors have beyond that;
- coefficients: how far they change from one day to another (``SPREAD``), and a tenth of that within a window.
"""

from __future__ import annotations

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.runtime.baselines import SingleTrack
from dynssm_ros.runtime.coefficients import SPREAD
from dynssm_ros.runtime.contract import Untrained, WindowPrediction
from dynssm_ros.signals.inputs import applied_inputs
from dynssm_ros.vehicle import COEFFICIENTS, Applied, CarModel, Coefficients, State, Vehicle
from dynssm_ros.vehicle.effects import initial_effect_states
from dynssm_ros.vehicle.integrators import Integrator

FOLLOWED = ("D_f", "D_r", "S_hf", "S_hr", "C_m1", "C_r0")
"""Coefficients that the filter follows: grip and offset of each axle, drive, resistance."""
_WINDOW_S = 2.0
_SHIFTS = ("S_hf", "S_hr")
_WALK = 0.1  # of the spread, within a window
_LEAST_NOISE = 1e-4  # standard deviation, as a share of the increments': keeps the covariances positive
_SECANT = 1e-3  # step of the derivatives: m/s, m/s, rad/s, and shares of the spread
_STATES = 3


class SingleTrackEkf(Untrained):
    """A joint extended Kalman filter over states and some coefficients of the single-track model."""

    name = "single_track_ekf"

    def __init__(self, vehicle: Vehicle, integrator: Integrator | None = None, substeps: int = 1) -> None:
        self.vehicle = vehicle
        self.T_s = vehicle.sampling_time
        self._car = CarModel.of(vehicle, integrator, substeps)
        self._theta = vehicle.nominal
        self._steps = round(_WINDOW_S / self.T_s)
        self.H = self._steps + 1
        self._which = np.array([COEFFICIENTS.index(name) for name in FOLLOWED])
        sizes = [1.0 if name in _SHIFTS else abs(self._theta[COEFFICIENTS.index(name)]) for name in FOLLOWED]
        self._spread = np.array([SPREAD[name] for name in FOLLOWED]) * sizes
        size, step = _STATES + len(FOLLOWED), SingleTrack(vehicle, integrator, substeps).flops
        self.flops = self._steps * ((size + 2) * step + 4 * size**3)  # steps and matrix products, about

    @property
    def origin(self) -> str:
        """The vehicle file."""
        return f"extended Kalman filter of states and coefficients from vehicle {self.vehicle.name} on, no learning"

    def predict(self, windows: Vector) -> WindowPrediction:
        """Filters each window from its first row on, and steps from where it ends."""
        measured, inputs = windows[:, :, :_STATES], np.stack(applied_inputs(np.moveaxis(windows, -1, 0)), axis=-1)
        count, rows = measured.shape[:2]
        R, Q = self._noises(measured, inputs)
        n = len(FOLLOWED)
        state, changes = measured[:, 0].copy(), np.zeros((count, n))
        P = np.zeros((count, _STATES + n, _STATES + n))
        P[:, range(_STATES), range(_STATES)] = R
        P[:, range(_STATES, _STATES + n), range(_STATES, _STATES + n)] = 1.0
        walk = np.full((count, n), _WALK**2 / self._steps)
        noise = np.concatenate([Q, walk], axis=1)
        for k in range(rows):
            if k > 0:
                spread = P[:, :, :_STATES]
                S = P[:, :_STATES, :_STATES] + R[:, :, None] * np.eye(_STATES)
                gain = np.swapaxes(np.linalg.solve(S, np.swapaxes(spread, 1, 2)), 1, 2)
                moved = np.einsum("nij,nj->ni", gain, measured[:, k] - state)
                state, changes = state + moved[:, :_STATES], np.clip(changes + moved[:, _STATES:], -3.0, 3.0)
                P = P - gain @ P[:, :_STATES]
            state, F = self._linearised(state, inputs[:, k], changes)
            P = F @ P @ np.swapaxes(F, 1, 2)
            P[:, range(_STATES + n), range(_STATES + n)] += noise
        variance = P[:, range(_STATES), range(_STATES)] + R
        return WindowPrediction(state, self._coefficients(changes), state, variance)

    def _noises(self, measured: Vector, inputs: Vector) -> tuple[Vector, Vector]:
        """Variances of the measurement and of a step of the motion, for each window, ``(N, 3)`` each."""
        increments = np.diff(measured, axis=1)
        least = (_LEAST_NOISE * increments.std(axis=1) + 1e-9) ** 2
        R = np.maximum(np.mean(np.diff(measured, n=2, axis=1) ** 2, axis=1) / 6.0, least)
        flat = measured[:, :-1].reshape(-1, _STATES)
        moved = self._moved(flat, inputs[:, :-1].reshape(-1, 2), np.zeros((len(flat), len(FOLLOWED))))
        errors = measured[:, 1:] - moved.reshape(increments.shape)
        return R, np.maximum(np.mean(errors**2, axis=1) - 2.0 * R, least)

    def _coefficients(self, changes: Vector) -> Vector:
        """All coefficients ``(N, 17)`` for changes ``(N, 6)`` in units of their spread, within their bounds."""
        theta = np.tile(self._theta, (len(changes), 1))
        theta[:, self._which] += self._spread * changes
        return np.clip(theta, self.vehicle.lower, self.vehicle.upper)

    def _moved(self, state: Vector, inputs: Vector, changes: Vector) -> Vector:
        """Next states ``(N, 3)``; the effects' states are settled at each row."""
        theta = Coefficients(*self._coefficients(changes).T)
        applied = Applied(*inputs.T)
        settled = initial_effect_states(self._car.effects, *applied)
        following, _ = self._car.step(State(*state.T), applied, theta, settled)
        return np.stack(np.broadcast_arrays(*following), axis=-1)

    def _linearised(self, state: Vector, inputs: Vector, changes: Vector) -> tuple[Vector, Vector]:
        """Next states and the derivatives of the whole step, ``(N, 3)`` and ``(N, 9, 9)``."""
        count, n = changes.shape
        size = _STATES + n
        nudged = np.concatenate([np.zeros((1, size)), _SECANT * np.eye(size)])
        states = (state[:, None] + nudged[:, :_STATES]).reshape(-1, _STATES)
        varied = (changes[:, None] + nudged[:, _STATES:]).reshape(-1, n)
        moved = self._moved(states, np.repeat(inputs, size + 1, axis=0), varied).reshape(count, size + 1, _STATES)
        F = np.tile(np.eye(size), (count, 1, 1))
        F[:, :_STATES] = np.swapaxes((moved[:, 1:] - moved[:, :1]) / _SECANT, 1, 2)
        return moved[:, 0], F
