"""A car that none of the package's equations know: brush tyres that gain less force than load, and compliant steering.

It is registered as the plant ``foreign``. Its tyres have the cornering stiffness and the peak of the vehicle file's Pacejka
tyres at the nominal load, and another curve between (Fiala's brush model). The front wheels turn back under their lateral
force.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from dynssm_ros.simulation.plant import Rk4Plant, register_plant
from dynssm_ros.vehicle import Vehicle
from dynssm_ros.vehicle.single_track import Array, Motion, StageEffect, cornering_stiffness

NAME = "foreign"
_ROUNDS = 4  # of lateral force and steering that gives way, which hang on each other weakly


@dataclass(frozen=True)
class BrushTyres(StageEffect):
    """Puts brush tyres in the place of the Pacejka tyres."""

    peak_exponent: float = 0.85  # of the axle load, with which the peak force grows
    stiffness_exponent: float = 0.7  # the same of the cornering stiffness
    compliance: float = 0.01  # angle (rad) by which the front wheels turn back under the front axle's peak force

    def tyres(self, xp: Any, q: Motion) -> None:
        stiffness, peaks = cornering_stiffness(q.theta), (q.theta.D_f, q.theta.D_r)
        shifts = q.theta.S_vf, q.theta.S_vr
        front = 0.0
        for _ in range(_ROUNDS):
            slip = q.alpha_f - self.compliance * front / peaks[0]
            front = self._force(stiffness[0], peaks[0], slip, q.F_zf / q.F_z0) + shifts[0]
        q.F_fy = front
        q.F_ry = self._force(stiffness[1], peaks[1], q.alpha_r, q.F_zr / q.F_z0) + shifts[1]

    def _force(self, stiffness: Array, peak: Array, slip: Array, load: Array) -> Array:
        """Lateral force (N) of an axle at ``load`` times the nominal load."""
        load = _within(load, 0.05, 20.0)
        C, F = stiffness * load**self.stiffness_exponent, peak * load**self.peak_exponent
        x = _within(C * slip / (3.0 * F), -1.0, 1.0)  # 1 where the whole contact slides
        return F * (3.0 * x - 3.0 * x * abs(x) + x * x * x)


def _within(value: Array, low: float, high: float) -> Array:
    """``value`` clipped to ``low .. high``, in any array namespace."""
    return (abs(value - low) - abs(value - high) + low + high) / 2


class ForeignPlant(Rk4Plant):
    """The car on the road."""

    def first(self, vehicle: Vehicle) -> tuple[StageEffect, ...]:
        return (BrushTyres(),)


register_plant(NAME, ForeignPlant())
