"""A calibrated car for other programs."""

from __future__ import annotations

from dataclasses import dataclass

from dynssm_ros.api.inputs import PathLike, vehicle_of
from dynssm_ros.api.settings import VerbSettings, keywords, setting
from dynssm_ros.control.exports import FORMATS, Format
from dynssm_ros.extras import require
from dynssm_ros.files import replacing
from dynssm_ros.vehicle import Vehicle


class ExportSettings(VerbSettings):
    """Settings of :func:`export`."""

    format: Format = setting(
        "c",
        "c: source of a step, for C and C++; acados: its model in Python; f1tenth_gym, commonroad: parameter files with "
        "linear tyres; steering_table: steering over lateral acceleration and speed, as ForzaETH's controller reads it.",
    )


@dataclass(frozen=True)
class Export:
    """Files of a car for another program."""

    files: dict[str, str]
    """Their contents by name."""

    def save(self, folder: PathLike) -> None:
        """Writes them to a folder of their own.

        Raises:
            UserError: there is something else.
        """
        with replacing(folder) as aside:
            aside.mkdir()
            for name, text in self.files.items():
                (aside / name).write_text(text, encoding="utf-8")


@keywords(ExportSettings)
def export(vehicle: Vehicle | PathLike, *, settings: ExportSettings) -> Export:
    """Writes a car down for another program: its equations as code, or its numbers in another one's file.

    Args:
        vehicle: name, file or object.
        settings: all keywords as one object.

    Raises:
        ConfigurationError: an effect of the car depends on place or time, which code does not know.

    Example:
        >>> sorted(export("orca", format="c").files)
        ['orca.c', 'orca.h', 'orca_car.h', 'orca_example.cpp']
    """
    require("export", "race")
    return Export(FORMATS[settings.format](vehicle_of(vehicle)))
