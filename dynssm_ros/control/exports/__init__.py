"""A calibrated car for others: C code, a solver's model, parameter files of simulators, a table for a steering controller.

Each gives the content of files by their names. What a format cannot hold is said in its file.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Literal

from dynssm_ros.control.exports.code import acados_files, c_files
from dynssm_ros.control.exports.parameters import commonroad_files, f1tenth_gym_files
from dynssm_ros.control.exports.steering_table import steering_table_files
from dynssm_ros.vehicle import Vehicle

Format = Literal["c", "acados", "f1tenth_gym", "commonroad", "steering_table"]
FORMATS: Mapping[Format, Callable[[Vehicle], dict[str, str]]] = {
    "c": c_files,
    "acados": acados_files,
    "f1tenth_gym": f1tenth_gym_files,
    "commonroad": commonroad_files,
    "steering_table": steering_table_files,
}
"""Names and contents of the files of a car, by format."""
