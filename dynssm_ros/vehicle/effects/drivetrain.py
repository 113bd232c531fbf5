"""Drivetrain: which wheels drive, and how those of an axle hang together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.vehicle.effects.base import SLOWEST, Effect, Parameter, like
from dynssm_ros.vehicle.effects.step_errors import StepErrors, changed_above, shift_speeds
from dynssm_ros.vehicle.single_track import Array, Motion, at_least

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
    LEAST = 0.2  # in cars without it tyres and steering that are not of the equations looked like 0.09 to 0.12
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
    ADVICE = "Check or soften the differential's lock; expect understeer at low speed."
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


@dataclass(frozen=True)
class GearShift(Effect):
    """Drive force times ``factor`` in the gear above, and times ``1 - gap`` in the middle of a change; brakes are as before.

    The gear changes up where the speed exceeds ``up`` and down where it falls below ``down``. Its state ``g`` goes from 0 to
    1 and back, ``dg/dt = ((v > up) (1 - g) - (v < down) g) / time_constant``; the force is that of the lower gear times
    ``(1 + (factor - 1) g) (1 - 4 gap g (1 - g))``. Between the speeds the drive until then tells the gear; where it is not
    known, it is by the middle of the two.
    """

    NAME = "gear_shift"
    SUMMARY = "The drive force changes with the gear, and has a gap while the gear changes."
    ADVICE = "Take gear ratios and speeds of changes into the model; shorten their gap."
    MANOEUVRE = "accelerating and coasting through the speeds at which the gear changes, again and again"
    PARAMETERS = {
        "factor": Parameter("1", 0.4, 1.8, 1.0),
        "gap": Parameter("1", 0.0, 1.0, 0.0),
        "up": Parameter("m/s", 0.1, 100.0, 16.0, shape=True),
        "down": Parameter("m/s", 0.1, 100.0, 13.0, shape=True),
        "time_constant": Parameter("s", 0.01, 1.0, 0.1, shape=True),
    }
    VARIANTS = (("factor",), ("gap",), ("factor", "gap"))
    READ_OFF = ("up", "down")
    TYPICAL = (0.1, 0.3)
    EFFECT_STATES = ("gear_shift.gear",)
    factor: Array = 1.0
    gap: Array = 0.0
    up: Array = 16.0
    down: Array = 13.0
    time_constant: Array = 0.1

    @classmethod
    def read_off(cls, steps: StepErrors) -> dict[str, float] | None:
        """The speeds at which the gear changes up and down."""
        found = shift_speeds(steps)
        return None if found is None else dict(zip(cls.READ_OFF, found, strict=True))

    @classmethod
    def drawn(cls, amount: float, rng: np.random.Generator) -> dict[str, float]:
        """A force that is that much larger or smaller in the upper gear of a full-size car."""
        up = float(rng.uniform(22.0, 30.0))
        return {"factor": 1.0 + float(rng.choice([-1.0, 1.0])) * amount, "up": up, "down": 0.85 * up}

    def before(self, rows: Vector) -> dict[str, Vector]:
        (name,) = self.EFFECT_STATES
        return {name: changed_above(rows[0], self.up, self.down)} if isinstance(self.up, float) else {}

    def drive(self, xp: Any, q: Motion) -> None:
        (name,) = self.EFFECT_STATES
        speed = abs(q.v_x)
        first = q.context[name] if name in q.context else like(q, 1.0 * (speed > (self.up + self.down) / 2))
        gear: Array = q.effect_states.setdefault(name, first)
        rate = (speed > self.up) * (1.0 - gear) - (speed < self.down) * gear
        q.effect_state_rates[name] = rate / at_least(self.time_constant, q.h)
        changed = (1.0 + (self.factor - 1.0) * gear) * (1.0 - 4.0 * self.gap * gear * (1.0 - gear))
        drives = at_least(q.direction * q.F_d, 0.0) * q.direction
        q.F_rx = q.F_rx + (changed - 1.0) * drives
        q.F_d = q.F_d + (changed - 1.0) * drives
