"""What a steering signal is to be scaled with: it is compared with the curvature that is driven, so that degrees,
steering-wheel angles and swapped signs are seen.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.signals.actuation import LARGE_RAD, OFFSET_RAD, SCALES, UNDERSTEER, believable, understeer
from dynssm_ros.signals.contents import TopicContent, spread
from dynssm_ros.signals.signal_map import UNITS
from dynssm_ros.signals.spans import blocks

STRANGE = (TOO_FAST := "too fast for m/s: find its unit", TOO_LARGE := "large for rad: deg?")
"""Notes of velocities whose unit must be wrong."""
_AGREES = 0.5  # correlation with the curvature, from which on a scale is told
_DEGREES = (0.67, 1.5)  # share of what degrees need, within which a steering is taken for them
_DRIVING = 0.3  # of the largest speed, from which on curvature is compared


@dataclass(frozen=True)
class Suggestion:
    """Where a signal may come from."""

    topic: TopicContent
    field: str
    scale: float = 1.0
    note: str = ""
    unit: str = "1"
    offset: float = 0.0

    @property
    def values(self) -> Vector:
        """The signal at the topic's samples, shape ``(N,)``."""
        return self.scale * UNITS[self.unit] * self.topic.values[self.field] + self.offset


class _Driven(NamedTuple):
    """How a car bends with a steering signal; each value, its least and its largest."""

    slope: tuple[float, float, float]  # change of the curvature in a slow car (1/m per unit)
    straight: tuple[float, float, float]  # signal at which it goes straight; 0 where that is not known


def scaled_steering(suggestion: Suggestion, signals: dict[str, Suggestion], wheelbase: float | None) -> Suggestion:
    """The steering in rad at the road wheel, 0 straight ahead, as far as the curvature that it drives tells."""
    suggestion = replace(suggestion, scale=1.0)
    if strange := [f"{name} ({signals[name].note})" for name in ("v_x", "omega") if _is_strange(signals.get(name))]:
        return replace(suggestion, note=f"its scale is not known before {', '.join(strange)} is right")
    seen, values = _driven(suggestion, signals), suggestion.values
    if seen is None:
        large = float(np.nanmax(np.abs(values), initial=0.0)) > LARGE_RAD
        note = "too large for rad at the road wheel: find its scale" if large else suggestion.note
        return replace(suggestion, note=note)
    told = f"the curvature follows it with {seen.slope[0]:.4g} 1/m per unit, understeer taken off"
    if wheelbase is None:
        return replace(suggestion, note=f"{told}: the scale is about that times the wheelbase")
    return _straightened(_scaled(suggestion, told, *(each * wheelbase for each in seen.slope)), suggestion, seen)


def _is_strange(suggestion: Suggestion | None) -> bool:
    """Whether a velocity is none in its unit, so that no curvature follows from it."""
    return suggestion is not None and suggestion.note in STRANGE


def _scaled(suggestion: Suggestion, told: str, scale: float, low: float, high: float) -> Suggestion:
    """In rad: as it is where that is possible, else in degrees, else by the ``scale`` of which an interval is known."""
    sign, least, most = (1.0, low, high) if scale > 0 else (-1.0, -high, -low)
    other = replace(suggestion, scale=sign, note=told)
    if sign < 0:
        other = replace(
            other, note=f"{told}: turned, unless omega, v_y, y and theta count to the right: scale: -1 of those"
        )
    if least < SCALES[1] and most > SCALES[0]:
        return other if sign < 0 else suggestion
    degree = UNITS["deg"]
    if suggestion.unit == "1" and least < _DEGREES[1] * degree and most > _DEGREES[0] * degree:
        return replace(other, unit="deg")
    return replace(other, scale=scale, note=f"{other.note}; measure the scale at the wheel")


def _straightened(scaled: Suggestion, suggestion: Suggestion, seen: _Driven) -> Suggestion:
    """With an offset where the car goes straight at another angle than 0, as by the position of a servo."""
    factor = scaled.scale * UNITS[scaled.unit] / UNITS[suggestion.unit]
    angle, low, high = (factor * each for each in seen.straight)
    if min(low, high) < OFFSET_RAD and max(low, high) > -OFFSET_RAD:
        return scaled
    note = f"the car goes straight at {angle:.3g} rad of it: offset"
    return replace(scaled, offset=-angle, note=f"{scaled.note}; {note}" if scaled.note else note)


def _driven(suggestion: Suggestion, signals: dict[str, Suggestion]) -> _Driven | None:
    """How ``omega / v_x`` goes with the signal.

    Understeer is fitted with it where speeds differ enough, else it is what cars have. ``None`` where the two do not go
    together.
    """
    if "v_x" not in signals or "omega" not in signals:
        return None
    at = suggestion.topic.time
    values = suggestion.values
    v_x, omega = (np.interp(at, signals[name].topic.time, signals[name].values) for name in ("v_x", "omega"))
    fast = (v_x > _DRIVING * v_x.max(initial=0.0)) & np.isfinite(values) & (v_x > 0)
    if fast.sum() < 3 or spread(values[fast]) == 0 or spread(omega[fast]) == 0:
        return None
    curvature = omega[fast] / v_x[fast]
    if abs(np.corrcoef(values[fast], curvature)[0, 1]) < _AGREES:
        return None
    slope = float(np.polyfit(values[fast], curvature, 1)[0])
    sign, speed = float(np.sign(slope)), v_x[fast]
    fit = understeer(sign * values[fast], curvature, speed, block=blocks(len(speed)))
    if fit is not None and fit.share > _AGREES:
        right, left = np.percentile(curvature, [10.0, 90.0])
        straight = (fit.values[0], *fit.interval(0)) if right < 0.0 < left else (0.0,) * 3
        low, high = believable(fit, float(np.mean(speed**2)))
        if 0 < low <= high:
            slopes = (1.0 / float(fit.values[1]), 1.0 / high, 1.0 / low)
            return _Driven(*(_turned(sign, *each) for each in (slopes, straight)))
    return _Driven(_turned(1.0, slope, *(slope * (1.0 + share) for share in UNDERSTEER)), (0.0,) * 3)


def _turned(sign: float, value: float, one: float, other: float) -> tuple[float, float, float]:
    """With another sign, the least of both ends first."""
    low, high = sorted((sign * one, sign * other))
    return sign * float(value), float(low), float(high)
