"""What a car can do: acceleration limits over speed (a ggv diagram), from its equations of motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.errors import UserError
from dynssm_ros.vehicle.car import CarModel
from dynssm_ros.vehicle.effects import CONTEXT_UNITS
from dynssm_ros.vehicle.parameters import Vehicle
from dynssm_ros.vehicle.single_track import Applied, Coefficients, Motion, State

TOP_SPEED = 120.0  # m/s; where the table ends for a car that drag does not stop before
_CONTEXT = {**dict.fromkeys(CONTEXT_UNITS, 0.0), "lap_length": 1.0}  # at the start of the lap, heading along x


@dataclass(frozen=True, eq=False)
class Limits:
    """What a car can do, over its speed (a ggv diagram)."""

    speed: Vector  # grid of speeds from near 0 to the top speed (m/s), increasing, shape ``(M,)``
    lateral: Vector  # largest lateral acceleration in steady cornering (m/s^2), ``(M,)``
    drive: Vector  # longitudinal acceleration under full throttle (m/s^2), ``(M,)``
    brake: Vector  # deceleration under full brake (m/s^2, positive), ``(M,)``

    @property
    def top_speed(self) -> float:
        """Highest speed of the table (m/s)."""
        return float(self.speed[-1])

    def cornering_speed(self, curvature: Vector) -> Vector:
        """Highest speed (m/s) at which ``curvature`` (1/m) stays within the lateral limit; the shape is kept."""
        tightest = self.lateral / self.speed**2  # falls with speed; exact between grid speeds for a constant limit
        radius_root = 1 / np.sqrt(np.maximum(np.abs(curvature), 1e-12))
        return np.asarray(np.interp(radius_root, 1 / np.sqrt(tightest), self.speed))


def vehicle_limits(vehicle: Vehicle, top_speed: float = TOP_SPEED) -> Limits:
    """What ``vehicle`` can do with its effects, found by evaluating its equations of motion.

    The lateral limit is that of the axle that saturates first in a steady turn, at slip angles up to the steering
    limit.

    Raises:
        UserError: the car cannot drive, brake or corner.
    """
    speed = np.geomspace(top_speed / 500, top_speed, 400)
    low, high = vehicle.inputs.throttle
    drive = _straight_ahead(vehicle, speed, high)
    if drive[0] <= 0:
        raise UserError(f"vehicle {vehicle.name}: full throttle does not move it ({drive[0]:.3g} m/s^2 at standstill)")
    stalls = np.flatnonzero(drive <= 0)
    speed = speed[: stalls[0]] if len(stalls) else speed
    limits = Limits(speed, _cornering(vehicle, speed), drive[: len(speed)], -_straight_ahead(vehicle, speed, low))
    for what in ("lateral", "brake"):
        worst = float(np.min(getattr(limits, what)))
        if not worst > 0:
            raise UserError(f"vehicle {vehicle.name}: its {what} limit is {worst:.3g} m/s^2; expected more than 0")
    return limits


def _straight_ahead(vehicle: Vehicle, speed: Vector, r: float) -> Vector:
    """Longitudinal acceleration (m/s^2) at ``speed`` under the first input ``r``, shape ``(M,)``."""
    zero = np.zeros_like(speed)
    return np.asarray(_settled(vehicle, State(speed, zero, zero), Applied(r + zero, zero)).a_x)


def _cornering(vehicle: Vehicle, speed: Vector) -> Vector:
    """Lateral limit (m/s^2) at ``speed``, shape ``(M,)``: both axles sweep through one slip angle, to either side.

    A car whose rear gives way first spins there: half of what the rear lacks stays in reserve.
    """
    coarse = np.geomspace(speed[0], speed[-1], 25)
    slip = np.linspace(0.02, max(abs(limit) for limit in vehicle.inputs.steering), 30)
    slip = np.concatenate([-slip[::-1], slip])
    v_x = np.repeat(coarse[:, None], len(slip), axis=1)
    zero = np.zeros_like(v_x)
    q = _settled(vehicle, State(v_x, -v_x * np.tan(slip), zero), Applied(vehicle.inputs.coasting(v_x), zero))
    share_of_front = q.l_r / (q.l_f + q.l_r)
    front = np.broadcast_to(q.F_fy / (q.m * share_of_front), v_x.shape)
    rear = np.broadcast_to(q.F_ry / (q.m * (1 - share_of_front)), v_x.shape)
    front, rear = (np.minimum(np.max(axle, axis=1), np.max(-axle, axis=1)) for axle in (front, rear))
    stable = rear - np.maximum(front - rear, 0) / 2
    return np.asarray(np.interp(speed, coarse, np.minimum(front, stable)))


def _settled(vehicle: Vehicle, state: State, applied: Applied) -> Motion:
    """The equations of motion at ``state`` once the effects' own states have settled."""
    return CarModel.of(vehicle).motion(state, applied, Coefficients(*vehicle.nominal), context=_CONTEXT)
