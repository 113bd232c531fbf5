"""How the controller works, the same for cars of any size: weights and horizon are in units of the car.

Lengths are measured in wheelbases, and times in that in which the car's grip moves it sideways by half of one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from dynssm_ros.control.horizon_model import Travel
from dynssm_ros.track.racing_line import CAR_WIDTH
from dynssm_ros.vehicle import Coefficients, Vehicle
from dynssm_ros.vehicle.limits import vehicle_limits
from dynssm_ros.vehicle.single_track import lateral_force

Objective = Literal["tracking", "progress"]
Follows = Literal["chosen", "always", "never"]
"""How what the model mispredicts is followed."""

HORIZON = 3.5  # in units of the car's time: 15 steps of 20 ms for the 1:43 car, 40 of 40 ms for an Indy car
# shares of what the tyres can give up to which an axle is used: at its peak the front gives the same for more and for less
# steering, so that a program that is linearised there knows no way back; from a slide of the rear there is none
_FRONT_USED, _REAR_USED = 0.98, 0.95
_LAG_BOUND_WHEELBASES = 0.3  # that a car may be off the line's own time and still be asked to make up for it


@dataclass(frozen=True)
class Scale:
    """What a car's motion is measured in."""

    length: float  # wheelbase (m)
    time: float  # square root of wheelbase over lateral grip (s)

    @classmethod
    def of(cls, vehicle: Vehicle) -> Scale:
        """That of a car, with the grip that it has at any speed.

        Raises:
            UserError: the car cannot drive, brake or corner.
        """
        wheelbase = vehicle.constants.wheelbase
        return cls(wheelbase, math.sqrt(wheelbase / float(np.min(vehicle_limits(vehicle).lateral))))


@dataclass(frozen=True)
class Weights:
    """What the controller minimises, in units of the car's :class:`Scale`, integrated over the horizon but at its
    end.
    """

    along: float  # of the squared distance from the reference point along the line
    across: float  # likewise across it
    progress: float  # gain per length that the horizon's last point lies further along the line
    throttle: float = 0.07  # of its squared rate (full drive force per time)
    steering: float = 15.0  # likewise (rad per time)
    border: float = 160.0  # price of the larger of what is beyond a border and a slip's bound (rad); of its square too
    terminal_speed: float = 0.0  # likewise of speed at the end above that from which the car can go on; 0: not bounded
    terminal_across: float = 0.0  # of the squared distance across the line at the end, where that speed is true


WEIGHTS: Mapping[Objective, Weights] = {
    # for the 1:43 car Q and R of the literature: bayesrace and Deep Dynamics
    "tracking": Weights(along=1.0, across=1.0, progress=0.0),
    # a point of the last plan draws as the reference does, so that no plan strays from where it was linearised
    "progress": Weights(
        along=1.0, across=10.0, progress=0.6, throttle=0.01, steering=3.0, terminal_speed=500.0, terminal_across=3.0
    ),
}


@dataclass(frozen=True)
class Settings:
    """How the controller works.

    ``tracking`` follows the reference at its own speed; ``progress`` goes as far as it can between the borders, no
    faster at the end than cornering and brakes allow on the line there. With ``evidence`` what a model says is planned
    with only where it has predicted better than the calibrated car (:mod:`dynssm_ros.control.evidence`), and borders
    and slip are kept the further off the more was mispredicted (:mod:`dynssm_ros.control.caution`).
    """

    scale: Scale  # of the car
    objective: Objective = "tracking"
    N: int = 15  # steps of the horizon
    deadline: float = math.inf  # time (s) after which a plan comes too late and is not used
    margin: float = 0.0  # distance to keep between the car's centre and the borders (m)
    slip: tuple[float, float] = (math.inf, math.inf)  # angles of front and rear axle that no step is to exceed (rad)
    lag_bound: float = 0.0  # most that the car may be off the place of one that keeps the line's time (m)
    follows: Follows = "chosen"  # at a rate that the data choose, at a fixed one, or not at all; see disturbance
    evidence: bool = True
    travel: Travel = "middle"  # what carries the pose over a step
    input_unit: float = 1.0  # change of the first input from no drive force to all of it: a fraction, or m/s

    @classmethod
    def of(
        cls,
        vehicle: Vehicle,
        objective: Objective = "tracking",
        N: int | None = None,
        offset_free: bool = False,
        evidence: bool = True,
    ) -> Settings:
        """For a car as its file describes it: a plan has a control period of time, half the car stays within the
        borders.

        Args:
            vehicle: the car.
            objective: see above.
            N: steps of the horizon; ``None``: ``HORIZON``.
            offset_free: what the model mispredicts is followed at a fixed rate.
            evidence: see above; without it, and unless ``offset_free``, the model is planned with as it is.

        Raises:
            UserError: the car cannot drive, brake or corner.
        """
        scale = Scale.of(vehicle)
        steps = round(HORIZON * scale.time / vehicle.sampling_time) if N is None else N
        half_width = CAR_WIDTH * scale.length / 2
        th = Coefficients(*vehicle.nominal)
        slip = _slip(_FRONT_USED, th.B_f, th.C_f, th.E_f), _slip(_REAR_USED, th.B_r, th.C_r, th.E_r)
        lag_bound = _LAG_BOUND_WHEELBASES * scale.length
        follows: Follows = "always" if offset_free else "chosen" if evidence else "never"
        return cls(
            scale, objective, steps, vehicle.sampling_time, half_width, slip, lag_bound, follows, evidence,
            input_unit=vehicle.input_unit,
        )  # fmt: skip

    @property
    def weights(self) -> Weights:
        """Those of the objective."""
        return WEIGHTS[self.objective]

    @property
    def rates(self) -> tuple[float, float]:
        """Weights of the squared increments of both inputs, as they are (fraction or m/s, and rad)."""
        return self.weights.throttle / self.input_unit**2, self.weights.steering


def _slip(share: float, B: float, C: float, E: float) -> float:
    """Slip angle (rad) at which tyres give ``share`` of what they can."""
    slip = np.linspace(0.0, 1.0, 1001)
    force = lateral_force(np, slip, B=B, C=C, D=1.0, E=E, S_v=0.0)
    return float(slip[np.argmax(force >= share * np.max(force))])
