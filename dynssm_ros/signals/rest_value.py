"""What a brake sensor shows while nobody brakes: often not 0, and then the throttle would never count."""

from __future__ import annotations

import numpy as np

from dynssm_ros.arrays import Vector

_LOW = 0.1  # of the range, in which the rest value lies
_HIGHEST = 0.3  # of full brake, that a rest value may be
_MOST = 0.8  # of the samples there are at rest, the others on the way to it
_OF_NORMAL = 2.56  # width of the narrowest interval that holds so many of a normal distribution, in standard deviations
_NARROW = 0.3  # of the lowest tenth; a wider one is no rest value
_FEW = 50  # samples there, below which nothing is said
_MARGIN = 4.0  # standard deviations above the rest value that are no braking
_ROUNDING = 0.002  # of the rest value, likewise: scale and offset are written with four digits


def rest_value(brake: Vector) -> float:
    """The largest value (fraction of full brake) of a brake signal ``(N,)`` that still is no braking; 0 where 0 is right.

    It is the sensor's most frequent value among its lowest ones, plus its noise there. A sensor that shows 0, or less,
    at rest has none.
    """
    known = brake[np.isfinite(brake)]
    if len(known) < _FEW:
        return 0.0
    least, largest = np.quantile(known, [0.001, 1.0])
    width = _LOW * (largest - least)
    if width == 0:  # it never brakes
        return float(max(least * (1 + _ROUNDING), 0.0)) if least <= _HIGHEST else 0.0
    low = np.sort(known[known <= least + width])
    count = int(np.ceil(_MOST * len(low)))
    if len(low) < _FEW:
        return 0.0
    spans = low[count - 1 :] - low[: len(low) - count + 1]
    first = int(np.argmin(spans))
    inside = low[first : first + count]
    rest = float(np.median(inside))
    if spans[first] > _NARROW * width or rest > _HIGHEST:
        return 0.0
    limit = rest + max(_MARGIN * float(spans[first]) / _OF_NORMAL, _ROUNDING * rest)
    return limit if limit > 0 else 0.0
