"""Whether a signal map reads columns and fields in the units that their names state, as ``Speed [km/h]`` or ``speed_kmh``."""

from __future__ import annotations

import re
from collections.abc import Mapping

from dynssm_ros.errors import BagError
from dynssm_ros.signals.bags import Bag
from dynssm_ros.signals.columns import heading, known_unit
from dynssm_ros.signals.signal_map import UNITS, Source
from dynssm_ros.signals.tables import LogTable

FITTING = {
    "m/s": ("m/s", "km/h", "mph", "kt", "ft/s"), "rad/s": ("rad/s", "deg/s"), "m": ("m", "cm", "mm", "km", "ft"),
    "rad": ("rad", "deg"), "1": ("1", "%"), "m/s^2": ("m/s^2", "g"),
}  # fmt: skip
"""Units of a quantity, by its unit of the SI."""
_QUANTITIES = {
    "m/s": ("v_x", "v_y", "v_east", "v_north", "speed_feedback", "speed_command", "wheel_speed"), "rad/s": ("omega",),
    "m": ("x", "y"), "rad": ("theta", "steering_feedback", "steering_command"), "m/s^2": ("a_x", "a_y"),
    "1": ("throttle_feedback", "throttle_command", "brake_feedback", "brake_command"),
}  # fmt: skip
QUANTITY_OF = {name: quantity for quantity, names in _QUANTITIES.items() for name in names}
"""The unit of the SI that a signal is in."""
_COMPOSED = re.compile(r"[a-zµ°]{1,4}/[a-z]{1,3}(?:\^?[2²])?")
"""A text that can only be a unit: ``dm/s``, ``mm/s^2``."""


def is_unknown(written: str) -> bool:
    """Whether a name states a unit that maps do not know."""
    return known_unit(written) is None and _COMPOSED.fullmatch(written) is not None


def unit_of_field(topic: str, path: str) -> str:
    """The unit that the name of a field states, or that of its topic where it is but ``data``; empty if none does."""
    leaf = path.rpartition(".")[2]
    written = heading(topic.rpartition("/")[2] if leaf in ("data", "value") else leaf).unit
    return written if len(written) > 1 else ""  # delta_m is the measured one


def unit_notes(log: Bag | LogTable, sources: Mapping[str, Source]) -> list[str]:
    """What the names of mapped columns and fields state of their units, and the map does not.

    A ``unit``, ``scale`` or ``curve`` in the map is taken at its word.

    Args:
        log: a bag or a table.
        sources: where signals are in it.

    Returns:
        Lines on units that maps do not know, that are of another quantity, and that the map says otherwise.

    Raises:
        BagError: a name states a unit of the signal that is none of the SI, and the map says nothing.
    """
    notes = []
    for name, source in sources.items():
        if name not in QUANTITY_OF or source.curve is not None:
            continue
        if isinstance(log, LogTable):
            written = log.headings[source.column].unit if source.column in log.headings else ""
            place = f"column '{source.column}' for {name}"
        else:
            written, place = unit_of_field(source.topic, source.field), f"{source.recorded} {source.field} for {name}"
        expected, unit = QUANTITY_OF[name], known_unit(written)
        said, read_in = {"unit", "scale"} & source.model_fields_set, "shares of 1" if expected == "1" else expected
        if unit in FITTING[expected]:
            if not said and UNITS[unit] != 1.0:
                raise BagError(
                    f"{log.path}: {place} is in {unit} by its name, and the map reads it in {read_in}; expected "
                    f"`unit: '{unit}'`, or `unit: '{expected}'` if the name is wrong"
                )
            if "scale" not in said and UNITS[source.unit] != UNITS[unit]:
                notes.append(f"{place}: its name says {unit}, the map {source.unit}, which counts")
        elif not said and (is_unknown(written) or (unit in UNITS and len(written) > 1)):
            notes.append(f"{place}: its name says {written}, and it is read in {read_in}; else give its scale")
    return notes
