"""Any model behind the controller: what it says of the present becomes coefficients and a correction for the horizon."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.control.buffered import BufferedRows
from dynssm_ros.control.horizon_model import INPUTS, MOVING, STATES
from dynssm_ros.control.nmpc import Adapted, Plan
from dynssm_ros.runtime.contract import WindowModel
from dynssm_ros.runtime.learner import OnlineLearner
from dynssm_ros.runtime.onnx_model import OnnxModel
from dynssm_ros.runtime.rollout import RolloutCorrection
from dynssm_ros.signals.inputs import WINDOW_COLUMNS, applied_inputs
from dynssm_ros.vehicle import COEFFICIENTS, CarModel, Coefficients, State, Vehicle


class PredictionModel(Protocol):
    """What the controller asks of a model."""

    name: str
    car: CarModel  # the physics that its coefficients are for
    H: int  # rows of history that it reads; 0: none
    calibrated: Adapted  # the car without what the model says: what drives while that has earned nothing

    def read(self, rows: Vector, previous: Plan | None) -> Adapted:
        """Coefficients and correction for the horizon.

        Args:
            rows: history with the columns ``WINDOW_COLUMNS``, the present last, ``(k, 7)``; its last command is the
                last plan's for now.
            previous: the last plan as it stands now; ``None`` at the start.
        """

    def learn(self, rows: Vector) -> None:
        """Takes the history once the command in its last row is the one that was sent; once for each row."""

    def interrupt(self) -> None:
        """The next row is not one T_s after the last one."""


class Fixed:
    """Coefficients that never change, and no correction."""

    H = 0

    def __init__(self, name: str, car: CarModel, theta: Vector) -> None:
        self.name = name
        self.car = car
        self.calibrated = Adapted(theta, np.zeros(3))

    def read(self, rows: Vector, previous: Plan | None) -> Adapted:
        """The same, whatever happens."""
        return self.calibrated

    def learn(self, rows: Vector) -> None:
        """Nothing is learned."""

    def interrupt(self) -> None:
        """Nothing is remembered."""


class Adaptive:
    """A model that reads a history window and predicts the next state.

    Its coefficients, and what it adds to the single-track step with them, hold over the horizon. The nominal car drives
    until the window is full, and as the physics of a model without coefficients.

    Args:
        model: the model. Its online layer, if it has one, learns from row to row.
        vehicle: the car as it is known.
        along_horizon: reads the model anew at each step of the last plan, as if that had been driven.
        as_is: steps the model's own physics in any case, and not only if its training has calibrated that. Else the car
            is stepped as it is known, and what the model says beyond that is added, as in the controller node.
    """

    def __init__(self, model: WindowModel, vehicle: Vehicle, along_horizon: bool = False, as_is: bool = False) -> None:
        card, own = model.card, model.vehicle or vehicle
        self._is_own = as_is or card is None or own.integrator is not None
        if not self._is_own:
            own = vehicle
        self.name = model.name
        self._learner: OnlineLearner | None = None
        if isinstance(model, OnnxModel) and model.online is not None:
            self._learner = OnlineLearner(model, model.online, judges=False)
        self.H = model.H
        stepping = (card.integrator, card.substeps) if card is not None and self._is_own else ()
        self.car = CarModel.at_any_speed(own, *stepping)
        self._step = _compiled_step(self.car)
        self._model = model
        self._along_horizon = along_horizon
        self.calibrated = Adapted(own.nominal, np.zeros(3))

    def read(self, rows: Vector, previous: Plan | None) -> Adapted:
        """See :class:`PredictionModel`. What is not finite is replaced by the nominal car."""
        if len(rows) < self.H:
            return self.calibrated
        windows = rows[None, -self.H :]
        if self._along_horizon and previous is not None:
            ahead = np.concatenate([rows, _planned_rows(previous)])
            first = len(rows) - self.H
            windows = np.stack([ahead[k : k + self.H] for k in range(first, first + len(previous.u))])
        adapted = self._of(self._read_by(windows))
        return adapted if all(np.all(np.isfinite(part)) for part in adapted) else self.calibrated

    def learn(self, rows: Vector) -> None:
        """See :class:`PredictionModel`."""
        if self._learner is not None and len(rows) >= self.H:
            self._learner.predict(self._read_by(rows[None, -self.H :])[0].copy())

    def interrupt(self) -> None:
        """See :class:`PredictionModel`."""
        if self._learner is not None:
            self._learner.interrupt()

    def _read_by(self, windows: Vector) -> Vector:
        """Windows as the model was trained on them."""
        if self._model.commands != "none":
            return windows
        windows = windows.copy()
        windows[..., 5:] = 0.0
        return windows

    def _of(self, windows: Vector) -> Adapted:
        """What the model says of windows ``(n, H, 7)``."""
        said = self._model.predict(windows)
        if self._learner is not None:
            assert said.seen is not None
            known = self._learner.learned(said.seen).at(np.zeros(len(windows), dtype=np.intp))
            said = RolloutCorrection(self._learner.layer, known).corrected(said, windows)._replace(physics=None)
        theta = self.calibrated.theta if said.theta is None else said.theta
        if self._is_own and said.physics is not None:
            physics = said.physics
        elif len(windows) == 1:
            physics = self._step(windows[0, -1], np.ravel(theta))[0]
        else:
            physics = stepped(self.car, windows[:, -1], theta)
        correction = said.state - physics
        if len(windows) == 1:
            return Adapted(np.atleast_2d(theta)[0], correction[0])
        return Adapted(theta, correction)


def stepped(car: CarModel, rows: Vector, theta: Vector) -> Vector:
    """Next states of ``car`` (m/s, m/s, rad/s), ``(k, 3)``, from ``rows`` ``(k, 7)`` with the columns
    ``WINDOW_COLUMNS`` and ``theta`` ``(17,)`` or ``(k, 17)``.
    """
    return np.reshape(_step(car, rows.T, np.transpose(theta)), (3, -1)).T


def _compiled_step(car: CarModel) -> BufferedRows:
    """:func:`stepped` of one row ``(7,)`` and its coefficients ``(17,)``: each control step asks for it."""
    import casadi as ca  # takes a while, and most of the command line does without

    row, theta = ca.SX.sym("row", len(WINDOW_COLUMNS)), ca.SX.sym("theta", len(COEFFICIENTS))
    following = _step(car.under(ca), ca.vertsplit(row), ca.vertsplit(theta))
    return BufferedRows(ca.Function("step", [row, theta], [ca.densify(ca.vertcat(*following))]), 1)


def _step(car: CarModel, now: Any, theta: Any) -> State:
    """The next state, from the columns of rows and of their coefficients."""
    return car.step(State(*now[:3]), applied_inputs(now), Coefficients(*theta))[0]


def _planned_rows(plan: Plan) -> Vector:
    """Window rows of the plan's steps after the first, shape ``(N - 1, 7)``."""
    return np.concatenate([plan.x[1:-1, MOVING], plan.u[1:]], axis=1)


assert WINDOW_COLUMNS[:5] == (*STATES[3:6], "r_fb", "delta_fb"), "a window's row begins like the controller's state"
assert len(INPUTS) == 2, "and ends with the increments"
