"""Nonlinear model predictive control of a car on a track, one quadratic program per control step (real-time
iteration).

The plan of the step before, moved on, is where dynamics, borders and reference are linearised (multiple shooting). The
states are then eliminated: left to optimise are the ``2 N`` increments of throttle and steering and a slack per soft
constraint. :mod:`dynssm_ros.control.program` has what is minimised, and what bounds it.

A plan that steers to the stop and still goes beyond a soft bound may be a local optimum. Then it is improved by a
second program, and a few other manoeuvres are driven ahead by the model. The best is the plan if the model, not
linearised, says that it is clearly better.

Ugray et al., "Scatter search and local NLP solvers: a multistart framework for global optimization", 2007.
Diehl, Bock, Schlöder, "A real-time iteration scheme for nonlinear optimization in optimal feedback control", 2005.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product
from typing import Literal, NamedTuple

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.control.buffered import QuadraticSolver
from dynssm_ros.control.caution import Margins
from dynssm_ros.control.horizon_model import CONTEXT, INPUTS, PARAMETERS, HorizonModel
from dynssm_ros.control.program import DELTA, V_X, HorizonProgram, R, Whereabouts
from dynssm_ros.control.reference import Reference
from dynssm_ros.control.settings import Settings
from dynssm_ros.track.tracks import Track
from dynssm_ros.vehicle import COEFFICIENTS, Applied
from dynssm_ros.vehicle.parameters import InputLimits

Status = Literal["solved", "infeasible", "late"]

_FIRST_ROUNDS = 10  # programs that the first plan takes to settle
_AT_STOP = 0.01  # rad
_BEYOND = 1e-3  # wheelbases or rad: less is the solver's tolerance
_CLEARLY = 0.2  # share of its cost by which a plan is to be undercut

_STEERING = (-1.0, -0.4, 0.0, 0.4, 1.0)  # shares of the range on that side to which manoeuvres turn, and hold
_BRAKES = (False, True)  # the throttle is held, or the brakes are full on
COUNT = len(_STEERING) * len(_BRAKES)  # of manoeuvres


class Adapted(NamedTuple):
    """What a model says of the steps of the horizon."""

    theta: Vector  # coefficients, (17,) for all steps or (N, 17)
    correction: Vector  # added to the stepped v_x, v_y, omega (m/s, m/s, rad/s), (3,) or (N, 3)

    @property
    def first(self) -> Adapted:
        """What it says of the first step, ``(17,)`` and ``(3,)``."""
        return Adapted(*(part if part.ndim == 1 else part[0] for part in self))


@dataclass(frozen=True)
class Plan:
    """A horizon."""

    x: Vector  # states in the order of STATES and the car's effect states, (N + 1, size)
    u: Vector  # increments of throttle (fraction) and steering (rad), (N, 2)
    status: Status = "solved"  # whether it was solved, or why it is the plan before, moved on
    beyond: float = 0.0  # how far a step goes at most beyond a border (wheelbases) or a bound on the slip (rad)

    def shifted(self) -> Plan:
        """The same plan one step later; the last step is repeated with the inputs held."""
        return Plan(np.concatenate([self.x[1:], self.x[-1:]]), np.concatenate([self.u[1:], np.zeros((1, len(INPUTS)))]))


class Nmpc:
    """The controller of one car on one track; it remembers its last plan. A plan is late by ``clock``, the time now
    (s).
    """

    def __init__(
        self,
        model: HorizonModel,
        limits: InputLimits,
        reference: Reference,
        track: Track,
        settings: Settings,
        *,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        if model.N != settings.N:
            raise ValueError(f"the model has {model.N} steps, the settings {settings.N}")
        self.model = model
        self.settings = settings
        self._program = HorizonProgram(model, limits, reference, track, settings)
        self._clock = clock
        self._plan: Plan | None = None
        self._solver = QuadraticSolver(self._program.variables, self._program.rows)

    @property
    def previous(self) -> Plan | None:
        """The plan as it stands before the next step: the last one, moved on."""
        return None if self._plan is None else self._plan.shifted()

    def follow(self, reference: Reference) -> None:
        """From now on follows the same line at another speed."""
        self._program = replace(self._program, reference=reference)

    def forget(self) -> None:
        """Drops the last plan."""
        self._plan = None

    def plan(
        self,
        now: Vector,
        adapted: Adapted,
        t: float = 0.0,
        began: float | None = None,
        margins: Margins | None = None,
    ) -> Plan:
        """Plans from ``now`` on. The plan is finite and within the actuators' limits, whatever came in; what is not
        finite in ``now`` is taken as it was planned.

        Args:
            now: present state in the order of ``STATES`` and the car's effect states, ``(size,)``.
            adapted: what the model says.
            t: time since the start of the drive (s), for effects that read it.
            began: when the control step began, by the clock, to which the deadline counts; now if not given.
            margins: by which borders and bounds on the slip are moved inwards; none if not given.
        """
        began = self._clock() if began is None else began
        margins = Margins.none(self.settings.N) if margins is None else margins
        first, sound = self._plan is None, bool(np.all(np.isfinite(now)))
        if not sound:  # what is not measured is taken as it was planned
            now = np.where(np.isfinite(now), now, 0.0 if self._plan is None else self._plan.x[1])
        self._locate(now)
        guess = self._first_guess(now) if self._plan is None else self._plan.shifted()
        plan = guess if sound else None
        for _ in range(_FIRST_ROUNDS if first else 1):
            plan = None if plan is None else self._improved(now, plan, adapted, t, margins)
        if plan is None:
            plan = self._held(now, guess, adapted, t, "infeasible")
        elif self._may_be_caught(plan):
            plan = self._elsewhere(now, plan, adapted, t, margins)
        self._plan = plan if sound or not first else None
        if not first and self._clock() - began > self.settings.deadline:
            return self._held(now, guess, adapted, t, "late")
        return plan

    def following(self, x: Vector, u: Vector, adapted: Adapted, t: float = 0.0) -> Vector:
        """The states one T_s after ``x``, ``(size,)`` or ``(n, size)``, with the increments ``u`` ``(2,)``, by the
        model and not linearised.

        ``adapted`` is of a horizon, whose first step it is, or for ``n`` states one each; ``t`` as of :meth:`plan`.
        """
        first = slice(0, 1) if x.ndim == 1 else slice(None)
        parts = [np.atleast_2d(part)[first] for part in adapted]
        context = np.broadcast_to([t, *self._place()], (len(parts[0]), len(CONTEXT)))
        p = np.concatenate([*parts, context], axis=1)
        return self.model.step(x, u, p[0] if x.ndim == 1 else p)

    def command(self, plan: Plan) -> Applied:
        """Absolute throttle and steering of the plan's first step, within the limits."""
        now = Applied(plan.x[0, R], plan.x[0, DELTA])
        wanted = Applied(now.r + plan.u[0, 0], now.delta + plan.u[0, 1])  # within the solver's tolerance of 1e-6
        return self._program.limits.reached(wanted, now, self.model.car.T_s)

    def _locate(self, now: Vector) -> None:
        program, last = self._program, None if self._plan is None else self._program.at
        on_track = float(program.track.project(now[:2], None if last is None else last.on_track)[0])
        on_line = float(program.reference.project(now[:2], None if last is None else last.on_line))
        due = on_line if last is None else float(program.reference.ahead(last.scheduled, program.times(0)[1:2])[0])
        late = float(np.clip(due - on_line, -self.settings.lag_bound, self.settings.lag_bound))
        self._program = replace(program, at=Whereabouts(on_track, on_line, on_line + late))

    def _first_guess(self, now: Vector) -> Plan:
        """Along the reference at its own speed."""
        N, line = self.settings.N, self._program.reference.line
        s = self._program.reference.within_reach(self._program.at.on_line, self._program.times(0), float(now[V_X]))
        x = np.tile(now, (N + 1, 1))
        x[1:, :2] = line.position(s)[1:]
        heading = line.heading(s)
        x[1:, 2] = now[2] + np.cumsum((np.diff(heading) + np.pi) % (2 * np.pi) - np.pi)
        x[:-1, V_X] = np.diff(s) / self.model.car.T_s
        u = np.zeros((N, len(INPUTS)))
        if (
            self._program.limits.set_point == "speed"
        ):  # far from the speed its controller is at its limit, with no slope
            u[:, 0] = np.diff(x[:-1, V_X], prepend=now[R])
            x[1:, R] = x[:-1, V_X]
        return Plan(x, u)

    def _parameters(self, adapted: Adapted, t: float) -> Vector:
        p = np.empty((self.settings.N, PARAMETERS))
        p[:, : len(COEFFICIENTS)] = adapted.theta
        p[:, len(COEFFICIENTS) : -len(CONTEXT)] = adapted.correction
        p[:, -len(CONTEXT)] = t + self._program.times(0)[:-1]
        p[:, 1 - len(CONTEXT) :] = self._place()
        return p

    def _place(self) -> list[float]:
        return list(self._program.track.centre.place(self._program.at.on_track).values())

    @np.errstate(over="ignore", invalid="ignore")  # what comes of it is looked at
    def _improved(self, now: Vector, guess: Plan, adapted: Adapted, t: float, margins: Margins) -> Plan | None:
        """The solution of the program around ``guess``; ``None`` if there is none."""
        x = np.concatenate([now[None], guess.x[1:]])
        p = self._parameters(adapted, t)
        following, by_x, by_u = self.model.linearised(x[:-1], guess.u, p)
        if not all(np.all(np.isfinite(each)) for each in (following, by_x, by_u)):
            return None
        offset, slope = _condensed(x, guess.u, following, by_x, by_u)
        program = self._program.of(x, offset, slope, p, margins)
        if not all(np.all(np.isfinite(each)) for each in program[:3]):
            return None
        u, slack = self._program.parts(self._solver.solve(program))
        states = offset + slope @ u
        if not (np.all(np.isfinite(u)) and np.all(np.isfinite(states))):
            return None
        return Plan(states, u.reshape(-1, len(INPUTS)), beyond=float(np.max(slack)))

    def _may_be_caught(self, plan: Plan) -> bool:
        """Whether a plan goes beyond a soft bound although it steers to the stop."""
        if plan.beyond < _BEYOND:
            return False
        right, left = self._program.limits.steering
        steering = plan.x[1:, DELTA]
        return bool(np.any((steering < right + _AT_STOP) | (steering > left - _AT_STOP)))

    @np.errstate(over="ignore", invalid="ignore")
    def _elsewhere(self, now: Vector, plan: Plan, adapted: Adapted, t: float, margins: Margins) -> Plan:
        """``plan``, the same after another program, or another manoeuvre that is clearly better."""
        p = self._parameters(adapted, t)
        again = self._improved(now, plan, adapted, t, margins) or plan
        others = manoeuvres(Applied(now[R], now[DELTA]), self._program.limits, self.settings.N, self.model.car.T_s)
        u = np.concatenate([[plan.u, again.u], others])
        x = self._driven(now, u, p)
        costs = self._program.costs(x, u, p, margins)
        own, best = int(np.argmin(costs[:2])), 2 + int(np.argmin(costs[2:]))
        if costs[own] - costs[best] > _CLEARLY * abs(costs[own]):
            return Plan(x[best], u[best])
        return (plan, again)[own]

    def _driven(self, now: Vector, u: Vector, p: Vector) -> Vector:
        """Where increments ``u`` ``(M, N, 2)`` lead by the model, not linearised: states ``(M, N + 1, size)``."""
        x = np.empty((len(u), len(p) + 1, len(now)))
        x[:, 0] = now
        for k, parameters in enumerate(p):
            x[:, k + 1] = self.model.step(x[:, k], u[:, k], parameters)
        return x

    def _held(self, now: Vector, guess: Plan, adapted: Adapted, t: float, status: Status) -> Plan:
        """The inputs of ``guess`` from ``now`` on, within the limits, and where they lead."""
        x, u = np.tile(now, (self.settings.N + 1, 1)), np.zeros_like(guess.u)
        for k, p in enumerate(self._parameters(adapted, t)):
            u[k] = np.subtract(
                self._program.limits.clamped(Applied(*(x[k, [R, DELTA]] + guess.u[k]))), x[k, [R, DELTA]]
            )
            following = self.model.step(x[k], u[k], p)
            x[k + 1] = following if np.all(np.isfinite(following)) else guess.x[k + 1]
        return Plan(x, u, status)


def _condensed(x: Vector, u: Vector, following: Vector, by_x: Vector, by_u: Vector) -> tuple[Vector, Vector]:
    """Eliminates the states: they are ``offset + slope @ increments``, of ``(N + 1, size)`` and ``(N + 1, size, 2
    N)``.
    """
    N, size = len(u), x.shape[1]
    gaps = following - np.einsum("kij,kj->ki", by_x, x[:-1]) - np.einsum("kij,kj->ki", by_u, u)
    offset, slope = np.empty((N + 1, size)), np.zeros((N + 1, size, 2 * N))
    offset[0] = x[0]
    for k in range(N):
        offset[k + 1] = by_x[k] @ offset[k] + gaps[k]
        slope[k + 1] = by_x[k] @ slope[k]
        slope[k + 1, :, 2 * k : 2 * k + 2] += by_u[k]
    return offset, slope


def manoeuvres(now: Applied, limits: InputLimits, N: int, T_s: float) -> Vector:
    """Starting points where the last plan may be caught, from what the actuators do ``now``.

    With the front wheels beyond the slip that their tyres make use of, no small change of a plan leads out of a turn that
    has become too tight, where a large one does, such as steering to the other side at once.

    Returns:
        Increments of throttle (fraction) and steering (rad) within ``limits``, in steps of ``T_s`` (s), ``(COUNT, N, 2)``.
    """
    increments = np.zeros((COUNT, N, 2))
    right, left = limits.steering
    reach = limits.steering_rate * T_s * np.arange(1, N + 1)
    for each, (share, brakes) in zip(increments, product(_STEERING, _BRAKES), strict=True):
        turn = share * left if share >= 0 else -share * right
        each[:, 1] = np.diff(now.delta + np.clip(turn - now.delta, -reach, reach), prepend=now.delta)
        if brakes:
            each[0, 0] = limits.full_brakes - now.r
    return increments
