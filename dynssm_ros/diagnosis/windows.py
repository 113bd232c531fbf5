"""Short simulations along a recording: each starts at a measured row and runs free from there.

The effects' own states are carried along the measured rows before the start, so that a lag is where it was.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from dynssm_ros.diagnosis.car import Car
from dynssm_ros.signals.inputs import applied_inputs
from dynssm_ros.vehicle import Applied, Coefficients, State, Vehicle
from dynssm_ros.vehicle.effects import Effect
from dynssm_ros.vehicle.single_track import Integrator, settled_memory, step_with_memory

Vector = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]

_FINEST = 16  # integration steps per sampling time, at most
WARM_UP = 0.32  # s of measured rows along which the effects' own states are led
_WILD = 1e3  # a prediction farther off than this many spreads of its channel counts as that far


@dataclass(frozen=True)
class Track:
    """The rows of a recording as the simulations read them.

    Attributes:
        rows: model inputs, shape ``(7, N)``.
        context: other signals by name, each of shape ``(N,)``.
        T_s: sampling time (s).
        time: of each row since the first (s), shape ``(N,)``.
    """

    rows: Vector
    context: dict[str, Vector]
    T_s: float
    time: Vector


@dataclass(frozen=True)
class Windows:
    """``W`` simulations of ``K`` steps.

    Attributes:
        data: what is simulated.
        starts: rows from which the simulations start, shape ``(W,)``; ``warm`` rows before each belong to its stretch.
        steps: ``K``.
        warm: rows of warm-up.
        integrator: how the model steps.
        substeps: integration steps per sampling time.
    """

    data: Track = field(repr=False)
    starts: Indices
    steps: int
    warm: int
    integrator: Integrator = "rk4"
    substeps: int = 1

    def __len__(self) -> int:
        return len(self.starts)

    def select(self, chosen: Indices | npt.NDArray[np.bool_]) -> Windows:
        """Some of the simulations."""
        return replace(self, starts=self.starts[chosen])

    def stepping(self, integrator: Integrator, vehicle: Vehicle) -> Windows:
        """The same simulations in Euler steps of the sampling time, or in Runge-Kutta steps that are short enough.

        Sideslip and yaw of the linear single-track car settle with rates of about ``sum C / (m v_x)`` and
        ``sum C l^2 / (I_z v_x)``, ``C`` the cornering stiffness of an axle; a step is at most the inverse of the quicker.
        """
        if integrator == "euler":
            return replace(self, integrator=integrator, substeps=1)
        th, car = Coefficients(*vehicle.nominal), vehicle.constants
        C_f, C_r = th.B_f * th.C_f * th.D_f, th.B_r * th.C_r * th.D_r
        slow = max(float(np.quantile(self.data.rows[0, self.starts], 0.05)), 0.1)
        rate = max((C_f + C_r) / car.m, (C_f * car.l_f**2 + C_r * car.l_r**2) / th.I_z) / slow
        count = int(np.clip(np.ceil(self.data.T_s * rate), 1, _FINEST))
        return replace(self, integrator=integrator, substeps=count)

    @cached_property
    def target(self) -> Vector:
        """Measured states of the predicted rows, shape ``(W, K, 3)``."""
        at = self.starts[:, None] + np.arange(1, self.steps + 1)
        return np.moveaxis(self.data.rows[:3, at], 0, -1)

    @cached_property
    def time(self) -> Vector:
        """Time of each start (s), shape ``(W,)``."""
        return self.data.time[self.starts]

    def context(self, shift: int) -> dict[str, Vector]:
        """The other signals ``shift`` rows after the starts."""
        return {name: values[self.starts + shift] for name, values in self.data.context.items()}

    def errors(self, car: Car, context: dict[str, float] | None = None) -> Vector:
        """Predicted minus measured states (m/s, m/s, rad/s), shape ``(W, K, 3)``.

        Args:
            car: what is simulated.
            context: values that replace signals of the recording, the same in all rows.
        """
        effects = car.active
        carries = any(effect.carries for effect in effects)
        shift = -self.warm if carries else 0
        first = self.data.rows[:, self.starts + shift]
        here = self.context(shift) | (context or {})
        state = State(*first[:3])
        theta, constants = car.theta, car.constants
        memory = settled_memory(np, state, Applied(*first[3:5]), theta, constants, effects, context=here)
        out = np.empty((len(self), self.steps, 3))
        with np.errstate(all="ignore"):
            for k in range(shift, self.steps):
                rows = self.data.rows[:, self.starts + k]
                if k <= 0:
                    state = State(*rows[:3])
                state, memory = self._step(car, state, memory, rows, k, context, effects)
                if k >= 0:
                    out[:, k] = np.stack(np.broadcast_arrays(*state), axis=-1)
        limit = _WILD * self.spread
        return np.clip(np.nan_to_num(out - self.target, nan=1e9, posinf=1e9, neginf=-1e9), -limit, limit)

    def transitions(self, car: Car) -> Vector:
        """Derivatives of each step's end by its start, along the measured rows, shape ``(W, K, 3, 3)``."""
        effects = tuple(effect for effect in car.active if not effect.carries)
        out = np.empty((len(self), self.steps, 3, 3))
        for k in range(self.steps):
            rows = self.data.rows[:, self.starts + k]
            state = State(*rows[:3])
            base, _ = self._step(car, state, {}, rows, k, None, effects)
            for j in range(3):
                h = 1e-4 * self.spread[j]
                moved, _ = self._step(
                    car, State(*(v + h * (i == j) for i, v in enumerate(state))), {}, rows, k, None, effects
                )
                out[:, k, :, j] = np.stack([(a - b) / h for a, b in zip(moved, base, strict=True)], axis=-1)
        return np.asarray(np.clip(np.nan_to_num(out), -10.0, 10.0))

    @cached_property
    def spread(self) -> Vector:
        """Standard deviation of the measured states, shape ``(3,)``."""
        return np.asarray(np.maximum(self.target.reshape(-1, 3).std(axis=0), 1e-6))

    def _step(
        self,
        car: Car,
        state: State,
        memory: Mapping[str, Vector],
        rows: Vector,
        k: int,
        context: Mapping[str, float] | None,
        effects: Sequence[Effect],
    ) -> tuple[State, dict[str, Vector]]:
        """One step from the rows ``k`` after the starts."""
        return step_with_memory(
            np,
            state,
            memory,
            applied_inputs(rows),
            car.theta,
            car.constants,
            self.data.T_s,
            effects,
            self.integrator,
            self.substeps,
            self.context(k) | dict(context or {}),
        )
