"""Velocities at the centre of gravity from gyro, accelerometers, wheel speeds and, where there are, poses or GNSS.

An extended Kalman filter. Its state is ``v_x, v_y`` (m/s), the biases of gyro (rad/s) and accelerometers (m/s^2), the
rear slip angle per lateral acceleration (rad s^2/m), and the pose ``x, y, theta`` (m, m, rad). With the measured
``a_x, a_y, omega`` less their biases

    v_x' = a_x + v_y omega,    v_y' = a_y - v_x omega

are integrated over each step, the rotation exactly, accelerations by trapezoids. Measured are ``v_x``, poses or
positions, and velocities over ground. As biases make ``v_y`` drift where nothing else measures it, it is held near the
value that it has when the car turns steadily, ``v_y = l_r omega - |v_x| alpha_r`` with ``alpha_r`` proportional to ``v_x
omega``: how far it is from there is a Gauss-Markov process. Without ``a_y`` that is all that is known of ``v_y``.

Forwards the filter is causal. The Rauch-Tung-Striebel smoother goes back over what it left and uses both sides. Source:
Simo Sarkka, "Bayesian Filtering and Smoothing", 2013, chapters 5.2 and 9.1.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from pydantic import Field

from dynssm_ros.arrays import Vector
from dynssm_ros.configuration import StrictModel

V_X, V_Y, GYRO_BIAS, A_X_BIAS, A_Y_BIAS, SLIP, X, Y, THETA = range(9)
"""Numbers of the states."""
INPUTS = ("a_x", "a_y", "omega")
_SIZE = 9
_POSE = slice(X, THETA + 1)
_UNKNOWN_SPEED = 30.0  # m/s, standard deviation before the first one is measured
_SLIP_SHARE = 0.5  # standard deviation of the slip per acceleration, as a share of it
_STANDS, _STILL = 0.05, 0.1  # m/s that wheels and rad/s that the gyro show at most where the car stands
_AT_REST, _TURN_AT_REST = 0.01, 0.005  # m/s, rad/s: what v_y and omega are then, at most
_LEAST_TRAVEL, _CLEAR = 1.0, 4.0  # m, and standard deviations of a fix, that the car goes before its heading is known
_OUTLIER = 3.0  # standard deviations of an innovation from which on a measurement counts less


class Estimation(StrictModel):
    """How velocities are estimated; see :mod:`dynssm_ros.signals.motion_filter`.

    The defaults are for MEMS sensors in a car that vibrates and rolls, which is far more than their data sheets say.
    """

    rear_axle: float = Field(default=0.0, ge=0, le=5, description="from the centre of gravity to the rear axle (m)")
    slip: float = Field(
        default=0.008,
        ge=0,
        le=0.1,
        description="slip angle of the rear axle per lateral acceleration (rad s^2/m), known to half of it",
    )
    slip_deviation: float = Field(
        default=0.03, gt=0, le=1, description="of the slip angle from that of a steady turn, standard deviation (rad)"
    )
    slip_time: float = Field(default=0.5, gt=0, description="how long such a deviation lasts (s)")
    speed_noise: float = Field(default=0.03, gt=0, le=1, description="of v_x, as a share of it: slip of the wheels")
    speed_resolution: float = Field(default=0.03, gt=0, description="of v_x at low speed, standard deviation (m/s)")
    acceleration_noise: float = Field(default=0.1, gt=0, description="of a_x and a_y (m/s^2 per root Hz)")
    acceleration_bias: float = Field(
        default=0.3, gt=0, description="of a_x and a_y, roll and banking included, standard deviation (m/s^2)"
    )
    bias_time: float = Field(default=10.0, gt=0, description="how long the bias of an accelerometer lasts (s)")
    gyro_noise: float = Field(default=0.005, gt=0, description="of omega (rad/s per root Hz)")
    gyro_bias: float = Field(default=0.02, gt=0, description="of omega, standard deviation (rad/s); lasts 1000 s")
    unknown_acceleration: float = Field(
        default=3.0, gt=0, description="change of v_x where a_x is not measured (m/s^2 per root Hz)"
    )
    position_noise: float = Field(default=0.05, gt=0, description="of x and y, standard deviation (m)")
    heading_noise: float = Field(default=0.02, gt=0, description="of theta, standard deviation (rad)")
    fix_noise: float = Field(default=1.0, gt=0, description="of latitude and longitude, standard deviation (m)")
    ground_speed_noise: float = Field(default=0.1, gt=0, description="of v_east and v_north, standard deviation (m/s)")
    position_at: tuple[float, float] = Field(
        default=(0.0, 0.0),
        description="where positions and velocities over ground are measured, ahead and left of the "
        "centre of gravity (m)",
    )
    origin: tuple[float, float] | None = Field(
        default=None, description="latitude and longitude (deg) where x and y are 0; null: the first fix"
    )


_GYRO_BIAS_TIME = 1000.0  # s


class Moment(NamedTuple):
    """What the filter knows after the samples of one instant."""

    stamp: int  # ns
    x: Vector  # state, (9,)
    P: Vector  # its covariance, (9, 9)
    inputs: tuple[float, float, float]  # newest a_x, a_y, omega; NaN where none came yet
    has_turn: bool  # whether omega came at this instant
    has_pose: bool  # whether x, y and theta are those of the map
    anchor: complex | None  # first position, before the heading is known (m)
    F: Vector  # derivative of the state predicted by that of the moment before, (9, 9)
    before: tuple[Vector, Vector]  # the state predicted and its covariance, before the samples
    since: tuple[Vector, Vector]  # those of the moment before, by what the inputs since then say of them

    @property
    def is_ready(self) -> bool:
        """Whether speed and yaw rate are known."""
        return math.isfinite(self.inputs[2]) and self.P[V_X, V_X] < 1.0

    @property
    def velocities(self) -> tuple[float, float, float]:
        """``v_x, v_y, omega`` (m/s, m/s, rad/s)."""
        return float(self.x[V_X]), float(self.x[V_Y]), self.inputs[2] - float(self.x[GYRO_BIAS])


class MotionFilter:
    """One step after the other; a :class:`Moment` is never changed, so that any can be gone on from.

    Args:
        settings: noise, and what of the car is known.
        names: signals that are measured, of which ``a_x`` and ``a_y`` need not be.
    """

    def __init__(self, settings: Estimation, names: Sequence[str]) -> None:
        self.settings = settings
        self._measured = ("a_x" in names, "a_y" in names)
        self._antenna = complex(*settings.position_at)
        self._position_noise = settings.fix_noise if "latitude" in names else settings.position_noise
        s = settings
        times = (_GYRO_BIAS_TIME, s.bias_time, s.bias_time)
        self._biases = tuple(zip((s.gyro_bias, s.acceleration_bias, s.acceleration_bias), times, strict=True))
        self._density = s.acceleration_noise if self._measured[0] else s.unknown_acceleration

    def begin(self, stamp: int, values: Mapping[str, float]) -> Moment:
        """The first moment: samples ``values`` by signal at ``stamp`` (ns)."""
        s, x = self.settings, np.zeros(_SIZE)
        x[SLIP] = s.slip
        deviations = [_UNKNOWN_SPEED, s.slip_deviation * _UNKNOWN_SPEED, *(bias for bias, _ in self._biases)]
        P = np.diag(np.square([*deviations, max(_SLIP_SHARE * s.slip, 1e-6), 1.0, 1.0, 1.0]))
        first = Moment(stamp, x, P, (math.nan,) * 3, False, False, None, np.eye(_SIZE), (x, P), (x, P))
        return self._corrected(first, values)

    def step(self, last: Moment, stamp: int, values: Mapping[str, float]) -> Moment:
        """The moment at ``stamp`` (ns), later than ``last``, with the samples ``values`` by signal.

        Accelerometer and steady turn both predict ``v_y``. Their product is the prediction, weighed by their variances;
        by how far they are apart they say something of the moment before.
        """
        dt = (stamp - last.stamp) / 1e9
        moved, F = self._moved(last, values, dt)
        goal, row = self._drawn(last.x, last.inputs[2], dt)
        x, P, share = last.x, last.P, 1.0  # of the steady turn
        square = float(x[V_X] ** 2 + P[V_X, V_X])
        s = self.settings
        drawn = (s.slip_deviation**2 * square + s.speed_resolution**2) * (1 - math.exp(-2 * dt / s.slip_time))
        if self._measured[1]:
            variance = (s.acceleration_noise**2 + s.gyro_noise**2 * square) * dt
            share = variance / (variance + drawn)
            x, P = _updated(x, P, F[V_Y] - row, goal - moved[V_Y], variance + drawn)
            moved, goal = moved + F @ (x - last.x), goal + float(row @ (x - last.x))
        moved[V_Y], F[V_Y] = (1 - share) * moved[V_Y] + share * goal, (1 - share) * F[V_Y] + share * row
        spread = self._spread(last, F, P, share, dt)
        spread[V_Y, V_Y] += share**2 * drawn
        before, since = (moved, spread), (x, P)
        return self._corrected(last._replace(stamp=stamp, x=moved, P=spread, F=F, before=before, since=since), values)

    def _moved(self, last: Moment, values: Mapping[str, float], dt: float) -> tuple[Vector, Vector]:
        """State and derivative after ``dt`` (s); inputs that come now are averaged with those before."""
        x = last.x
        inputs = [_mean(values.get(name, old), old) for name, old in zip(INPUTS, last.inputs, strict=True)]
        a_x, a_y, turn = (0.0 if math.isnan(value) else value for value in inputs)
        omega = turn - float(x[GYRO_BIAS])
        a = complex(a_x - x[A_X_BIAS], a_y - x[A_Y_BIAS])
        v, heading = complex(x[V_X], x[V_Y]), cmath.exp(1j * x[THETA])
        back = cmath.exp(-1j * omega * dt)
        new = back * (v + a * dt / 2) + a * dt / 2
        way = dt / 2 * heading * (2 * v + a * dt / 2 * (1 + back.conjugate()))
        moved = x.copy()
        moved[V_X], moved[V_Y] = new.real, new.imag
        moved[X], moved[Y], moved[THETA] = x[X] + way.real, x[Y] + way.imag, x[THETA] + omega * dt
        F = np.eye(_SIZE)
        by_omega = -1j * dt * back * (v + a * dt / 2)
        way_by_omega = dt / 2 * heading * a * dt / 2 * 1j * dt * back.conjugate()
        for column, of_v, of_way in (
            (V_X, back, dt * heading),
            (V_Y, 1j * back, 1j * dt * heading),
            (GYRO_BIAS, -by_omega, -way_by_omega),
            (A_X_BIAS, -dt / 2 * (back + 1), -dt * dt / 4 * heading * (1 + back.conjugate())),
            (A_Y_BIAS, -1j * dt / 2 * (back + 1), -1j * dt * dt / 4 * heading * (1 + back.conjugate())),
            (THETA, 0j, 1j * way),
        ):
            F[V_X, column], F[V_Y, column] = of_v.real, of_v.imag
            F[X, column], F[Y, column] = float(column == X) + of_way.real, float(column == Y) + of_way.imag
        F[THETA, GYRO_BIAS] = -dt
        if not self._measured[0]:  # it stays as it is, as far as is known
            moved[V_X], F[V_X] = x[V_X], _ROWS[V_X]
        for row, (_, time) in zip((GYRO_BIAS, A_X_BIAS, A_Y_BIAS), self._biases, strict=True):
            F[row, row] = math.exp(-dt / time)
            moved[row] *= F[row, row]
        if not last.has_pose:  # the way is counted, from an unknown heading
            F[_POSE] = 0.0
        return moved, F

    def _drawn(self, x: Vector, turn: float, dt: float) -> tuple[float, Vector]:
        """``v_y`` after ``dt`` (s) as drawn to that of a steady turn at the measured ``turn`` (rad/s), with derivative."""
        v_x, omega = float(x[V_X]), 0.0 if math.isnan(turn) else turn - float(x[GYRO_BIAS])
        slip, square, row = float(x[SLIP]), abs(v_x) * v_x, np.zeros(_SIZE)
        row[V_X], row[SLIP] = -2 * slip * abs(v_x) * omega, -square * omega
        row[GYRO_BIAS] = slip * square - self.settings.rear_axle
        kept = math.exp(-dt / self.settings.slip_time)
        steady = (self.settings.rear_axle - slip * square) * omega
        return kept * x[V_Y] + (1 - kept) * steady, kept * _ROWS[V_Y] + (1 - kept) * row

    def _spread(self, last: Moment, F: Vector, P: Vector, share: float, dt: float) -> Vector:
        """The covariance after ``dt`` (s), where accelerometer and gyro have all but ``share`` of ``v_y``."""
        spread = F @ P @ F.T
        s, turn = self.settings, np.zeros(_SIZE)
        spread[V_X, V_X] += self._density**2 * dt
        spread[V_Y, V_Y] += ((1 - share) * s.acceleration_noise) ** 2 * dt
        for row, (bias, _) in zip((GYRO_BIAS, A_X_BIAS, A_Y_BIAS), self._biases, strict=True):
            spread[row, row] += bias**2 * (1 - F[row, row] ** 2)
        turn[V_X] = last.x[V_Y] if self._measured[0] else 0.0
        turn[V_Y] = (share - 1) * last.x[V_X]
        turn[THETA] = 1.0 if last.has_pose else 0.0
        spread += np.outer(turn, turn) * (s.gyro_noise**2 * dt)
        if not last.has_pose:
            spread[_POSE, _POSE] += np.eye(3)
        return np.asarray(spread)

    def _corrected(self, at: Moment, values: Mapping[str, float]) -> Moment:
        """The moment after the samples of its instant."""
        s = self.settings
        a_x, a_y, omega = (values.get(name, old) for name, old in zip(INPUTS, at.inputs, strict=True))
        at, had_pose = at._replace(inputs=(a_x, a_y, omega), has_turn="omega" in values), at.has_pose
        at = at if had_pose else self._placed(at, values)
        x, P = at.x, at.P
        if (speed := values.get("v_x")) is not None:
            deviation = math.hypot(s.speed_noise * speed, s.speed_resolution)
            x, P = _updated(x, P, _ROWS[V_X], speed - x[V_X], deviation**2)
            if abs(speed) < _STANDS and abs(omega) < _STILL and abs(x[V_X]) < 10 * _STANDS:
                x, P = _updated(x, P, _ROWS[V_Y], -x[V_Y], _AT_REST**2)
                x, P = _updated(x, P, _ROWS[GYRO_BIAS], omega - x[GYRO_BIAS], _TURN_AT_REST**2)
        if had_pose:
            x, P = self._located(x, P, values, 0.0 if math.isnan(omega) else omega)
        return at._replace(x=x, P=(P + P.T) / 2)

    def _placed(self, at: Moment, values: Mapping[str, float]) -> Moment:
        """The moment with a pose of the map, as soon as samples say where it is and how it is turned."""
        if "x" not in values or "y" not in values:
            return at
        here, x, noise = complex(values["x"], values["y"]), at.x.copy(), self._position_noise
        if "theta" in values:
            x[THETA], turned = values["theta"], self.settings.heading_noise
        elif at.anchor is None:
            x[_POSE] = 0.0
            return at._replace(x=x, anchor=here)
        else:
            gone = complex(x[X], x[Y]) + self._antenna * (cmath.exp(1j * x[THETA]) - 1)
            seen = here - at.anchor
            if not at.is_ready or min(abs(gone), abs(seen)) < max(_LEAST_TRAVEL, _CLEAR * math.sqrt(2) * noise):
                return at
            turned = math.sqrt(2) * noise / abs(seen) + 0.05
            x[THETA] += cmath.phase(seen / gone)
        centre = here - self._antenna * cmath.exp(1j * x[THETA])
        x[X], x[Y] = centre.real, centre.imag
        P = at.P.copy()
        P[_POSE], P[:, _POSE] = 0.0, 0.0
        P[_POSE, _POSE] = np.diag([noise**2, noise**2, turned**2])
        return at._replace(x=x, P=P, has_pose=True, before=_with_pose(at.before, x, P))

    def _located(self, x: Vector, P: Vector, values: Mapping[str, float], omega: float) -> tuple[Vector, Vector]:
        """With poses, positions and velocities over ground, which are taken as they come; ``omega`` is as measured."""
        s = self.settings
        for name, number in (("x", X), ("y", Y)):
            if name in values:
                lever, row = self._antenna * cmath.exp(1j * x[THETA]), _ROWS[number].copy()
                ahead, row[THETA] = (lever.real, -lever.imag) if number == X else (lever.imag, lever.real)
                x, P = _updated(x, P, row, values[name] - x[number] - ahead, self._position_noise**2)
        if "theta" in values:
            off = (values["theta"] - x[THETA] + math.pi) % (2 * math.pi) - math.pi
            x, P = _updated(x, P, _ROWS[THETA], off, s.heading_noise**2)
        for name, turn in (("v_east", 0.0), ("v_north", math.pi / 2)):
            if name in values:
                c, sine = math.cos(x[THETA] - turn), math.sin(x[THETA] - turn)
                there = complex(x[V_X], x[V_Y]) + 1j * (omega - x[GYRO_BIAS]) * self._antenna
                row = np.zeros(_SIZE)
                row[V_X], row[V_Y], row[THETA] = c, -sine, -there.real * sine - there.imag * c
                off = values[name] - there.real * c + there.imag * sine
                x, P = _updated(x, P, row, off, s.ground_speed_noise**2)
        return x, P


def smoothed(moments: Sequence[Moment]) -> tuple[Vector, Vector]:
    """States ``(N, 9)`` and their covariances ``(N, 9, 9)`` from the samples before and after each moment."""
    x, P = np.stack([one.x for one in moments]), np.stack([one.P for one in moments])
    for k in range(len(moments) - 2, -1, -1):
        following = moments[k + 1]
        (there, spread), (x[k], P[k]) = following.before, following.since
        gain = np.linalg.solve(spread, following.F @ P[k]).T
        x[k] += gain @ (x[k + 1] - there)
        P[k] += gain @ (P[k + 1] - spread) @ gain.T
    return x, P


def _updated(x: Vector, P: Vector, row: Vector, off: float, variance: float) -> tuple[Vector, Vector]:
    """After a scalar measurement that is ``off`` from what was expected; far ones count less (Huber)."""
    across = P @ row
    expected = float(row @ across)
    total = expected + variance
    if off * off > _OUTLIER**2 * total:
        total = max(total, expected + variance * abs(off) / (_OUTLIER * math.sqrt(total)))
    gain = across / total
    return x + gain * off, P - np.outer(gain, across)


_ROWS = np.eye(_SIZE)


def _mean(new: float, old: float) -> float:
    return new if math.isnan(old) else (new + old) / 2


def _with_pose(before: tuple[Vector, Vector], x: Vector, P: Vector) -> tuple[Vector, Vector]:
    """What was predicted, as if the pose had been known to be that of ``x`` and ``P``."""
    there, spread = before[0].copy(), before[1].copy()
    there[_POSE] = x[_POSE]
    spread[_POSE], spread[:, _POSE] = P[_POSE], P[:, _POSE]
    return there, spread
