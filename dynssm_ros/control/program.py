"""The quadratic program of a control step: what is minimised, and what bounds it.

Actuator limits are hard; the borders, the slip of both axles, and the speed at the end of the horizon where the
objective asks for it are soft with a linear penalty, so that every program is feasible.

Tracking follows the place where a car that keeps the line's own time would be now, at most ``lag_bound`` away (MPCC: a
bound on the lag error), so that time that cannot be made up for is given up.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.control.buffered import QuadraticProgram
from dynssm_ros.control.caution import Margins
from dynssm_ros.control.horizon_model import STATES, HorizonModel
from dynssm_ros.control.reference import Reference
from dynssm_ros.control.settings import Settings
from dynssm_ros.track.tracks import Track
from dynssm_ros.vehicle.parameters import InputLimits

V_X, R, DELTA = (STATES.index(name) for name in ("v_x", "r", "delta"))
_ROAD_LEFT, _SLIP_LEFT = 0.5, 0.5  # shares of the road and of the slip's bound that no caution takes


class Whereabouts(NamedTuple):
    """Where the car is."""

    on_track: float  # along the track's centre line (m)
    on_line: float  # along the line that is followed (m)
    scheduled: float  # likewise where it would be by the reference time (m)


_ORIGIN = Whereabouts(0.0, 0.0, 0.0)


@dataclass(frozen=True)
class HorizonProgram:
    """The program of one car on one track, now, which is ``at`` a place.

    ``margins`` move borders and bounds on the slip inwards. ``p`` are parameters of the steps, ``(N, PARAMETERS)``.
    """

    model: HorizonModel
    limits: InputLimits
    reference: Reference
    track: Track
    settings: Settings
    at: Whereabouts = _ORIGIN

    @property
    def variables(self) -> int:
        """Increments of the steps, slacks of the steps, slack of the end."""
        return 3 * self.settings.N + 1

    @property
    def rows(self) -> int:
        """Actuators, both borders, both axles to both sides, the end."""
        return 8 * self.settings.N + 1

    def times(self, first: int) -> Vector:
        """Times of the steps ``first`` to ``N`` from now (s)."""
        return np.arange(first, self.settings.N + 1, dtype=np.float64) * self.model.car.T_s

    def parts(self, z: Vector) -> tuple[Vector, Vector]:
        """Increments ``(2 N,)`` and slacks of the steps ``(N,)`` in a solution ``(variables,)``."""
        N = self.settings.N
        return z[: 2 * N], z[2 * N : 3 * N]

    def of(self, guess: Vector, offset: Vector, slope: Vector, p: Vector, margins: Margins) -> QuadraticProgram:
        """The program in increments and slacks.

        Args:
            guess: the states around which it is linearised, the present one first, ``(N + 1, size)``.
            offset: states without increments, ``(N + 1, size)``; with them they are ``offset + slope @ increments``.
            slope: ``(N + 1, size, 2 N)``.
            p: see above.
            margins: see above.
        """
        N = self.settings.N
        positions, moves = offset[1:, :2], slope[1:, :2]
        points = self.reference_points(guess)
        H, g = self._cost(points, positions, moves)

        A = np.zeros((self.rows, self.variables))
        low, high = np.full(self.rows, -np.inf), np.full(self.rows, np.inf)
        for k, (bounds, held) in enumerate(
            ((self.limits.throttle, guess[0, R]), (self.limits.steering, guess[0, DELTA]))
        ):
            rows = slice(k * N, (k + 1) * N)
            A[rows, k : 2 * N : 2] = np.tri(N)
            low[rows], high[rows] = bounds[0] - held, bounds[1] - held
        borders, slips = slice(2 * N, 4 * N), slice(4 * N, 8 * N)
        self.add_borders(
            A[borders],
            low[borders],
            high[borders],
            guess=guess,
            positions=positions,
            moves=moves,
            margin=margins.lateral,
        )
        self.add_slip(
            A[slips], high[slips], guess=guess[1:], offset=offset[1:], slope=slope[1:], p=p, margin=margins.slip
        )
        if self.settings.weights.terminal_speed > 0:
            A[-1, : 2 * N], A[-1, -1] = slope[-1, V_X], -self.settings.scale.length / self.settings.scale.time
            high[-1] = float(self.reference.terminal_speed_at(points[-1])) - offset[-1, V_X]

        reach = self.limits.steering_rate * self.model.car.T_s
        span = self.limits.throttle[1] - self.limits.throttle[0]
        z_low = np.concatenate([np.tile([-span, -reach], N), np.zeros(N + 1)])
        z_high = np.concatenate([np.tile([span, reach], N), np.full(N + 1, np.inf)])
        return QuadraticProgram(H, g, A, low, high, z_low, z_high)

    def _cost(self, points: Vector, positions: Vector, moves: Vector) -> tuple[Vector, Vector]:
        """Hessian ``(variables, variables)`` and gradient ``(variables,)`` of the costs at places ``points`` of the
        reference, where positions ``(N, 2)`` move by ``moves`` ``(N, 2, 2 N)`` with the increments.
        """
        N, w = self.settings.N, self.settings.weights
        point, tangent, normal = self.reference.line.frame(points)
        H, g = np.zeros((self.variables,) * 2), np.zeros(self.variables)
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
        rates = np.tile(self.settings.rates, N) / h
        H[np.diag_indices(self.variables)] += 2 * np.concatenate(
            [rates, np.full(N, h * w.border), [max(w.terminal_speed, 1.0)]]
        )
        g[2 * N : 3 * N] = h * w.border
        g[3 * N] = w.terminal_speed
        return H, g

    def costs(self, x: Vector, u: Vector, p: Vector, margins: Margins) -> Vector:
        """What the program minimises, ``(M,)``, at states ``x`` ``(M, N + 1, size)``, not linearised, where increments
        ``u`` ``(M, N, 2)`` led; infinite where a state is not finite.
        """
        finite = np.all(np.isfinite(x), axis=(1, 2))
        x = np.where(finite[:, None, None], x, x[:, :1])
        w, length, h = self.settings.weights, self.settings.scale.length, self.model.car.T_s / self.settings.scale.time
        points = self.reference_points(x)
        point, tangent, normal = self.reference.line.frame(points)
        errors = (x[:, 1:, :2] - point) / length
        along, across = np.sum(tangent * errors, axis=-1), np.sum(normal * errors, axis=-1)
        s, lateral = self.track.project(x[:, 1:, :2], _along(x[..., :2], self.at.on_track))
        right, left = self._room(s, margins.lateral)
        outside = np.maximum(lateral - left, -right - lateral) / length
        slips = np.array([self.model.slip_angles(each[1:], p)[0] for each in x])
        slipping = np.max(np.abs(slips) - self._slip_bounds(margins.slip), axis=-1)
        each_step = w.along * along**2 + w.across * across**2 + w.border * _soft(np.maximum(outside, slipping))
        costs = np.sum(h * each_step + u**2 @ self.settings.rates / h, axis=-1)
        costs += w.terminal_across * across[:, -1] ** 2
        if w.progress > 0:
            costs -= w.progress * (along[:, -1] + (points[..., -1] - self.at.on_line) / length)
        if w.terminal_speed > 0:
            too_fast = x[:, -1, V_X] - self.reference.terminal_speed_at(points[..., -1])
            costs += w.terminal_speed * _soft(too_fast * self.settings.scale.time / length)
        return np.where(finite, costs, np.inf)

    def reference_points(self, guess: Vector) -> Vector:
        """Where on the line the steps of guesses ``(..., N + 1, size)`` are compared with it (m): ``(..., N)``, or
        ``(N,)`` where all guesses are of the same present.
        """
        if self.settings.objective == "tracking":
            v = float(guess[..., 0, V_X].flat[0])
            return self.reference.within_reach(self.at.on_line, self.times(1), v, self.at.scheduled)
        return self.reference.project(guess[..., 1:, :2], _along(guess[..., :2], self.at.on_line))

    def add_borders(
        self, A: Vector, low: Vector, high: Vector, *, guess: Vector, positions: Vector, moves: Vector, margin: Vector
    ) -> None:
        """Half planes at the feet of the guessed positions on the centre line, see :meth:`_room`; both sides share a
        step's slack.
        """
        N = self.settings.N
        s = self.track.project(guess[1:, :2], _along(guess[:, :2], self.at.on_track))[0]
        foot, _, normal = self.track.centre.frame(s)
        right, left = self._room(s, margin)
        lateral = np.einsum("ki,ki->k", normal, positions - foot)
        by_u = np.einsum("ki,kij->kj", normal, moves)
        A[:, : 2 * N] = np.concatenate([by_u, by_u])
        into_slack = self.settings.scale.length * np.eye(N)
        A[:N, 2 * N : 3 * N], A[N:, 2 * N : 3 * N] = -into_slack, into_slack
        high[:N], low[N:] = left - lateral, -right - lateral

    def _room(self, s: Vector, margin: Vector) -> tuple[Vector, Vector]:
        """From the centre line at ``s`` (m) to where the car's centre may be, to the right and to the left (m):
        ``margin`` ``(N,)`` further inwards, where the road is wide enough.
        """
        right, left = (width - self.settings.margin for width in self.track.widths(s))
        margin = np.minimum(margin, (1.0 - _ROAD_LEFT) * np.maximum(right + left, 0.0) / 2)
        return right - margin, left - margin

    def add_slip(
        self, A: Vector, high: Vector, *, guess: Vector, offset: Vector, slope: Vector, p: Vector, margin: Vector
    ) -> None:
        """The model's slip angles (rad) of both axles after each step, linearised at ``guess`` ``(N, size)``, within
        their bounds on both sides less ``margin`` ``(N, 2)``.
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


def _along(positions: Vector, s: float) -> Vector:
    """About where positions ``(..., N + 1, 2)`` after the first lie on a line (m), the first being at ``s``: ``(..., N)``."""
    steps = np.diff(positions, axis=-2)
    return np.asarray(s + np.cumsum(np.hypot(steps[..., 0], steps[..., 1]), axis=-1))


def _soft(beyond: Vector) -> Vector:
    """What going beyond a bound costs, in units of its price."""
    slack = np.maximum(0.0, beyond)
    return np.asarray(slack + slack**2)
