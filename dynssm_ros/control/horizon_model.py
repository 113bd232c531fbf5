"""The car inside the controller: the package's one single-track source, stepped and differentiated by casadi."""

from __future__ import annotations

from itertools import islice
from typing import Any, Literal, NamedTuple

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.control.buffered import BufferedRows
from dynssm_ros.vehicle import COEFFICIENTS, Applied, CarModel, Coefficients, State
from dynssm_ros.vehicle.effects.base import PLACE, SLOWEST
from dynssm_ros.vehicle.kinematics import Pose, advance_pose
from dynssm_ros.vehicle.single_track import at_least

STATES = ("x", "y", "theta", "v_x", "v_y", "omega", "r", "delta")
"""Pose (m, m, rad), velocities (m/s, m/s, rad/s), what the actuators do (fraction, rad). The effects' own follow."""
VELOCITIES = slice(STATES.index("v_x"), STATES.index("omega") + 1)
MOVING = slice(STATES.index("v_x"), len(STATES))
"""Velocities and actuators: what a window's row begins with."""
INPUTS = ("increment of r", "increment of delta")
Travel = Literal["start", "middle"]
"""Which velocity and heading carry a car over a step: those at its start, as forward Euler does in the published data, or
those at its middle, as on a road."""
CONTEXT = ("t", *PLACE)
"""What effects may read beside the pose: time (s), track position and length of the lap (m)."""
PARAMETERS = len(COEFFICIENTS) + 3 + len(CONTEXT)
"""Per step: the 17 coefficients, the correction of ``v_x, v_y, omega``, the context."""


class _Symbols(NamedTuple):
    """State and parameters of a step as casadi symbols."""

    pose: Pose
    state: State
    applied: Applied
    effect_states: dict[str, Any]
    theta: Coefficients
    correction: State
    context: dict[str, Any]


class HorizonModel:
    """One step of ``car`` and its Jacobians, for all ``N`` steps of a horizon at once.

    The velocities move by the single-track step plus the correction, the pose by the velocities. States ``x`` are in
    the order of ``STATES`` and the car's effect states; ``u`` are increments of throttle and steering; ``p`` is
    coefficients, correction and context.

    Args:
        car: what is stepped.
        N: steps of the horizon.
        travel: what carries the pose; a matter of the world, and not of what a model knows of the car.
        slowest: speed (m/s) up to which slip angles are those of this speed; slower wheels roll.
    """

    def __init__(self, car: CarModel, N: int, travel: Travel = "middle", slowest: float = SLOWEST) -> None:
        self.car = car
        self.N = N
        self._travel = travel
        self.size = len(STATES) + len(car.effect_states)
        import casadi as ca  # takes a while, and most of the command line does without

        x, u, p = ca.SX.sym("x", self.size), ca.SX.sym("u", len(INPUTS)), ca.SX.sym("p", PARAMETERS)
        following = self._following(x, u, p)
        outputs = [following, ca.jacobian(following, x), ca.jacobian(following, u)]
        self._step = ca.Function("step", [x, u, p], [ca.densify(following)])
        self._steps: dict[int, BufferedRows] = {}  # by how many states are stepped at once
        stages = ca.Function("stage", [x, u, p], [ca.densify(each) for each in outputs], {"cse": True})
        self._stages = BufferedRows(stages, N)
        slips = self._slip_angles(x, p, slowest)
        self._slips = BufferedRows(
            ca.Function("slip", [x, p], [ca.densify(slips), ca.densify(ca.jacobian(slips, x))]), N
        )

    def step(self, x: Vector, u: Vector, p: Vector) -> Vector:
        """The states one step on, shaped as ``x``, which is ``(size,)`` or ``(n, size)``; ``u`` ``(2,)`` or ``(n, 2)``,
        ``p`` alike.
        """
        count = len(np.atleast_2d(x))
        if count not in self._steps:
            self._steps[count] = BufferedRows(self._step, count)
        return self._steps[count](x, u, p)[0].reshape(x.shape)

    def linearised(self, x: Vector, u: Vector, p: Vector) -> tuple[Vector, Vector, Vector]:
        """All steps at their own points ``x`` ``(N, size)``, ``u`` ``(N, 2)``, ``p`` ``(N, PARAMETERS)``.

        Returns:
            The states after them and the Jacobians by state and input: ``(N, size)``, ``(N, size, size)``, ``(N, size,
                2)``.
        """
        following, by_x, by_u = self._stages(x, u, p)
        return (
            following,
            by_x.reshape(self.N, self.size, self.size).transpose(0, 2, 1),
            by_u.reshape(self.N, len(INPUTS), self.size).transpose(0, 2, 1),
        )

    def slip_angles(self, x: Vector, p: Vector) -> tuple[Vector, Vector]:
        """Slip angles of front and rear axle (rad) of ``x`` ``(N, size)`` with effects and shifts, ``(N, 2)``; Jacobian
        ``(N, 2, size)``.
        """
        slips, by_x = self._slips(x, p)
        return slips, by_x.reshape(self.N, self.size, 2).transpose(0, 2, 1)

    def _slip_angles(self, x: Any, p: Any, slowest: float) -> Any:
        import casadi as ca

        car, at = self.car.under(ca), self._split(x, p)
        moving = at.state._replace(v_x=at_least(at.state.v_x, slowest))
        state = car.true_state(moving, at.effect_states)
        q = car.motion(state, at.applied, at.theta, at.effect_states, context=at.context, h=car.T_s)
        return ca.vertcat(q.alpha_f, q.alpha_r)

    def _split(self, x: Any, p: Any) -> _Symbols:
        """State and parameters as the equations take them."""
        import casadi as ca

        x_pos, y_pos, heading, *moving = ca.vertsplit(x)
        parameters = iter(ca.vertsplit(p))
        theta, correction, context = (list(islice(parameters, n)) for n in (len(COEFFICIENTS), 3, len(CONTEXT)))
        return _Symbols(
            Pose(x_pos, y_pos, heading),
            State(*moving[:3]),
            Applied(*moving[3:5]),
            dict(zip(self.car.effect_states, moving[5:], strict=True)),
            Coefficients(*theta),
            State(*correction),
            {"x": x_pos, "y": y_pos, "theta": heading, **dict(zip(CONTEXT, context, strict=True))},
        )

    def _following(self, x: Any, u: Any, p: Any) -> Any:
        import casadi as ca

        car, at = self.car.under(ca), self._split(x, p)
        now, applied = at.state, Applied(at.applied.r + u[0], at.applied.delta + u[1])
        state, effect_states = car.step(now, applied, at.theta, at.effect_states, context=at.context)
        state = State(*(value + by for value, by in zip(state, at.correction, strict=True)))
        share = 0.5 if self._travel == "middle" else 0.0
        pose = advance_pose(ca, at.pose, now, state, car.T_s, share=share)
        return ca.vertcat(*pose, *state, *applied, *(effect_states[name] for name in car.effect_states))
