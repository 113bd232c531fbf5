"""The physics of a car: parameters with bounds, single-track equations, effects. No I/O beyond the vehicle file."""

from dynssm_ros.vehicle.parameters import COEFFICIENT_UNITS, COEFFICIENTS, Vehicle, load_vehicle, save_vehicle
from dynssm_ros.vehicle.single_track import Applied, Coefficients, State, motion, step, step_with_effect_states

__all__ = [
    "COEFFICIENTS",
    "COEFFICIENT_UNITS",
    "Applied",
    "Coefficients",
    "State",
    "Vehicle",
    "load_vehicle",
    "motion",
    "save_vehicle",
    "step",
    "step_with_effect_states",
]
