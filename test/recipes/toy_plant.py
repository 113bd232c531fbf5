"""Recipe 3, a new plant: the single-track car whose right foot is heavy."""

from __future__ import annotations

from typing import Any

from dynssm_ros import register_plant
from dynssm_ros.simulation.plant import Rk4Plant
from dynssm_ros.vehicle import Vehicle
from dynssm_ros.vehicle.single_track import Motion, StageEffect


class HeavyFoot(StageEffect):
    """Five per cent more throttle than asked for."""

    def inputs(self, xp: Any, q: Motion) -> None:
        """Scales the throttle."""
        q.r = 1.05 * q.r


class HeavyFootPlant(Rk4Plant):
    """As ``rk4``, driven with a heavy foot."""

    def first(self, vehicle: Vehicle) -> tuple[StageEffect, ...]:
        """The foot."""
        return (HeavyFoot(),)


register_plant("heavy_foot", HeavyFootPlant())
