"""Inspection: what is in a race log. It has no settings."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dynssm_ros.api.inputs import PathLike, vehicle_of
from dynssm_ros.progress import Progress
from dynssm_ros.vehicle import Vehicle

if TYPE_CHECKING:
    from dynssm_ros.signals.inspection import Inspection


def inspect(
    bag: PathLike, vehicle: Vehicle | PathLike | None = None, *, on_progress: Progress | None = None
) -> Inspection:
    """Says what is in a race log: topics or columns, rates, gaps, clocks, and a first signal map.

    Args:
        bag: rosbag2 folder or file, ROS 1 bag, or table (CSV, Parquet, MATLAB, NumPy).
        vehicle: with whose wheelbase the scale of the steering follows from the curvature that is driven.
        on_progress: called with messages read.

    Example:
        >>> found = inspect("laps_bag", "orca")  # doctest: +SKIP
        >>> print(found.signal_map())  # doctest: +SKIP
    """
    from dynssm_ros.signals.inspection import inspect

    return inspect(bag, None if vehicle is None else vehicle_of(vehicle).constants.wheelbase, on_progress)
