"""Recipe 1, a new effect: the driver's weight, which shifts forward when he brakes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from dynssm_ros import register_effect
from dynssm_ros.vehicle.effects import Effect, Parameter
from dynssm_ros.vehicle.single_track import Array, Motion


@register_effect
@dataclass(frozen=True)
class BrakeDrag(Effect):
    """``coefficient * v_x`` holds the car back: a brake that never lets go, felt more at speed."""

    NAME = "brake_drag"
    SUMMARY = "A dragging brake holds the car back in proportion to its speed."
    ADVICE = "Check the brake's release springs and the master cylinder."
    MANOEUVRE = "coasting from high to low speed"
    PARAMETERS = {"coefficient": Parameter("N s/m", -0.05, 0.1, 0.0)}
    TYPICAL = (0.005, 0.05)
    coefficient: Array = 0.0

    def drive(self, xp: Any, q: Motion) -> None:
        """Takes the drag off the longitudinal force."""
        q.F_rx = q.F_rx - self.coefficient * q.v_x
