"""A first vehicle file: a known car scaled to what a scale and a ruler tell of another one of its kind.

Forces grow with the weight, the yaw inertia with ``m l_f l_r``, drag with the square of the wheelbase. What remains is a
guess, and its standard deviations and bounds say so, however well the known car was known.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, get_args

from dynssm_ros import configuration
from dynssm_ros.vehicle.limits import vehicle_limits
from dynssm_ros.vehicle.parameters import COEFFICIENT_UNITS, COEFFICIENTS, Vehicle
from dynssm_ros.vehicle.single_track import GRAVITY, SetPoint

Tyre = Literal["road", "slick", "rubber"]


class TyreKind(NamedTuple):
    """The magic formula of a kind of tyre, over its load."""

    friction: float  # D over the load
    B: float  # 1/rad
    C: float
    E: float
    words: str


TYRES: dict[Tyre, TyreKind] = {
    "road": TyreKind(1.0, 13.0, 1.4, -0.3, "summer tyres on dry asphalt"),
    "slick": TyreKind(1.45, 11.0, 1.45, -0.5, "warm racing slicks on dry asphalt"),
    "rubber": TyreKind(0.9, 5.0, 1.3, 0.0, "small rubber tyres on a hall's floor"),
}
"""Middles of what textbooks and public car models have (Pacejka; Milliken and Milliken; CommonRoad; f1tenth_gym)."""
assert tuple(TYRES) == get_args(Tyre)


class _Guess(NamedTuple):
    """How well a value is known that comes from another car of its kind."""

    share: float  # standard deviation, of the value
    least: float  # and at least, in the coefficient's own unit or that of its scale
    low: float  # bounds: the value over this ...
    high: float  # ... and times this; of values that may be 0 or negative instead that far from 0, in the scale


_GUESSES = {
    "B": _Guess(0.3, 0.0, 4.0, 4.0),
    "C": _Guess(0.0, 0.2, 0.8, 2.2),
    "D": _Guess(0.25, 0.0, 3.0, 2.5),
    "E": _Guess(0.0, 0.5, -3.0, 1.0),
    "S_h": _Guess(0.0, 0.015, -0.08, 0.08),
    "S_v": _Guess(0.0, 0.03, -0.2, 0.2),  # of F_z0
    "C_m1": _Guess(0.5, 0.0, 4.0, 4.0),
    "C_m2": _Guess(0.5, 0.0, 6.0, 6.0),
    "C_r0": _Guess(0.5, 0.002, 0.0, 0.1),  # of the weight
    "C_r2": _Guess(0.5, 0.0, 0.0, 8.0),
    "I_z": _Guess(0.25, 0.0, 3.0, 3.0),
}
_WORDS = {
    "B": "stiffness of the tyres", "C": "shape", "D": "largest lateral force at F_z0", "E": "curvature",
    "S_h": "steering or sensors that are off go in here", "S_v": "banking goes in here",
    "C_m1": "force at full throttle and standstill", "C_m2": "how it falls with speed",
    "C_r0": "rolling resistance", "C_r2": "drag", "I_z": "yaw inertia",
}  # fmt: skip
_OF_CONTROLLER = {"C_m1": "largest force of the speed controller", "C_m2": "gain of the speed controller"}
_REACHED_S = 0.16  # within which a speed controller reaches its set-point: that of the f1tenth
_WEIGHED = 0.01  # share of the mass to which a car is weighed, with fuel or batteries that differ


@dataclass(frozen=True)
class MeasuredCar:
    """What a scale and a ruler tell of a car."""

    mass: float  # ready to drive (kg)
    front_mass: float  # on the front axle (kg)
    wheelbase: float  # m
    height: float | None = None  # of the centre of gravity (m); None: as of the known car, in wheelbases
    acceleration: float | None = None  # the best, and of the brakes (m/s^2); None: that of the known car
    steering: float | None = None  # largest angle of the road wheels (rad); None: that of the known car
    sampling_time: float | None = None  # s; None: that of the known car

    @property
    def l_f(self) -> float:
        """Centre of gravity to front axle (m)."""
        return self.wheelbase * (1 - self.front_mass / self.mass)


def drafted(
    like: Vehicle, name: str, car: MeasuredCar, *, tyre: Tyre | None = None, set_point: SetPoint | None = None
) -> Vehicle:
    """The car ``name``, of the kind of ``like``.

    Args:
        like: a known car.
        name: of the new one.
        car: what is measured of it.
        tyre: kind of the tyres on both axles; those of the known car if not given.
        set_point: its first input; that of the known car if not given.

    Raises:
        ConfigurationError: no car is like that.
    """
    if set_point not in (None, like.inputs.set_point):
        like = _commanded_otherwise(like)
    old = like.constants
    length = car.wheelbase / old.wheelbase
    load = car.mass * GRAVITY / 2
    height = old.h_cg * length if car.height is None else car.height
    steering = like.inputs.steering if car.steering is None else (-car.steering, car.steering)
    values = _scaled(like, car, length, load)
    if tyre is not None:
        kind = TYRES[tyre]
        for axle in "fr":
            own = {"B": kind.B, "C": kind.C, "D": kind.friction * load, "E": kind.E}
            values |= {f"{key}_{axle}": value for key, value in own.items()}
    scales = {"S_v": load, "C_r0": car.mass * GRAVITY}
    content: dict[str, Any] = {
        "name": name,
        "description": f"a guess from {like.name}, scaled to its mass and wheelbase",
        "constants": {
            "m": _rounded(car.mass, 6), "m_std": _rounded(_WEIGHED * car.mass), "l_f": _rounded(car.l_f),
            "l_r": _rounded(car.wheelbase - car.l_f), "h_cg": _rounded(height), "F_z0": _rounded(load),
            "load_transfer": height > 0,
        },
        "sampling_time": car.sampling_time or like.sampling_time,
        "minimum_speed": _rounded(like.minimum_speed * math.sqrt(length), 2),
        "inputs": like.inputs.model_dump() | {"steering": steering},
        "coefficients": {key: _guessed(key, values[key], like, scales.get(_kind(key), 1.0)) for key in COEFFICIENTS},
    }  # fmt: skip
    return configuration.validate(Vehicle, content, f"vehicle {name}")


def as_commented_file(vehicle: Vehicle, head: Iterable[str]) -> str:
    """The vehicle file as people read it, with ``head`` on top and what each value is beside it."""
    inputs, constants = vehicle.inputs, vehicle.constants
    speed = inputs.set_point == "speed"
    first = "speed set-point (m/s)" if speed else "signed throttle (fraction)"
    lines = [
        *(f"# {line}" for line in head),
        f"name: {vehicle.name}",
        f"description: {vehicle.description}",
        "constants:",
        f"  m: {constants.m!r}  # kg, ready to drive",
        f"  m_std: {constants.m_std!r}  # kg",
        f"  l_f: {constants.l_f!r}  # m, centre of gravity to front axle: wheelbase times the rear axle's share of the mass",
        f"  l_r: {constants.l_r!r}  # m",
        f"  h_cg: {constants.h_cg!r}  # m, height of the centre of gravity",
        f"  F_z0: {constants.F_z0!r}  # N, half the weight: the load at which D and S_v hold",
        f"  load_transfer: {str(constants.load_transfer).lower()}",
        f"sampling_time: {vehicle.sampling_time!r}  # s",
        f"minimum_speed: {vehicle.minimum_speed!r}  # m/s; slower rows are not used",
        "inputs:",
        *(["  set_point: speed"] if speed else []),
        f"  throttle: [{inputs.throttle[0]!r}, {inputs.throttle[1]!r}]  # {first}",
        f"  steering: [{inputs.steering[0]!r}, {inputs.steering[1]!r}]  # rad at the road wheel",
        f"  steering_rate: {inputs.steering_rate!r}  # rad/s",
        "coefficients:  # nominal value, physical bounds, standard deviation of what is known",
    ]
    for name, each in vehicle.coefficients.items():
        words = (_OF_CONTROLLER if speed else {}).get(name) or _WORDS[_kind(name)]
        low, high = each.bounds
        value = f"{{nominal: {each.nominal:g}, bounds: [{low:g}, {high:g}], std: {each.std:g}}}"
        lines.append(f"  {name}: {value}  # {COEFFICIENT_UNITS[name]}, {words}")
    return "\n".join([*lines, "effects: []", ""])


def _commanded_otherwise(like: Vehicle) -> Vehicle:
    """The car with a throttle in place of a speed set-point, or the other way round: as strong, and as fast."""
    changed: dict[str, Any]
    if like.inputs.set_point == "speed":
        changed = {"set_point": "throttle", "throttle": (-1.0, 1.0)}
        value = like.coefficients["C_m1"].nominal / like.inputs.throttle[1]
    else:
        changed = {"set_point": "speed", "throttle": (0.0, _rounded(vehicle_limits(like).top_speed, 2))}
        value = like.constants.m / _REACHED_S
    coefficient = like.coefficients["C_m2"].model_copy(update={"nominal": value})
    return like.model_copy(
        update={
            "inputs": like.inputs.model_copy(update=changed),
            "coefficients": like.coefficients | {"C_m2": coefficient},
        }
    )


def _scaled(like: Vehicle, car: MeasuredCar, length: float, load: float) -> dict[str, float]:
    """Coefficients of the known car for another mass and size."""
    old = like.constants
    mass, axles = car.mass / old.m, car.l_f * (car.wheelbase - car.l_f) / (old.l_f * old.l_r)
    factors = {"D": load / old.F_z0, "S_v": load / old.F_z0, "C_r2": length**2, "I_z": mass * axles}
    factors |= dict.fromkeys(("C_m1", "C_m2", "C_r0"), mass)
    values = {key: like.coefficients[key].nominal * factors.get(_kind(key), 1.0) for key in COEFFICIENTS}
    values |= {key: 0.0 for key in COEFFICIENTS if _kind(key) in ("S_h", "S_v")}  # of that one car
    if car.acceleration is not None:
        forces = car.mass * car.acceleration / values["C_m1"]
        values["C_m1"] *= forces
        values["C_m2"] *= 1.0 if like.inputs.set_point == "speed" else forces
    return values


def _guessed(name: str, value: float, like: Vehicle, scale: float) -> dict[str, Any]:
    """Nominal value, bounds and standard deviation of a coefficient that is a guess."""
    kind = _kind(name)
    guess = _GUESSES[kind]
    std = max(guess.share * abs(value), guess.least * scale)
    if kind == "C_r0":
        low, high = 0.0, max(guess.high * scale, 4 * value)
    elif kind in ("C", "E", "S_h", "S_v"):
        low, high = min(guess.low * scale, value), max(guess.high * scale, value)
    elif kind == "C_r2" or (kind == "C_m2" and like.inputs.set_point == "throttle"):
        least = abs(like.coefficients[name].bounds[1]) / 100 if value <= 0 else value
        std, low, high = max(std, least / 2), 0.0, guess.high * least
    else:
        low, high = value / guess.low, value * guess.high
    return {"nominal": _rounded(value), "bounds": (_rounded(low, 3), _rounded(high, 3)), "std": _rounded(std, 2)}


def _kind(name: str) -> str:
    """The coefficient without its axle."""
    return name[:-1].rstrip("_") if name[-1] in "fr" else name


def _rounded(value: float, digits: int = 4) -> float:
    return float(f"{value:.{digits}g}")
