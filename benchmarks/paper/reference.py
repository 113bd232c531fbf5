"""The paper's own numbers (``benchmarks/paper/reference.yaml``), to be set beside what is measured."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dynssm_ros import configuration

_DATA = {"sim": "small car", "real": "full-size car"}


def load_reference() -> dict[str, Any]:
    """The paper's tables as they stand in the file, in SI units; data sets are ``real`` and ``sim``."""
    return configuration.read_yaml(Path(__file__).with_name("reference.yaml"))


def suspects(reference: Mapping[str, Any]) -> list[str]:
    """Figures of the open-loop table that contradict others of the same row, in words.

    A root mean square is never above the largest value. A path that drifts away is farthest from the measured one at its end,
    so that its FDE is above its ADE; less is possible only where the path comes back.
    """
    found = []
    for data, models in reference["open_loop"].items():
        for model, row in models.items():
            where = f"{model}, {_DATA[data]}"
            for channel, rmse in row["rmse"].items():
                if rmse > row["max_error"][channel]:
                    found.append(
                        f"{where}: the RMSE of {channel}, {rmse:g}, is above its maximum, {row['max_error'][channel]:g}"
                    )
            if row["fde"] < row["ade"]:
                found.append(f"{where}: the FDE, {row['fde']:g} m, is below the ADE, {row['ade']:g} m")
    return found
