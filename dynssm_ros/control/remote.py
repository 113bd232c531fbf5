"""The prediction model of a controller whose predictor is another process: answers come late, singly or not at all."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.control.horizon_model import CONTEXT, INPUTS, VELOCITIES, HorizonModel
from dynssm_ros.control.nmpc import Adapted, Plan
from dynssm_ros.control.prediction_model import Fixed
from dynssm_ros.vehicle import COEFFICIENTS, Applied, CarModel, Coefficients, State, Vehicle
from dynssm_ros.vehicle.kinematics import SCALAR, Pose

Context = tuple[float, ...]
"""The values of ``CONTEXT``: what effects may read beside the pose."""

_HELD = np.zeros(len(INPUTS))
_ROUNDING = 1e-5  # of a coefficient's range: predictors compute in single precision


class ModelOutput(NamedTuple):
    """What holds now."""

    adapted: Adapted  # for the horizon
    source: str  # in words
    age: float  # of the odometry that it rests on (s); infinite for the nominal car


class RemoteModel(Fixed):
    """The nominal car with the last coefficients of a predictor, and what the predictor adds to a step with them.

    Prediction and coefficients carry the stamp of the instant that they are for, one T_s after the odometry that they
    rest on. The correction is the predicted state less the car's own step from that odometry. Both are held until the
    odometry is older than ``max_age`` (s); then the nominal car is driven.
    """

    NOMINAL = "nominal car"
    ADAPTED = "adapted coefficients"
    CORRECTED = "nominal car, corrected"

    def __init__(self, vehicle: Vehicle, max_age: float) -> None:
        super().__init__("predictor", CarModel.at_any_speed(vehicle), vehicle.nominal)
        self._model = HorizonModel(self.car, 1)
        self._period = round(vehicle.sampling_time * 1e9)
        self._max_age = max_age * 1e9
        self._lower, self._upper = vehicle.lower, vehicle.upper
        self._nothing = ModelOutput(self.calibrated, self.NOMINAL, np.inf)
        # all by the predicted instant (ns)
        self._theta: dict[int, Vector] = {}
        self._state: dict[int, Vector] = {}
        self._start: dict[int, tuple[Vector, Context]] = {}
        self.output = self._nothing
        """What :meth:`read` hands on."""

    def predicted(self, stamp: int, state: Sequence[float]) -> str:
        """Takes a predicted ``v_x, v_y, omega`` for the instant ``stamp`` (ns). Returns what is wrong with it, else
        nothing.
        """
        values = np.array(state, dtype=np.float64)
        if not np.all(np.isfinite(values)):
            return f"state {', '.join(f'{value:g}' for value in values)}; expected finite numbers"
        self._state[stamp] = values
        return ""

    def adapted(self, stamp: int, theta: Mapping[str, float]) -> str:
        """Takes the coefficients behind the prediction for the instant ``stamp`` (ns). Returns what is wrong with them,
        else nothing.
        """
        missing = [name for name in COEFFICIENTS if name not in theta]
        if missing:
            return f"{', '.join(missing)} missing; expected all of {' '.join(COEFFICIENTS)}"
        values = np.array([theta[name] for name in COEFFICIENTS], dtype=np.float64)
        for name, value, low, high in zip(COEFFICIENTS, values, self._lower, self._upper, strict=True):
            slack = _ROUNDING * (high - low)
            if not low - slack <= value <= high + slack:  # what is not a number neither
                return f"{name} = {value:g}; expected {low:.4g} to {high:.4g}, the bounds of the vehicle file"
        self._theta[stamp] = values
        return ""

    def start(
        self, pose: Pose, seen: State, applied: Applied, context: Context, effect_states: Vector | None
    ) -> Vector:
        """The controller's state, ``(size,)``. Without ``effect_states`` these are settled in the ``context`` of
        now.
        """
        if effect_states is None:
            car, theta = self.car, Coefficients(*self.output.adapted.theta.tolist())
            around = dict(zip(CONTEXT, context, strict=True)) | pose._asdict()
            settled = car.under(SCALAR).settled(seen, applied, theta, context=around)
            effect_states = np.array([settled[name] for name in car.effect_states])
        return np.array([*pose, *seen, *applied, *effect_states])

    def measured(self, stamp: int, x: Vector, context: Context) -> None:
        """Notes the controller's state ``x`` ``(size,)`` and the context at the odometry of ``stamp`` (ns), where its
        prediction starts.

        The actuators in it are those that act from then on.
        """
        self._start[stamp + self._period] = x, context

    def update(self, stamp: int) -> None:
        """Chooses what holds for the odometry at ``stamp`` (ns); what is too old for it, or not of its time, is dropped.

        Coefficients go before none, those with a correction before those without, new before old.
        """
        following = stamp + self._period
        kept: tuple[dict[int, Any], ...] = (self._theta, self._state, self._start)
        for each in kept:
            for k in [k for k in each if abs(following - k) > self._max_age]:
                del each[k]
        correctable = self._state.keys() & self._start.keys()
        if not (candidates := self._theta.keys() | correctable):
            self.output = self._nothing
            return
        best = max(candidates, key=lambda k: (k in self._theta, k in correctable, k))
        theta = self._theta.get(best, self._nothing.adapted.theta)
        correction = self._correction(best, theta) if best in correctable else np.zeros(3)
        source = self.ADAPTED if best in self._theta else self.CORRECTED
        self.output = ModelOutput(Adapted(theta, correction), source, (following - best) / 1e9)

    def read(self, rows: Vector, previous: Plan | None) -> Adapted:
        """What was chosen last; see :class:`~dynssm_ros.control.prediction_model.PredictionModel`."""
        return self.output.adapted

    def ahead(self, x: Vector, context: Context, adapted: Adapted, increments: Vector = _HELD) -> Vector:
        """The state one T_s after ``x`` ``(size,)`` with ``increments`` ``(2,)`` of the actuators, which else are
        held.
        """
        return self._model.step(x, increments, np.concatenate([*adapted, context]))

    def forget(self) -> None:
        """Drops everything that was heard and measured, as after a jump of time."""
        self._theta.clear()
        self._state.clear()
        self._start.clear()
        self.output = self._nothing

    def _correction(self, stamp: int, theta: Vector) -> Vector:
        """What the prediction for ``stamp`` adds to the car's own step with ``theta``; none if that is not finite."""
        correction = self._state[stamp] - self.ahead(*self._start[stamp], Adapted(theta, np.zeros(3)))[VELOCITIES]
        return correction if np.all(np.isfinite(correction)) else np.zeros(3)
