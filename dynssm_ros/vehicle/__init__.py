"""The physics of a car: parameters with bounds, single-track equations, effects. No I/O beyond the vehicle file."""

from dynssm_ros.vehicle.car import CarModel
from dynssm_ros.vehicle.parameters import COEFFICIENT_UNITS, COEFFICIENTS, Vehicle, load_vehicle, save_vehicle
from dynssm_ros.vehicle.single_track import Applied, Coefficients, State

__all__ = [
    "COEFFICIENTS",
    "COEFFICIENT_UNITS",
    "Applied",
    "CarModel",
    "Coefficients",
    "State",
    "Vehicle",
    "load_vehicle",
    "save_vehicle",
]
