"""What a vehicle file can hold of a car: ranges between which cars from 1:43 models to lorries lie.

They are wide. What lies outside is a mistake of unit, sign or geometry.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

from dynssm_ros.vehicle.single_track import GRAVITY, SetPoint, VehicleConstants

_SPEED = 30.0  # up to which a throttle beyond 1 may be meant as m/s; per cent are larger
_SETTLING_S = 0.005, 20.0  # m / C_m2 of a speed controller


class PlausibleRange(NamedTuple):
    """Where the values of a field lie."""

    low: float
    high: float
    unit: str
    mistake: str = ""  # how values outside come about, as a question


def of_constants(car: VehicleConstants) -> Iterator[str]:
    """What is wrong with mass and geometry, in one line each: field, value, what was expected."""
    wheelbase = car.wheelbase
    for name in ("l_f", "l_r"):
        value = getattr(car, name)
        yield from _outside(f"constants.{name}", value, PlausibleRange(0.01, 6.0, "m", _length(value)))
    dense, light = 1500 * wheelbase**3, 3 * wheelbase**3
    mistake = "in g? " if car.m > dense else "in t? "
    yield from _outside(
        "constants.m", car.m, PlausibleRange(light, dense, f"kg at a wheelbase of {wheelbase:g} m", mistake)
    )
    share = PlausibleRange(0.1 * wheelbase, 0.9 * wheelbase, f"m at a wheelbase of {wheelbase:g} m")
    yield from _outside("constants.l_f", car.l_f, share)
    yield from _outside(
        "constants.h_cg", car.h_cg, PlausibleRange(0.0, wheelbase, "m, the wheelbase", _length(car.h_cg))
    )
    half = car.m * GRAVITY / 2
    load = PlausibleRange(0.6 * half, 1.4 * half, f"N, of an axle that carries about m g / 2 = {half:.4g} N")
    yield from _outside("constants.F_z0", car.F_z0, load)


def of_inputs(
    set_point: SetPoint, throttle: tuple[float, float], steering: tuple[float, float], rate: float
) -> Iterator[str]:
    """What is wrong with the limits of the actuators."""
    for value in throttle:
        mistake = "in %? " if abs(value) > _SPEED else "a speed (set_point: speed)? "
        fraction, speed = (
            PlausibleRange(-1.0, 1.0, "as a fraction", mistake),
            PlausibleRange(-120.0, 120.0, "m/s", "in km/h? "),
        )
        yield from _outside("inputs.throttle", value, speed if set_point == "speed" else fraction)
    if set_point == "speed" and not throttle[1] > 0:
        yield f"inputs.throttle: up to {throttle[1]:g} m/s; expected a speed set-point above 0"
    for value in steering:
        yield from _outside("inputs.steering", value, PlausibleRange(-1.57, 1.57, "rad", "in degrees? "))
    if steering[0] > 0 or steering[1] < 0:
        yield f"inputs.steering: [{steering[0]:g}, {steering[1]:g}]: expected 0, straight ahead, within it"
    yield from _outside("inputs.steering_rate", rate, PlausibleRange(0.01, 50.0, "rad/s", "in degrees/s? "))


def of_coefficients(
    car: VehicleConstants,
    nominal: Mapping[str, float],
    bounds: Mapping[str, tuple[float, float]],
    *,
    calibrated: bool,
    set_point: SetPoint,
) -> Iterator[str]:
    """What is wrong with the coefficients: values that are 0 or of the wrong sign, and those of no car.

    What a calibration found within bounds that can be is not judged.
    """
    for axle in "fr":
        for name in (f"B_{axle}", f"C_{axle}", f"D_{axle}"):
            yield from _not_positive(name, bounds[name])
    yield from _not_positive("I_z", bounds["I_z"])
    load, weight, inertia = car.F_z0, car.m * GRAVITY, car.m * car.l_f * car.l_r
    tyre = {
        "B": PlausibleRange(0.5, 100.0, "1/rad", "per degree? "),
        "C": PlausibleRange(0.1, 5.0, "without a unit"),
        "D": PlausibleRange(
            0.05 * load, 8.0 * load, f"N, 0.05 to 8 times F_z0 = {load:g} N", "a friction coefficient? "
        ),
        "S_h": PlausibleRange(-0.35, 0.35, "rad", "in degrees? "),
        "S_v": PlausibleRange(-load, load, "N, of F_z0"),
    }
    plausible = {f"{name}{'' if name[-1] in 'hv' else '_'}{axle}": each for name, each in tyre.items() for axle in "fr"}
    plausible |= {
        "C_m1": PlausibleRange(0.01 * weight, 20 * weight, "N, 0.01 to 20 times the weight", "in kN? "),
        "C_r0": PlausibleRange(-weight, weight, "N, the weight"),
        "I_z": PlausibleRange(
            inertia / 10, inertia * 10, f"kg m^2, within a factor of 10 of m l_f l_r = {inertia:.3g}"
        ),
    }
    if set_point == "speed":
        yield from _not_positive("C_m1", bounds["C_m1"])
        yield from _not_positive("C_m2", bounds["C_m2"])
        quick, slow = _SETTLING_S
        of_controller = f"N s/m, so that the speed settles within {quick:g} to {slow:g} s"
        plausible["C_m2"] = PlausibleRange(car.m / slow, car.m / quick, of_controller)
    for name, each in plausible.items():
        low, high = bounds[name]
        if not calibrated:
            yield from _outside(f"coefficients.{name}.nominal", nominal[name], each)
        for bound in (low,) if low > each.high else (high,) if high < each.low else ():
            yield from _outside(f"coefficients.{name}.bounds", bound, each)


def _not_positive(name: str, bounds: tuple[float, float]) -> Iterator[str]:
    if not bounds[0] > 0:
        yield f"coefficients.{name}.bounds: [{bounds[0]:g}, {bounds[1]:g}]: expected more than 0"


def _outside(field: str, value: float, plausible: PlausibleRange) -> Iterator[str]:
    low, high, unit, mistake = plausible
    if not low <= value <= high:
        yield f"{field}: {value:g}: {mistake}expected {low:.3g} to {high:.3g} {unit}"


def _length(value: float) -> str:
    return "in mm? " if value > 50 else "in cm? " if value > 6 else ""
