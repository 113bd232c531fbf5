"""A calibration as a table for the terminal, and for programs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rich.table import Table

from dynssm_ros.evaluation.metrics import by_channel
from dynssm_ros.vehicle import COEFFICIENT_UNITS, COEFFICIENTS

if TYPE_CHECKING:
    from dynssm_ros.identification.result.calibration import Calibration


def calibration_table(result: Calibration) -> Table:
    """Nominal values with standard deviations and bounds."""
    table = Table("coefficient", "value", "std", "bounds", "unit")
    for k, name in enumerate(COEFFICIENTS):
        lower, upper = result.vehicle.coefficients[name].bounds
        mark = " *" if name in result.on_bound else ""
        table.add_row(
            name + mark,
            f"{result.theta[k]:.4g}",
            f"{result.std[k]:.1g}",
            f"{lower:g} .. {upper:g}",
            COEFFICIENT_UNITS[name],
        )
    return table


def calibration_json(result: Calibration) -> dict[str, Any]:
    """The calibration for programs."""
    return {
        "coefficients": {
            name: {"value": float(result.theta[k]), "std": float(result.std[k]), "unit": COEFFICIENT_UNITS[name]}
            for k, name in enumerate(COEFFICIENTS)
        },
        "on_bound": list(result.on_bound),
        "unidentified": list(result.unidentified),
        "rmse_before": by_channel(result.rmse_before),
        "rmse_after": by_channel(result.rmse_after),
        "rmse_ahead": by_channel(result.rmse_ahead),
        "persistence": by_channel(result.persistence),
        "rows": result.rows,
        "horizon_s": result.horizon,
    }
