"""Four wheels on the stages of the single-track equations: what a training model of one track does not know.

:class:`DoubleTrack` acts like an effect. At stage ``tyres`` the sum of left and right wheels takes the place of each
axle's lateral force; stage ``forces`` adds the yaw moment of unequal steered wheels. The rear axle has an open
differential, which turns nothing. All else is shared with the single-track car.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

from dynssm_ros.vehicle.effects.drivetrain import TRACK_WIDTH
from dynssm_ros.vehicle.single_track import Array, Motion, StageEffect, VehicleConstants, front_force, rear_force

LOAD_SENSITIVITY = 0.15  # of a racing slick: grip per load that 100 % more load costs
_ROUNDS = 2  # of lateral force and load transfer, which hang on each other weakly
_MOMENT = "double_track.moment"


class Wheels(NamedTuple):
    """One value per wheel."""

    front_left: Array
    front_right: Array
    rear_left: Array
    rear_right: Array


@dataclass(frozen=True)
class DoubleTrack(StageEffect):
    """Left and right wheels with their own slip angle, load and Pacejka force.

    Without load transfer and with both wheels at one slip angle the forces are those of the single-track car. Else a
    wheel that carries the share ``1 + x`` of half its axle's load pulls ``(1 + x) (1 - k x)`` of half its axle's force,
    so that an axle loses ``k x^2``.
    """

    width: float  # distance between left and right wheels (m)
    roll_front: float  # share of the lateral load transfer that the front axle's roll stiffness takes
    sensitivity: float = LOAD_SENSITIVITY  # k, grip per load that a wheel loses with load

    @classmethod
    def of(cls, car: VehicleConstants) -> DoubleTrack:
        """What is plausible for a car of which only the axles are known: neutral roll stiffness, as the static loads."""
        wheelbase = car.wheelbase
        return cls(width=TRACK_WIDTH * wheelbase, roll_front=car.l_r / wheelbase)

    def wheel_loads(self, q: Motion, F_y: Array) -> Wheels:
        """Wheel loads (N) under the lateral force ``F_y`` (N) on the body; left wheels are lighter if that is positive.

        A wheel that lifts carries nothing; the other one has the whole axle then.
        """
        roll = q.h_cg * F_y / self.width if q.load_transfer else 0.0 * F_y
        front = _within(self.roll_front * roll, q.F_zf / 2)
        rear = _within((1 - self.roll_front) * roll, q.F_zr / 2)
        return Wheels(q.F_zf / 2 - front, q.F_zf / 2 + front, q.F_zr / 2 - rear, q.F_zr / 2 + rear)

    def wheel_slips(self, xp: Any, q: Motion) -> Wheels:
        """Slip angles (rad): those of the axles, which effects may have changed, and the yawing of the wheels."""
        shift = q.omega * self.width / 2
        left, right, centre = abs(q.v_x - shift), abs(q.v_x + shift), abs(q.v_x)
        front, rear = q.l_f * q.omega + q.v_y, q.l_r * q.omega - q.v_y
        front_axle, rear_axle = q.alpha_f + xp.arctan2(front, centre), q.alpha_r - xp.arctan2(rear, centre)
        return Wheels(
            front_axle - xp.arctan2(front, left),
            front_axle - xp.arctan2(front, right),
            rear_axle + xp.arctan2(rear, left),
            rear_axle + xp.arctan2(rear, right),
        )

    def forces(self, xp: Any, q: Motion) -> None:
        """Adds the yaw moment of the steered wheels."""
        q.M_z = q.M_z + q.context[_MOMENT]

    def tyres(self, xp: Any, q: Motion) -> None:
        """Puts the sum of left and right wheels in the place of each axle's lateral force."""
        alpha = self.wheel_slips(xp, q)
        full = Wheels(
            *(front_force(xp, q.theta, a) for a in alpha[:2]), *(rear_force(xp, q.theta, a) for a in alpha[2:])
        )
        for _ in range(_ROUNDS):
            F_z = self.wheel_loads(q, q.F_fy * xp.cos(q.delta) + q.F_ry)
            axles = (q.F_zf, q.F_zf, q.F_zr, q.F_zr)
            force = Wheels(*map(self._force, full, F_z, axles, (q.F_z0,) * 4))
            q.F_fy, q.F_ry = force.front_left + force.front_right, force.rear_left + force.rear_right
        moment = xp.sin(q.delta) * (force.front_left - force.front_right) * self.width / 2
        q.context = {**q.context, _MOMENT: moment}

    def _force(self, full: Array, F_z: Array, F_z_axle: Array, F_z0: Array) -> Array:
        """Lateral force (N) of a wheel whose axle has ``full`` at the nominal load."""
        return full * F_z / F_z0 * (1 - self.sensitivity * (2 * F_z / F_z_axle - 1))


def _within(value: Array, limit: Array) -> Array:
    """``value`` clipped to ``-limit .. limit``, in any array namespace."""
    return (abs(value + limit) - abs(value - limit)) / 2
