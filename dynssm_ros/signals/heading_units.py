"""Whether a signal map reads a table's columns in the units that their headings name."""

from __future__ import annotations

import re
from collections.abc import Mapping

from dynssm_ros.errors import BagError
from dynssm_ros.signals.columns import known_unit
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
    """Whether a heading names a unit that maps do not know."""
    return known_unit(written) is None and _COMPOSED.fullmatch(written) is not None


def unit_notes(table: LogTable, sources: Mapping[str, Source]) -> list[str]:
    """What the headings of mapped columns say of their units, and the map does not.

    A ``unit``, ``scale`` or ``curve`` in the map is taken at its word.

    Args:
        table: the log.
        sources: where signals are in it.

    Returns:
        Lines on units that maps do not know, that are of another quantity, and that the map says otherwise.

    Raises:
        BagError: a heading names a unit of the signal that is none of the SI, and the map says nothing.
    """
    notes = []
    for name, source in sources.items():
        if name not in QUANTITY_OF or source.column not in table.headings or source.curve is not None:
            continue
        expected, written = QUANTITY_OF[name], table.headings[source.column].unit
        unit, said = known_unit(written), {"unit", "scale"} & source.model_fields_set
        place = f"column '{source.column}' for {name}"
        read_in = "shares of 1" if expected == "1" else expected
        if unit in FITTING[expected]:
            if not said and UNITS[unit] != 1.0:
                raise BagError(
                    f"{table.path}: {place} is in {unit} by its heading, and the map reads it in {read_in}; expected "
                    f"`unit: '{unit}'`, or `unit: '{expected}'` if the heading is wrong"
                )
            if "scale" not in said and UNITS[source.unit] != UNITS[unit]:
                notes.append(f"{place}: its heading says {unit}, the map {source.unit}, which counts")
        elif not said and (is_unknown(written) or (unit in UNITS and len(written) > 1)):
            notes.append(f"{place}: its heading says {written}, and it is read in {read_in}; else give its scale")
    return notes
