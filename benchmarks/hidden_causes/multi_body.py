"""A car that somebody else wrote: CommonRoad's multi-body model, with causes hidden in its own equations.

It has 29 states: a body that rolls and pitches, two axles on springs, four wheels that spin, and PAC2002 tyres with camber
and combined slip (Althoff, Koschi and Manzinger 2017). Its engine has a greatest power, and its brakes act on all wheels.
It is registered as the plant ``multi_body`` and needs the library ``commonroad-vehicle-models``.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Sequence
from copy import deepcopy
from functools import partial
from pathlib import Path
from typing import Any

from dynssm_ros.errors import ConfigurationError
from dynssm_ros.simulation.plant import RK4_STEP, Plant, Rk4Plant, register_plant
from dynssm_ros.track.lines import Line
from dynssm_ros.vehicle import Applied, State, Vehicle
from dynssm_ros.vehicle.effects import EFFECTS
from dynssm_ros.vehicle.integrators import integrate
from dynssm_ros.vehicle.kinematics import Pose
from dynssm_ros.vehicle.parameters import EffectEntry
from dynssm_ros.vehicle.single_track import GRAVITY, StageEffect

NAME = "multi_body"
FILE = Path(__file__).with_name("bmw_320i.yaml")  # of the team that drives it
HIDES = (
    "steering_offset", "steering_gain", "steering_curve", "steering_lag", "throttle_dead_band", "throttle_lag", "drag",
    "rolling_resistance", "drive_gain", "mass", "yaw_inertia", "grip", "grip_patch", "road_bank", "odometry_lever_arm",
    "odometry_misalignment", "odometry_delay", "yaw_rate_bias", "yaw_rate_lag",
)  # fmt: skip
"""Effects that can be hidden in it."""
_CAR = 2  # BMW 320i
_FULL_THROTTLE = 6.0  # m/s^2 of the car as it is
_AIR = 0.45  # N/(m/s)^2, which the library leaves out
_DELTA, _V_X, _THETA, _OMEGA, _V_Y, _V_Y_FRONT, _V_Y_REAR = 2, 3, 4, 5, 10, 15, 20  # of the library's states
_LONGEST_DELAY = 0.5  # s


class _Changes:
    """What is hidden; every other effect is neutral."""

    def __init__(self, effects: Iterable[EffectEntry]) -> None:
        self._hidden = {entry.name: entry.parameters for entry in effects}
        if unknown := sorted(set(self._hidden) - set(HIDES)):
            raise ConfigurationError(f"plant {NAME}: {', '.join(unknown)}; expected some of {', '.join(HIDES)}")

    def __call__(self, effect: str, parameter: str) -> float:
        return self._hidden.get(effect, {}).get(parameter, EFFECTS[effect].PARAMETERS[parameter].neutral)


class MultiBody:
    """The car on the road; see :class:`~dynssm_ros.simulation.plant.Plant`."""

    def __init__(self, vehicle: Vehicle, pose: Pose, state: State, line: Line | None) -> None:
        from vehiclemodels.init_mb import init_mb
        from vehiclemodels.vehicle_dynamics_mb import vehicle_dynamics_mb
        from vehiclemodels.vehicle_parameters import setup_vehicle_parameters

        self._rates_of = vehicle_dynamics_mb
        self._changed = changed = _Changes(vehicle.effects)
        self._line, self._T_s = line, vehicle.sampling_time
        self._car = car = setup_vehicle_parameters(_CAR)
        heavier = changed("mass", "factor")
        more = car.m * (heavier - 1.0)
        car.m, car.m_s = car.m + more, car.m_s + more
        # the library is asked for accelerations; engine and brakes of a heavier car are the same
        self._full_throttle = _FULL_THROTTLE / heavier
        car.longitudinal.a_max /= heavier
        car.I_z *= changed("yaw_inertia", "factor")
        self._tyres = _gripping(car.tire, changed("grip", "factor"))
        self._on_patch = _gripping(self._tyres, changed("grip_patch", "factor"))
        self._air = _AIR + changed("drag", "coefficient")
        self._rolling = GRAVITY * changed("rolling_resistance", "coefficient")
        self._aside = GRAVITY * math.sin(changed("road_bank", "angle"))
        drift = math.atan2(state.v_y, state.v_x)
        speed = math.hypot(state.v_x, state.v_y)
        self._x: list[float] = init_mb([pose.x, pose.y, 0.0, speed, pose.theta, state.omega, drift], car)
        self._acting: Applied | None = None
        self._late_omega = state.omega
        self._past = deque([self.state], maxlen=1 + round(_LONGEST_DELAY / RK4_STEP))

    @property
    def pose(self) -> Pose:
        return Pose(self._x[0], self._x[1], self._x[_THETA])

    @property
    def state(self) -> State:
        return State(self._x[_V_X], self._x[_V_Y], self._x[_OMEGA])

    @property
    def measured(self) -> State:
        changed = self._changed
        late = round(changed("odometry_delay", "delay") / RK4_STEP)
        v_x, v_y, omega = self._past[max(-1 - late, -len(self._past))]
        v_x -= omega * changed("odometry_lever_arm", "y")
        v_y += omega * changed("odometry_lever_arm", "x")
        sin, cos = (f(changed("odometry_misalignment", "angle")) for f in (math.sin, math.cos))
        v_x, v_y = cos * v_x + sin * v_y, cos * v_y - sin * v_x
        if changed("yaw_rate_lag", "time_constant"):
            omega = self._late_omega
        return State(v_x, v_y, omega + changed("yaw_rate_bias", "bias"))

    def advance(self, applied: Applied, s: float = 0.0) -> None:
        """Moves it on by T_s; see :class:`~dynssm_ros.simulation.plant.Plant`."""
        changed, wanted = self._changed, self._wanted(applied)
        self._car.tire = self._on_patch if self._is_on_patch(s) else self._tyres
        count = math.ceil(self._T_s / RK4_STEP - 1e-9)
        h = self._T_s / count
        lags = changed("throttle_lag", "time_constant"), changed("steering_lag", "time_constant")
        gyroscope_lag = changed("yaw_rate_lag", "time_constant")
        for _ in range(count):
            before = self._acting or wanted
            self._acting = Applied(*(_followed(*each, h) for each in zip(before, wanted, lags, strict=True)))
            self._x[_DELTA] = self._acting.delta
            rates = partial(self._rates, throttle=self._acting.r)
            change = integrate(rates, tuple(self._x), h, "rk4", 1)
            self._x = [value + by for value, by in zip(self._x, change, strict=True)]
            self._late_omega = _followed(self._late_omega, self._x[_OMEGA], gyroscope_lag, h)
            self._past.append(self.state)

    def _wanted(self, applied: Applied) -> Applied:
        changed = self._changed
        delta = applied.delta * changed("steering_gain", "factor") + changed("steering_offset", "offset")
        bent = changed("steering_curve", "quadratic") * delta + changed("steering_curve", "cubic") * delta * delta
        beyond = max(abs(applied.r) - changed("throttle_dead_band", "width"), 0.0)
        return Applied(math.copysign(beyond, applied.r) * changed("drive_gain", "factor"), delta * (1.0 + bent))

    def _is_on_patch(self, s: float) -> bool:
        if self._line is None:
            return False
        centre, length = (self._changed("grip_patch", name) for name in ("centre", "length"))
        return abs((s / self._line.length - centre + 0.5) % 1.0 - 0.5) < length / 2

    def _rates(self, x: Sequence[float], throttle: float) -> tuple[float, ...]:
        """The library's equations with air and road."""
        rates = self._rates_of(list(x), [0.0, self._full_throttle * throttle], self._car)
        rates[_V_X] -= self._air * x[_V_X] ** 2 / self._car.m + self._rolling
        for one in (_V_Y, _V_Y_FRONT, _V_Y_REAR):
            rates[one] -= self._aside
        return tuple(rates)


def _gripping(tyre: Any, factor: float) -> Any:
    """A tyre of which all forces are so many times as large."""
    other = deepcopy(tyre)
    for name in ("p_dx1", "p_kx1", "p_dy1", "p_ky1"):  # peak and stiffness, along and across
        setattr(other, name, factor * getattr(tyre, name))
    return other


def _followed(value: float, target: float, time_constant: float, h: float) -> float:
    """``value`` after ``h`` seconds of a first-order lag behind ``target``."""
    return target if time_constant == 0.0 else target + (value - target) * math.exp(-h / time_constant)


class MultiBodyPlant(Rk4Plant):
    """The car in steps of 1 ms."""

    def make(self, vehicle: Vehicle, pose: Pose, state: State, last: Sequence[StageEffect], line: Line | None) -> Plant:
        """One with the vehicle's effects hidden in it; nothing else of the vehicle is its own."""
        return MultiBody(vehicle, pose, state, line)


register_plant(NAME, MultiBodyPlant())
