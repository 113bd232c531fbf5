"""Inertia: mass and its distribution."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from dynssm_ros.vehicle.effects.base import Effect, Parameter
from dynssm_ros.vehicle.single_track import Array, Motion


@dataclass(frozen=True)
class Mass(Effect):
    """``factor * m``: in the accelerations and in the axle loads. I_z stays."""

    NAME = "mass"
    SUMMARY = "The car is heavier or lighter than the vehicle file says: fuel, ballast, driver, an estimate."
    ADVICE = "Weigh the car as it runs, with fuel, and correct m in the vehicle file."
    MANOEUVRE = "full throttle and coasting at different speeds"
    PARAMETERS = {"factor": Parameter("1", 0.6, 1.6, 1.0)}
    TYPICAL = (0.11, 0.2)
    factor: Array = 1.0

    def inputs(self, xp: Any, q: Motion) -> None:
        q.m = q.m * self.factor


@dataclass(frozen=True)
class YawInertia(Effect):
    """``factor * I_z``."""

    NAME = "yaw_inertia"
    SUMMARY = "The car resists yawing more or less than the vehicle file says: its masses lie further out or in."
    ADVICE = "Measure the yaw inertia (bifilar pendulum) or sum it up from the parts, and correct I_z."
    MANOEUVRE = "quick steering from side to side at constant speed"
    PARAMETERS = {"factor": Parameter("1", 0.4, 2.5, 1.0)}
    TYPICAL = (0.2, 0.5)
    factor: Array = 1.0

    def inputs(self, xp: Any, q: Motion) -> None:
        q.theta = q.theta._replace(I_z=q.theta.I_z * self.factor)
