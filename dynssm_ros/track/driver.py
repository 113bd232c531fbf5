"""A driver: pure pursuit of a line, speed control to its profile, and habits that vary so that laps differ."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from dynssm_ros.track.lines import Line
from dynssm_ros.track.speed_profile import speed_profile
from dynssm_ros.vehicle import Applied, Coefficients, State, Vehicle
from dynssm_ros.vehicle.kinematics import Pose
from dynssm_ros.vehicle.limits import Limits
from dynssm_ros.vehicle.single_track import cornering_stiffness, speed_error_for


@dataclass(frozen=True)
class Style:
    """How the driver drives.

    At ``variation`` 1 speed and line vary slowly: down to 0.7 of the profile's speed, and up to 0.3 of the way from the
    line to the nearer border. At 0 all laps are the same.
    """

    aggressiveness: float = 0.95  # share of grip, drive and brakes that the speed profile asks for
    variation: float = 0.5


class SlowVariation:
    """A smooth signal in [-1, 1]: sines of random phase with periods between half and twice ``period`` (s)."""

    def __init__(self, rng: np.random.Generator, period: float, count: int = 4) -> None:
        rates = 2 * np.pi / (period * np.exp2(rng.uniform(-1, 1, count)))
        self._terms = [(float(w), float(p)) for w, p in zip(rates, rng.uniform(0, 2 * np.pi, count), strict=True)]

    def __call__(self, time: float) -> float:
        """The value at ``time`` (s)."""
        return sum(math.sin(rate * time + phase) for rate, phase in self._terms) / len(self._terms)


class Driver:
    """Drives one car along one line, with ``room`` metres to either side. The same seed gives the same drive."""

    def __init__(
        self, vehicle: Vehicle, line: Line, limits: Limits, style: Style, *, seed: int = 0, room: float = 0.0
    ) -> None:
        self.line = line
        self._slower = 0.3 * style.variation
        self._wander = 0.3 * style.variation * room
        self._profile = speed_profile(line, limits, style.aggressiveness)
        self._vehicle = vehicle
        self._theta = Coefficients(*vehicle.nominal.tolist())
        self._stiffness = sum(cornering_stiffness(self._theta))
        rng = np.random.default_rng(seed)
        lap_time = float(np.sum(line.steps / self._profile[: len(line.steps)]))
        self._slowing = SlowVariation(rng, lap_time / 2)
        self._place = SlowVariation(rng, lap_time / 2)

    def speed(self, s: float) -> float:
        """The profile's speed (m/s) at ``s`` (m, periodic)."""
        return float(np.interp(s, self.line.s, self._profile, period=self.line.length if self.line.closed else None))

    def offset(self, time: float) -> float:
        """How far beside the line (m, positive left) the driver wants to be at ``time`` (s)."""
        return self._wander * self._place(time)

    def command(self, time: float, pose: Pose, state: State, s: float, previous: Applied) -> Applied:
        """Absolute throttle and steering within the actuators' limits, reached from the ``previous`` ones.

        ``time`` is since the start (s), ``s`` the car's position along the line (m).
        """
        offset = self.offset(time)
        wanted = Applied(self._throttle(time, state, s, offset, previous), self._steering(pose, state, s, offset))
        return self._vehicle.inputs.reached(wanted, previous, self._vehicle.sampling_time)

    def _steering(self, pose: Pose, state: State, s: float, offset: float) -> float:
        """Pure pursuit of the rear axle; its sideslip counts, so that a car at the limit still meets the line."""
        car = self._vehicle.constants
        T_s, wheelbase = self._vehicle.sampling_time, car.wheelbase
        x, y = pose.x - car.l_r * math.cos(pose.theta), pose.y - car.l_r * math.sin(pose.theta)
        v_x = max(state.v_x, 1e-3)
        lag = car.m * v_x / self._stiffness  # of the sideslip behind the steering
        ahead = 2.5 * wheelbase + (2.5 * T_s + 2 * lag) * v_x
        target = self.line.position(s - car.l_r + ahead, offset)
        course = pose.theta + math.atan2(state.v_y - car.l_r * state.omega, v_x)
        bearing = math.atan2(target[1] - y, target[0] - x) - course
        distance = math.hypot(target[0] - x, target[1] - y)
        curvature = 2 * math.sin(bearing) / distance
        error = curvature - state.omega / v_x  # damps the chase, and makes up for understeer
        return math.atan(wheelbase * (curvature + error))

    def _throttle(self, time: float, state: State, s: float, offset: float, previous: Applied) -> float:
        """The throttle or set-point that removes the speed error in a few steps, with what resists the car added."""
        th, car = self._theta, self._vehicle.constants
        horizon = 5 * self._vehicle.sampling_time
        ahead = s + state.v_x * horizon
        slowed = 1 - self._slower * (1 + self._slowing(time)) / 2
        tighter = math.sqrt(max(1 - float(self.line.curvature(ahead)) * offset, 0.1))
        error = slowed * tighter * self.speed(ahead) - state.v_x
        cornering = car.m * state.v_x * state.omega * math.sin(previous.delta) * car.l_r / car.wheelbase
        force = car.m * error / horizon + th.C_r0 + th.C_r2 * state.v_x**2 + cornering
        if self._vehicle.inputs.set_point == "speed":
            return float(state.v_x) + speed_error_for(th, force)
        return float(force / max(th.C_m1 - th.C_m2 * state.v_x, 0.1 * th.C_m1))
