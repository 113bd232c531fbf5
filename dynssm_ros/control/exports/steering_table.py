"""The steering that a lateral acceleration takes at a speed: the lookup table of ForzaETH's race stack.

A comma-separated table: speeds (m/s) in the first row, steering angles (rad) in the first column, lateral accelerations
(m/s^2) of steady cornering in the cells. From where more steering brings no more, cells are NaN.
"""

from __future__ import annotations

import io
from itertools import pairwise

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.control.exports.names import identifier
from dynssm_ros.vehicle import Applied, CarModel, Coefficients, State, Vehicle
from dynssm_ros.vehicle.limits import vehicle_limits
from dynssm_ros.vehicle.single_track import standing_speed

_SPEEDS, _ANGLES = 60, 60  # columns and rows; angles are closer to each other about straight ahead
_ROUNDS, _STEP = 20, 1e-6  # of Newton's method; its secants' steps (m/s, rad/s)
_CLOSE = 1e-9  # m/s^2 and rad/s^2 that are left


def steady_cornering(
    vehicle: Vehicle, speed: Vector, delta: float, start: tuple[Vector, Vector]
) -> tuple[Vector, Vector]:
    """Lateral velocity and yaw rate of steady corners.

    Args:
        vehicle: the car.
        speed: ``v_x`` (m/s), ``(M,)``.
        delta: road-wheel angle (rad).
        start: lateral velocities and yaw rates nearby, ``(M,)``.

    Returns:
        ``v_y`` and ``omega``, ``(M,)``; NaN where there is no stable corner nearby.
    """
    car = CarModel.of(vehicle)
    theta, applied = Coefficients(*vehicle.nominal), Applied(vehicle.inputs.coasting(speed), delta + 0.0 * speed)

    def rates(v_y: Vector, omega: Vector) -> Vector:
        q = car.motion(State(speed, v_y, omega), applied, theta)
        return np.stack(np.broadcast_arrays(q.a_y, q.omega_dot))

    v_y, omega = (each.copy() for each in start)
    with np.errstate(all="ignore"):
        for _ in range(_ROUNDS):
            left = rates(v_y, omega)
            by_v_y, by_omega = ((rates(v_y + _STEP * a, omega + _STEP * (1 - a)) - left) / _STEP for a in (1.0, 0.0))
            determinant = by_v_y[0] * by_omega[1] - by_omega[0] * by_v_y[1]
            v_y = v_y - (left[0] * by_omega[1] - left[1] * by_omega[0]) / determinant
            omega = omega - (left[1] * by_v_y[0] - left[0] * by_v_y[1]) / determinant
        stable = (determinant > 0) & (by_v_y[0] + by_omega[1] < 0)
        found = stable & (np.abs(rates(v_y, omega)) < _CLOSE * 1e3).all(axis=0)
    return np.where(found, v_y, np.nan), np.where(found, omega, np.nan)


def steering_table(vehicle: Vehicle) -> tuple[Vector, Vector, Vector]:
    """Speeds (m/s) ``(M,)``, steering angles (rad) ``(N,)`` and lateral accelerations (m/s^2) ``(N, M)``.

    Accelerations are the mean of both sides, as the table has one. Speeds at which it cannot drive straight are left out.
    """
    lock = min(map(abs, vehicle.inputs.steering))
    delta = lock * np.linspace(0.0, 1.0, _ANGLES) ** 2
    speed = np.linspace(2 * standing_speed(vehicle.constants.wheelbase), vehicle_limits(vehicle).top_speed, _SPEEDS)
    sides = [_one_side(vehicle, speed, side * delta) * side for side in (1.0, -1.0)]
    accelerations = (sides[0] + sides[1]) / 2
    accelerations[0] = 0.0
    for before, now in pairwise(accelerations):
        now[~(now > before)] = np.nan
    stable = np.isfinite(accelerations[1])  # a car that oversteers is unstable from some speed on
    return speed[stable], delta, accelerations[:, stable]


def _one_side(vehicle: Vehicle, speed: Vector, delta: Vector) -> Vector:
    """Lateral accelerations ``(N, M)``, each angle from the one before."""
    found, start = [], (0.0 * speed, 0.0 * speed)
    for angle in delta:
        start = steady_cornering(vehicle, speed, float(angle), start)
        found.append(speed * start[1])
    return np.array(found)


def steering_table_files(vehicle: Vehicle) -> dict[str, str]:
    """The table as ``NAME_lookup_table.csv``."""
    speed, delta, accelerations = steering_table(vehicle)
    table = np.block([[np.zeros((1, 1)), speed[None]], [delta[:, None], accelerations]])
    text = io.StringIO()
    np.savetxt(text, table, delimiter=",", fmt="%.6g")
    return {f"{identifier(vehicle.name)}_lookup_table.csv": text.getvalue()}
