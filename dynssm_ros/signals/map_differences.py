"""In what the signal maps that are suggested for several logs of one car differ."""

from __future__ import annotations

from collections.abc import Iterator

from dynssm_ros.signals.signal_map import SignalMap, Source

_FACTOR = 1.5
"""Ratio of two factors up to which they are the same: a steering's follows from the curvature within that, a brake's from
how hard somebody brakes. Units and signs differ by more."""
_OFFSET = 0.1
"""Difference of two offsets up to which they are the same; rest values of brakes are below that."""


def differences(first: SignalMap, other: SignalMap) -> Iterator[tuple[str, str, str]]:
    """Signals that are other fields or other numbers: the name, and in words what ``other`` and ``first`` have."""
    for name, source in other.signals.items():
        there = first.signals.get(name)
        if there is None:
            continue
        if _place(source) != _place(there):
            yield name, _place(source), _place(there)
        elif not _alike(source, there):
            yield name, _words(source), _words(there)


def _place(source: Source) -> str:
    return source.column or f"{source.topic} {source.field}"


def _alike(one: Source, other: Source) -> bool:
    """Whether two sources of one field give nearly the same numbers."""
    ratio = one.factor / other.factor if other.factor else 0.0
    return 1.0 / _FACTOR < ratio < _FACTOR and abs(one.offset - other.offset) < _OFFSET


def _words(source: Source) -> str:
    unit = "" if source.unit == "1" else f"unit {source.unit}, "
    offset = f", offset {source.offset:.4g}" if source.offset else ""
    return f"{unit}scale {source.scale:.4g}{offset}"
