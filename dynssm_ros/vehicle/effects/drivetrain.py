"""Drivetrain: which wheels drive, and how those of an axle hang together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from dynssm_ros.vehicle.effects.base import SLOWEST, Effect, Parameter
from dynssm_ros.vehicle.single_track import Array, Motion

TRACK_WIDTH = 0.55  # of the wheelbase: 1.64 m for an Indy car, 34 mm for a 1:43 car


@dataclass(frozen=True)
class FrontDrive(Effect):
    """The share ``share`` of drive and brakes acts along the front wheels and turns with them."""

    NAME = "front_drive"
    SUMMARY = "Part of drive or brakes acts on the front wheels, and pulls the car where they point."
    ADVICE = "Measure how drive and brakes are shared between the axles, and keep it in the vehicle file."
    MANOEUVRE = "driving and braking in tight corners"
    PARAMETERS = {"share": Parameter("1", 0.0, 1.0, 0.0)}
    TYPICAL = (0.3, 0.9)
    share: Array = 0.0

    def forces(self, xp: Any, q: Motion) -> None:
        front = self.share * q.F_d
        across = front * xp.sin(q.delta)
        q.F_x = q.F_x - front * (1.0 - xp.cos(q.delta))
        q.F_y = q.F_y + across
        q.M_z = q.M_z + q.l_f * across


@dataclass(frozen=True)
class LockedDifferential(Effect):
    """A yaw moment against the turn from two rear wheels of one speed.

    They roll at ``v_x -+ omega w / 2`` over the road, ``w`` apart, and so slip by ``omega w / 2 / v_x`` against each
    other's way. A wheel answers with ``stiffness`` times its load per slip, up to the friction D_r / F_z0.
    """

    NAME = "locked_differential"
    SUMMARY = "The rear wheels turn at one speed, so in a bend they push the car straight."
    ADVICE = "Check or soften the differential's lock; expect understeer at low speed and account for it."
    MANOEUVRE = "tight corners at low speed without throttle"
    PARAMETERS = {
        "stiffness": Parameter("1", 0.0, 60.0, 0.0),
        "width": Parameter("1", 0.2, 1.0, TRACK_WIDTH, shape=True),
    }
    TYPICAL = (2.0, 30.0)
    VARIANTS = (("stiffness",),)  # the width, in wheelbases, shows in the product only
    stiffness: Array = 0.0
    width: Array = TRACK_WIDTH

    def forces(self, xp: Any, q: Motion) -> None:
        w = self.width * (q.l_f + q.l_r)
        slip = q.omega * w / 2 / (abs(q.v_x) + SLOWEST)
        friction = q.theta.D_r / q.F_z0
        force = friction * q.F_zr / 2 * xp.tanh(self.stiffness * slip / friction)
        q.M_z = q.M_z - force * w
