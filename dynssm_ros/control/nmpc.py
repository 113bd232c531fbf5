"""Nonlinear model predictive control of a car on a track, one quadratic program per control step (real-time iteration).

The plan of the step before, moved on by one step, is where dynamics, borders and reference are linearised (multiple
shooting: its gaps are closed by the program). The states are then eliminated, so that what is left to optimise are the
``2 N`` increments of throttle and steering and a slack per soft constraint: a dense program for an active-set solver.

Actuator limits are hard; the borders, the slip of both axles, and the speed at the end of the horizon where the objective
asks for it are soft with a linear penalty, so that a program is feasible wherever the car is.

A plan that steers to the stop may be a local optimum that a car should not stay in. Then it is improved by a second program,
and beside it a few other manoeuvres are driven ahead by the model (:mod:`dynssm_ros.control.manoeuvres`). The best of them
is the plan if the model, driven and not linearised, says that it is clearly better.

Tracking follows a reference time: the place where a car that keeps the line's own time would be now. One that is behind is
asked to catch up, one that is ahead to wait. The reference is at most ``lag_bound`` away (MPCC: a bound on the lag error),
so that time that cannot be made up for is given up.

Diehl, Bock, Schlöder, "A real-time iteration scheme for nonlinear optimization in optimal feedback control", 2005.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.control.buffered import QuadraticProgram
from dynssm_ros.control.caution import Margins
from dynssm_ros.control.horizon_model import CONTEXT, INPUTS, PARAMETERS, STATES, HorizonModel
from dynssm_ros.control.manoeuvres import manoeuvres
from dynssm_ros.control.reference import Reference
from dynssm_ros.control.settings import Settings
from dynssm_ros.track.tracks import Track
from dynssm_ros.vehicle import COEFFICIENTS, Applied
from dynssm_ros.vehicle.parameters import InputLimits

Status = Literal["solved", "infeasible", "late"]

V_X, R, DELTA = (STATES.index(name) for name in ("v_x", "r", "delta"))
_ROAD_LEFT, _SLIP_LEFT = 0.5, 0.5  # shares of the road and of the slip's bound that no caution takes
_FIRST_ROUNDS = 10  # programs that the first plan takes to settle
_AT_STOP = 0.01  # rad
_BEYOND = 1e-3  # wheelbases or rad: less is the solver's tolerance
_CLEARLY = 0.2  # share of its cost by which a plan is to be undercut


class Adapted(NamedTuple):
    """What a model says of the steps of the horizon."""

    theta: Vector
    """Coefficients, shape ``(17,)`` for all steps or ``(N, 17)``."""
    correction: Vector
    """Added to the stepped ``v_x, v_y, omega`` (m/s, m/s, rad/s), shape ``(3,)`` or ``(N, 3)``."""

    @property
    def first(self) -> Adapted:
        """What it says of the first step, shapes ``(17,)`` and ``(3,)``."""
        return Adapted(*(part if part.ndim == 1 else part[0] for part in self))


@dataclass(frozen=True)
class Plan:
    """A horizon.

    Attributes:
        x: states in the order of ``STATES`` and the car's effect states, shape ``(N + 1, size)``.
        u: increments of throttle (fraction) and steering (rad), shape ``(N, 2)``.
        status: whether it was solved, or why it is the plan of the step before, moved on.
        beyond: how far a step goes at most beyond a border (wheelbases) or a bound on the slip (rad).
    """

    x: Vector
    u: Vector
    status: Status = "solved"
    beyond: float = 0.0

    def shifted(self) -> Plan:
        """The same plan one step later; the last step is repeated with the inputs held."""
        return Plan(np.concatenate([self.x[1:], self.x[-1:]]), np.concatenate([self.u[1:], np.zeros((1, len(INPUTS)))]))


class _Program(NamedTuple):
    """What :meth:`QuadraticProgram.solve` takes."""

    H: Vector
    g: Vector
    A: Vector
    low: Vector
    high: Vector
    z_low: Vector
    z_high: Vector


class Nmpc:
    """The controller of one car on one track; it remembers its last plan.

    Args:
        model: the car inside.
        limits: of the actuators.
        reference: the line.
        track: whose borders hold.
        settings: how it works.
        clock: time now (s), of any origin, by which a plan is late.
    """

    def __init__(
        self,
        model: HorizonModel,
        limits: InputLimits,
        reference: Reference,
        track: Track,
        settings: Settings,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        if model.N != settings.N:
            raise ValueError(f"the model has {model.N} steps, the settings {settings.N}")
        self.model = model
        self.settings = settings
        self._limits = limits
        self._reference = reference
        self._track = track
        self._clock = clock
        self._plan: Plan | None = None
        self._on_track = self._on_line = self._scheduled = 0.0
        N = settings.N
        self._variables = 2 * N + N + 1  # increments, slacks of the steps, slack of the end
        self._rows = 2 * N + 2 * N + 4 * N + 1  # actuators, both borders, both axles to both sides, the end
        self._solver = QuadraticProgram(self._variables, self._rows)

    @property
    def previous(self) -> Plan | None:
        """The plan as it stands before the next step: the last one, moved on."""
        return None if self._plan is None else self._plan.shifted()

    def follow(self, reference: Reference) -> None:
        """From now on follows the same line at another speed."""
        self._reference = reference

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
        """Plans from ``now`` on.

        Args:
            now: present state in the order of ``STATES`` and the car's effect states, shape ``(size,)``.
            adapted: what the model says; see :class:`Adapted`.
            t: time since the start of the drive (s), for effects that read it.
            began: when the control step began, by the clock, to which the deadline counts; now if not given.
            margins: by which borders and bounds on the slip are moved inwards; none if not given.

        Returns:
            The plan whose first step is to be driven, from ``now`` with what is not finite in it replaced by what was
            planned. It is finite and within the actuators' limits, whatever came in.
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
        """The states one T_s after ``x`` with the increments ``u``, by the model and not linearised; see :meth:`plan`.

        Args:
            x: ``(size,)``, or ``(n, size)``.
            u: of throttle (fraction) and steering (rad), ``(2,)``.
            adapted: what holds for them: of a horizon, whose first step it is, or for ``n`` states one each.
            t: time since the start of the drive (s).
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
        return self._limits.reached(wanted, now, self.model.car.T_s)

    def _locate(self, now: Vector) -> None:
        near = self._plan is not None
        self._on_track = float(self._track.project(now[:2], self._on_track if near else None)[0])
        self._on_line = float(self._reference.project(now[:2], self._on_line if near else None))
        due = float(self._reference.ahead(self._scheduled, self._times(0)[1:2])[0]) if near else self._on_line
        self._scheduled = self._on_line + float(
            np.clip(due - self._on_line, -self.settings.lag_bound, self.settings.lag_bound)
        )

    def _first_guess(self, now: Vector) -> Plan:
        """Along the reference at its own speed."""
        N, line = self.settings.N, self._reference.line
        s = self._reference.within_reach(self._on_line, self._times(0), float(now[V_X]))
        x = np.tile(now, (N + 1, 1))
        x[1:, :2] = line.position(s)[1:]
        heading = line.heading(s)
        x[1:, 2] = now[2] + np.cumsum((np.diff(heading) + np.pi) % (2 * np.pi) - np.pi)
        x[:-1, V_X] = np.diff(s) / self.model.car.T_s
        return Plan(x, np.zeros((N, len(INPUTS))))

    def _times(self, first: int) -> Vector:
        """Times of the steps ``first`` to ``N`` from now (s)."""
        return np.arange(first, self.settings.N + 1, dtype=np.float64) * self.model.car.T_s

    def _parameters(self, adapted: Adapted, t: float) -> Vector:
        p = np.empty((self.settings.N, PARAMETERS))
        p[:, : len(COEFFICIENTS)] = adapted.theta
        p[:, len(COEFFICIENTS) : -len(CONTEXT)] = adapted.correction
        p[:, -len(CONTEXT)] = t + self._times(0)[:-1]
        p[:, 1 - len(CONTEXT) :] = self._place()
        return p

    def _place(self) -> list[float]:
        return list(self._track.centre.place(self._on_track).values())

    @np.errstate(over="ignore", invalid="ignore")  # what comes of it is looked at
    def _improved(self, now: Vector, guess: Plan, adapted: Adapted, t: float, margins: Margins) -> Plan | None:
        """The solution of the program around ``guess``; ``None`` if there is none."""
        x = np.concatenate([now[None], guess.x[1:]])
        p = self._parameters(adapted, t)
        following, by_x, by_u = self.model.linearised(x[:-1], guess.u, p)
        if not all(np.all(np.isfinite(each)) for each in (following, by_x, by_u)):
            return None
        offset, slope = _condensed(x, guess.u, following, by_x, by_u)
        program = self._program(now, x, offset, slope, p, margins)
        if not all(np.all(np.isfinite(each)) for each in program[:3]):
            return None
        u, slack, _ = np.split(self._solver.solve(*program), [2 * self.settings.N, 3 * self.settings.N])
        states = offset + slope @ u
        if not (np.all(np.isfinite(u)) and np.all(np.isfinite(states))):
            return None
        return Plan(states, u.reshape(-1, len(INPUTS)), beyond=float(np.max(slack)))

    def _may_be_caught(self, plan: Plan) -> bool:
        """Whether a plan goes beyond a soft bound although it steers to the stop."""
        if plan.beyond < _BEYOND:
            return False
        right, left = self._limits.steering
        steering = plan.x[1:, DELTA]
        return bool(np.any((steering < right + _AT_STOP) | (steering > left - _AT_STOP)))

    @np.errstate(over="ignore", invalid="ignore")
    def _elsewhere(self, now: Vector, plan: Plan, adapted: Adapted, t: float, margins: Margins) -> Plan:
        """``plan``, the same after another program, or another manoeuvre that is clearly better."""
        p = self._parameters(adapted, t)
        again = self._improved(now, plan, adapted, t, margins) or plan
        others = manoeuvres(Applied(now[R], now[DELTA]), self._limits, self.settings.N, self.model.car.T_s)
        u = np.concatenate([[plan.u, again.u], others])
        x = self._driven(now, u, p)
        costs = self._costs(x, u, p, margins)
        own, best = int(np.argmin(costs[:2])), 2 + int(np.argmin(costs[2:]))
        if costs[own] - costs[best] > _CLEARLY * abs(costs[own]):
            return Plan(x[best], u[best])
        return (plan, again)[own]

    def _driven(self, now: Vector, u: Vector, p: Vector) -> Vector:
        """Where increments lead by the model, not linearised: states ``(M, N + 1, size)``.

        Args:
            now: the present state, ``(size,)``.
            u: sequences of increments, ``(M, N, 2)``.
            p: parameters of the steps, ``(N, PARAMETERS)``.
        """
        x = np.empty((len(u), len(p) + 1, len(now)))
        x[:, 0] = now
        for k, parameters in enumerate(p):
            x[:, k + 1] = self.model.step(x[:, k], u[:, k], parameters)
        return x

    def _costs(self, x: Vector, u: Vector, p: Vector, margins: Margins) -> Vector:
        """What the program minimises, ``(M,)``; infinite where a state is not finite.

        Args:
            x: states, not linearised, ``(M, N + 1, size)``.
            u: increments that led there, ``(M, N, 2)``.
            p: parameters of the steps, ``(N, PARAMETERS)``.
            margins: as of :meth:`plan`.
        """
        finite = np.all(np.isfinite(x), axis=(1, 2))
        x = np.where(finite[:, None, None], x, x[:, :1])
        w, length, h = self.settings.weights, self.settings.scale.length, self.model.car.T_s / self.settings.scale.time
        at = self._reference_points(x)
        tangent, normal = _directions(self._reference.line.heading(at))
        errors = (x[:, 1:, :2] - self._reference.line.position(at)) / length
        along, across = np.sum(tangent * errors, axis=-1), np.sum(normal * errors, axis=-1)
        s, lateral = self._track.project(x[:, 1:, :2], _along(x[..., :2], self._on_track))
        right, left = self._room(s, margins.lateral)
        outside = np.maximum(lateral - left, -right - lateral) / length
        slips = np.array([self.model.slip_angles(each[1:], p)[0] for each in x])
        slipping = np.max(np.abs(slips) - self._slip_bounds(margins.slip), axis=-1)
        each_step = w.along * along**2 + w.across * across**2 + w.border * _soft(np.maximum(outside, slipping))
        costs = np.sum(h * each_step + u**2 @ [w.throttle, w.steering] / h, axis=-1)
        costs += w.terminal_across * across[:, -1] ** 2
        if w.progress > 0:
            costs -= w.progress * (along[:, -1] + (at[..., -1] - self._on_line) / length)
        if w.terminal_speed > 0:
            too_fast = x[:, -1, V_X] - self._reference.terminal_speed_at(at[..., -1])
            costs += w.terminal_speed * _soft(too_fast * self.settings.scale.time / length)
        return np.where(finite, costs, np.inf)

    def _program(
        self, now: Vector, guess: Vector, offset: Vector, slope: Vector, p: Vector, margins: Margins
    ) -> _Program:
        """The program in increments and slacks; states are ``offset + slope @ increments``."""
        N, w = self.settings.N, self.settings.weights
        positions, moves = offset[1:, :2], slope[1:, :2]
        at = self._reference_points(guess)
        point, heading = self._reference.line.position(at), self._reference.line.heading(at)
        tangent, normal = _directions(heading)
        H, g = np.zeros((self._variables,) * 2), np.zeros(self._variables)
        length, h = self.settings.scale.length, self.model.car.T_s / self.settings.scale.time
        along, across = np.full(N, h * w.along), np.full(N, h * w.across)
        across[-1] += w.terminal_across
        for direction, weights in ((tangent, along), (normal, across)):
            scale = np.sqrt(2 * weights) / length
            errors = scale * np.einsum("ki,ki->k", direction, positions - point)
            by_u = scale[:, None] * np.einsum("ki,kij->kj", direction, moves)
            H[: 2 * N, : 2 * N] += by_u.T @ by_u
            g[: 2 * N] += by_u.T @ errors
        g[: 2 * N] -= w.progress * tangent[-1] @ moves[-1] / length
        rates = np.tile([w.throttle, w.steering], N) / h
        H[np.diag_indices(self._variables)] += 2 * np.concatenate(
            [rates, np.full(N, h * w.border), [max(w.terminal_speed, 1.0)]]
        )
        g[2 * N : 3 * N] = h * w.border
        g[3 * N] = w.terminal_speed

        A = np.zeros((self._rows, self._variables))
        low, high = np.full(self._rows, -np.inf), np.full(self._rows, np.inf)
        for k, (bounds, held) in enumerate(((self._limits.throttle, now[R]), (self._limits.steering, now[DELTA]))):
            rows = slice(k * N, (k + 1) * N)
            A[rows, k : 2 * N : 2] = np.tri(N)
            low[rows], high[rows] = bounds[0] - held, bounds[1] - held
        borders, slips = slice(2 * N, 4 * N), slice(4 * N, 8 * N)
        self._add_borders(A[borders], low[borders], high[borders], guess, positions, moves, margins.lateral)
        self._add_slip(A[slips], high[slips], guess[1:], offset[1:], slope[1:], p, margins.slip)
        if w.terminal_speed > 0:
            A[-1, : 2 * N], A[-1, -1] = slope[-1, V_X], -length / self.settings.scale.time
            high[-1] = float(self._reference.terminal_speed_at(at[-1])) - offset[-1, V_X]

        reach = self._limits.steering_rate * self.model.car.T_s
        span = self._limits.throttle[1] - self._limits.throttle[0]
        z_low = np.concatenate([np.tile([-span, -reach], N), np.zeros(N + 1)])
        z_high = np.concatenate([np.tile([span, reach], N), np.full(N + 1, np.inf)])
        return _Program(H, g, A, low, high, z_low, z_high)

    def _add_slip(
        self, A: Vector, high: Vector, guess: Vector, offset: Vector, slope: Vector, p: Vector, margin: Vector
    ) -> None:
        """The slip angles (rad) of both axles after each step, within their bounds on both sides less ``margin`` ``(N, 2)``.

        They are the model's own, linearised at the guessed states ``(N, size)``.
        """
        N = self.settings.N
        slips, by_x = self.model.slip_angles(guess, p)
        slips = slips + np.einsum("kas,ks->ka", by_x, offset - guess)
        for axle, bound in enumerate(self._slip_bounds(margin).T):
            by_u = np.einsum("ks,ksj->kj", by_x[:, axle], slope)
            rows = slice(2 * axle * N, 2 * (axle + 1) * N)
            A[rows, : 2 * N] = np.concatenate([by_u, -by_u])
            A[rows, 2 * N : 3 * N] = -np.tile(np.eye(N), (2, 1))
            high[rows] = np.concatenate([bound - slips[:, axle], bound + slips[:, axle]])

    def _slip_bounds(self, margin: Vector) -> Vector:
        """Of front and rear axle after each step (rad), ``(N, 2)``, less ``margin`` ``(N, 2)`` where that leaves enough."""
        most = np.array(self.settings.slip)
        return most - np.minimum(margin, (1.0 - _SLIP_LEFT) * most)

    def _reference_points(self, guess: Vector) -> Vector:
        """Where on the line the steps of the horizon are compared with it (m).

        They are ``(..., N)`` for guesses ``(..., N + 1, size)``, or ``(N,)`` where all guesses are of the same present.
        """
        if self.settings.objective == "tracking":
            v = float(guess[..., 0, V_X].flat[0])
            return self._reference.within_reach(self._on_line, self._times(1), v, self._scheduled)
        return self._reference.project(guess[..., 1:, :2], _along(guess[..., :2], self._on_line))

    def _add_borders(
        self, A: Vector, low: Vector, high: Vector, guess: Vector, positions: Vector, moves: Vector, margin: Vector
    ) -> None:
        """Half planes at the feet of the guessed positions on the centre line; both sides share a step's slack.

        They are ``margin`` ``(N,)`` further inwards, where the road is wide enough.
        """
        N = self.settings.N
        s = self._track.project(guess[1:, :2], _along(guess[:, :2], self._on_track))[0]
        foot = self._track.centre.position(s)
        normal = _directions(self._track.centre.heading(s))[1]
        right, left = self._room(s, margin)
        lateral = np.einsum("ki,ki->k", normal, positions - foot)
        by_u = np.einsum("ki,kij->kj", normal, moves)
        A[:, : 2 * N] = np.concatenate([by_u, by_u])
        into_slack = self.settings.scale.length * np.eye(N)
        A[:N, 2 * N : 3 * N], A[N:, 2 * N : 3 * N] = -into_slack, into_slack
        high[:N], low[N:] = left - lateral, -right - lateral

    def _room(self, s: Vector, margin: Vector) -> tuple[Vector, Vector]:
        """From the centre line at ``s`` (m) to where the car's centre may be, to the right and to the left (m).

        Both are ``margin`` ``(N,)`` less, where the road is wide enough.
        """
        right, left = (width - self.settings.margin for width in self._track.widths(s))
        margin = np.minimum(margin, (1.0 - _ROAD_LEFT) * np.maximum(right + left, 0.0) / 2)
        return right - margin, left - margin

    def _held(self, now: Vector, guess: Plan, adapted: Adapted, t: float, status: Status) -> Plan:
        """The inputs of ``guess`` from ``now`` on, within the limits, and where they lead."""
        x, u = np.tile(now, (self.settings.N + 1, 1)), np.zeros_like(guess.u)
        for k, p in enumerate(self._parameters(adapted, t)):
            u[k] = np.subtract(self._limits.clamped(Applied(*(x[k, [R, DELTA]] + guess.u[k]))), x[k, [R, DELTA]])
            following = self.model.step(x[k], u[k], p)
            x[k + 1] = following if np.all(np.isfinite(following)) else guess.x[k + 1]
        return Plan(x, u, status)


def _condensed(x: Vector, u: Vector, following: Vector, by_x: Vector, by_u: Vector) -> tuple[Vector, Vector]:
    """Eliminates the states: they are ``offset + slope @ increments``.

    Returns:
        Shapes ``(N + 1, size)`` and ``(N + 1, size, 2 N)``.
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


def _along(positions: Vector, s: float) -> Vector:
    """About where positions ``(..., N + 1, 2)`` after the first lie on a line (m), the first being at ``s``: ``(..., N)``."""
    steps = np.diff(positions, axis=-2)
    return np.asarray(s + np.cumsum(np.hypot(steps[..., 0], steps[..., 1]), axis=-1))


def _soft(beyond: Vector) -> Vector:
    """What going beyond a bound costs, in units of its price."""
    slack = np.maximum(0.0, beyond)
    return np.asarray(slack + slack**2)


def _directions(heading: Vector) -> tuple[Vector, Vector]:
    """Unit vectors along and to the left of ``heading`` ``(...)``, each ``(..., 2)``."""
    c, s = np.cos(heading), np.sin(heading)
    return np.stack([c, s], axis=-1), np.stack([-s, c], axis=-1)
