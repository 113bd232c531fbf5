"""Parameter files of simulators with linear tyres: f1tenth_gym and the single track of CommonRoad's vehicle models.

Both take the lateral force of an axle for ``mu C_S F_z alpha`` (Althoff, Koschi and Manzinger 2017). So the slope of the
calibrated tyre at no slip is kept, and its peak, the drive's dependence on speed, drag and effects are not.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import yaml

from dynssm_ros.control.exports.names import identifier
from dynssm_ros.errors import ConfigurationError
from dynssm_ros.vehicle import Coefficients, Vehicle
from dynssm_ros.vehicle.limits import vehicle_limits
from dynssm_ros.vehicle.single_track import GRAVITY, cornering_stiffness

_LENGTH, _WIDTH = 1.75, 0.94  # of a car, in wheelbases, as of the 1:10 car; they serve collisions alone
_HEAD = """\
# Car {name} for {what}, written by dynssm_ros.
# Kept: mass, geometry, yaw inertia, cornering stiffness at small slip, limits of actuators and accelerations.
# Not kept: what the tyre loses towards its peak, load dependence{axles}, drag, effects. Length and width are guesses.
"""


class LinearCar(NamedTuple):
    """A car with linear tyres.

    Attributes:
        mu: friction that carries the largest lateral acceleration.
        C_Sf, C_Sr: slope of the lateral force over ``mu F_z`` of an axle at rest (1/rad).
        h: height of the centre of gravity as far as it shifts load (m).
        a_max: largest acceleration (m/s^2), drive or brake.
        v_switch: speed above which the drive falls as 1/v (m/s).
        v_max: top speed (m/s).
        v_min: largest speed backwards, negative (m/s).
        I_z: yaw inertia (kg m^2).
    """

    mu: float
    C_Sf: float
    C_Sr: float
    h: float
    a_max: float
    v_switch: float
    v_max: float
    v_min: float
    I_z: float


def linear_car(vehicle: Vehicle) -> LinearCar:
    """The car about straight and slow driving.

    Raises:
        ConfigurationError: an axle's force falls with the slip angle.
    """
    car, limits = vehicle.constants, vehicle_limits(vehicle)
    theta = Coefficients(*vehicle.nominal.tolist())
    mu = float(limits.lateral[0]) / GRAVITY
    weight = car.m * GRAVITY / car.wheelbase
    stiffness = []
    for slope, load in zip(cornering_stiffness(theta), (weight * car.l_r, weight * car.l_f), strict=True):
        actual = slope * (load / car.F_z0 if car.load_transfer else 1.0)
        stiffness.append(float(actual / (mu * load)))
    if min(stiffness) <= 0:
        raise ConfigurationError(
            f"vehicle {vehicle.name}: cornering stiffness B C D of {min(stiffness):.3g}; expected more than 0"
        )
    backwards = min(vehicle.inputs.throttle[0], 0.0) if vehicle.inputs.set_point == "speed" else 0.0
    most = float(max(limits.drive[0], limits.brake[0]))
    half = float(np.interp(-limits.drive[0] / 2, -limits.drive, limits.speed))  # where half of the drive is left
    return LinearCar(
        mu, stiffness[0], stiffness[1], h=car.h_cg if car.load_transfer else 0.0, a_max=most,
        v_switch=half * float(limits.drive[0]) / 2 / most, v_max=limits.top_speed,
        v_min=-limits.top_speed if car.reverse else backwards, I_z=theta.I_z,
    )  # fmt: skip


def f1tenth_gym_files(vehicle: Vehicle) -> dict[str, str]:
    """The ``params`` of an f1tenth_gym environment."""
    car, linear, inputs = vehicle.constants, linear_car(vehicle), vehicle.inputs
    values = {
        "mu": linear.mu, "C_Sf": linear.C_Sf, "C_Sr": linear.C_Sr, "lf": car.l_f, "lr": car.l_r, "h": linear.h, "m": car.m,
        "I": linear.I_z, "s_min": inputs.steering[0], "s_max": inputs.steering[1],
        "sv_min": -inputs.steering_rate, "sv_max": inputs.steering_rate, "v_switch": linear.v_switch, "a_max": linear.a_max,
        "v_min": linear.v_min, "v_max": linear.v_max, "width": _WIDTH * car.wheelbase, "length": _LENGTH * car.wheelbase,
    }  # fmt: skip
    name = identifier(vehicle.name)
    return {f"{name}_f1tenth_gym.yaml": _HEAD.format(name=name, what="f1tenth_gym", axles="") + _yaml(values)}


def commonroad_files(vehicle: Vehicle) -> dict[str, str]:
    """What ``setup_vehicle_parameters(1, Path(FOLDER))`` of CommonRoad's vehicle models reads: for ``ks`` and ``st``."""
    car, linear, inputs = vehicle.constants, linear_car(vehicle), vehicle.inputs
    both = (linear.C_Sf + linear.C_Sr) / 2
    values = {
        "l": _LENGTH * car.wheelbase, "w": _WIDTH * car.wheelbase, "m": car.m, "a": car.l_f, "b": car.l_r,
        "I_z": linear.I_z, "h_s": linear.h, "h_cg": linear.h,
        "steering": {
            "min": inputs.steering[0], "max": inputs.steering[1], "v_min": -inputs.steering_rate,
            "v_max": inputs.steering_rate,
        },
        "longitudinal": {
            "v_min": linear.v_min, "v_max": linear.v_max, "v_switch": linear.v_switch, "a_max": linear.a_max,
        },
    }  # fmt: skip
    head = _HEAD.format(
        name=identifier(vehicle.name),
        what="CommonRoad's single track",
        axles=", the difference of front and rear tyres",
    )
    return {
        "parameters_vehicle1.yaml": head + _yaml(values),
        "parameters_tire.yaml": head + _yaml({"tire": {"p_dy1": linear.mu, "p_ky1": -linear.mu * both}}),
    }


def _yaml(values: dict[str, Any]) -> str:
    return yaml.safe_dump(values, sort_keys=False)
