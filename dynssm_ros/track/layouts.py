"""Tracks of our own, laid out from straights and eased corners.

A corner's curvature rises and falls as a raised cosine, so curvature and its slope are continuous. Two straights of
each layout are left open and take the lengths that close the loop: with all headings known, that is a linear system.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from dynssm_ros.arrays import Vector

FOOT = 0.3048  # m
MILE = 5280 * FOOT


class Straight(NamedTuple):
    """A straight of ``length`` metres; ``None``: as long as the closing of the loop asks."""

    length: float | None


class Corner(NamedTuple):
    """A corner that turns by ``angle`` (degrees, positive left) with least radius ``radius`` (m).

    ``easing`` is the share of its length over which the curvature rises, and falls again; at most 0.5.
    """

    angle: float
    radius: float
    easing: float = 0.3

    @property
    def length(self) -> float:
        """Arc length (m)."""
        return math.radians(abs(self.angle)) * self.radius / (1 - self.easing)

    def turned(self, share: Vector) -> Vector:
        """Heading change (rad) up to ``share`` of the length."""
        half = self._area(np.minimum(share, 0.5))
        area = np.where(share <= 0.5, half, 1 - self.easing - self._area(np.minimum(1 - share, 0.5)))
        return math.radians(self.angle) * area / (1 - self.easing)

    def _area(self, share: Vector) -> Vector:
        """Integral of the curvature, relative to its largest value, over the first half."""
        rise = (share - self.easing / math.pi * np.sin(math.pi * share / self.easing)) / 2
        return np.where(share < self.easing, rise, share - self.easing / 2)


Segment = Straight | Corner


class Layout(NamedTuple):
    """A built-in track: its segments in driving order, total width (m) and distance of points (m)."""

    segments: tuple[Segment, ...]
    width: float
    spacing: float


def closed_loop(segments: Sequence[Segment], spacing: float) -> Vector:
    """Lays the segments out from the origin along x; points (m), shape ``(N, 2)``, about ``spacing`` metres apart.

    Raises:
        ValueError: the corners do not add up to one turn, not exactly two straights are open, they are parallel, or
            closing needs a straight of no length.
    """
    turns = [segment.angle if isinstance(segment, Corner) else 0.0 for segment in segments]
    if not math.isclose(abs(sum(turns)), 360.0):
        raise ValueError(f"the corners add up to {sum(turns):g} degrees; expected 360 or -360")
    headings = np.exp(1j * np.radians(np.concatenate([[0.0], np.cumsum(turns)[:-1]])))
    traces = [_trace(segment, spacing) for segment in segments]
    free = [k for k, segment in enumerate(segments) if isinstance(segment, Straight) and segment.length is None]
    if len(free) != 2:
        raise ValueError(f"{len(free)} straights have no length; expected two, which close the loop")
    gap = -sum(heading * trace[-1] for heading, trace in zip(headings, traces, strict=True))
    directions = headings[free]
    matrix = np.array([directions.real, directions.imag])
    if abs(np.linalg.det(matrix)) < 1e-6:
        raise ValueError("the two open straights are parallel")
    for k, length in zip(free, np.linalg.solve(matrix, [gap.real, gap.imag]), strict=True):
        if length < spacing:
            raise ValueError(f"closing the loop needs a straight of {length:g} m at segment {k}")
        traces[k] = _trace(Straight(float(length)), spacing)
    points, start = [], 0j
    for heading, trace in zip(headings, traces, strict=True):
        points.append(start + heading * trace[:-1])
        start += heading * trace[-1]
    joined = np.concatenate(points)
    return np.stack([joined.real, joined.imag], axis=1)


def _trace(segment: Segment, spacing: float) -> npt.NDArray[np.complex128]:
    """Points of a segment that starts at 0 along the real axis, its end included."""
    length = segment.length or 0.0
    count = max(1, round(length / spacing))
    ends = np.linspace(0.0, 1.0, count + 1)
    if isinstance(segment, Straight):
        return (ends * length).astype(np.complex128)
    nodes, weights = np.polynomial.legendre.leggauss(6)
    inside = ends[:-1, None] + (nodes + 1) / (2 * count)
    pieces = np.exp(1j * segment.turned(inside)) @ weights * (length / (2 * count))
    return np.concatenate([[0j], np.cumsum(pieces)]).astype(np.complex128)


def oval() -> Layout:
    """The public dimensions of the Indianapolis oval: 2.5 miles, four quarter-mile turns, flat, counter-clockwise.

    The easing of the turns takes its extra length from the straights, so that the lap stays 2.5 miles.
    """
    turn = Corner(90.0, radius=MILE / 4 / (math.pi / 2), easing=0.15)
    eased = turn.length - MILE / 4
    front, chute = 5 / 8 * MILE - eased, 1 / 8 * MILE - eased
    segments = (Straight(front / 2), turn, Straight(None), turn, Straight(front), turn, Straight(chute), turn)
    return Layout((*segments, Straight(None)), width=15.2, spacing=5.0)


def road_course() -> Layout:
    """A full-size road course of 3.3 km, clockwise: two fast straights, a hairpin, an esse, radii from 40 to 90 m."""
    first = (Straight(250), Corner(-100, 45), Straight(80), Corner(60, 80, 0.4), Straight(60), Corner(-120, 55, 0.4))
    infield = (Straight(200), Corner(70, 48), Straight(70), Corner(-110, 40), Straight(380), Corner(80, 60))
    hairpin = (Straight(60), Corner(-150, 48), Straight(None))
    last = (Corner(40, 90, 0.5), Corner(-40, 90, 0.5), Straight(80), Corner(-90, 90, 0.45), Straight(None))
    return Layout((*first, *infield, *hairpin, *last), width=12.0, spacing=4.0)


def club() -> Layout:
    """A track of 11.7 m for the 1:43 car, counter-clockwise."""
    first = (Straight(0.6), Corner(90, 0.35), Straight(0.8), Corner(90, 0.40), Straight(0.6), Corner(-90, 0.30))
    second = (Straight(0.7), Corner(90, 0.32), Straight(0.7), Corner(90, 0.45), Straight(None))
    esse = (Corner(60, 0.5, 0.5), Corner(-60, 0.5, 0.5), Straight(0.3), Corner(90, 0.38), Straight(None))
    return Layout((*first, *second, *esse), width=0.4, spacing=0.03)


def club_b() -> Layout:
    """Another track for the 1:43 car, 14.7 m, clockwise: what is learned on ``club`` can be tested here."""
    first = (
        Straight(0.9),
        Corner(-100, 0.32),
        Straight(0.2),
        Corner(75, 0.45, 0.45),
        Straight(0.2),
        Corner(-125, 0.38),
    )
    second = (Straight(0.4), Corner(60, 0.5, 0.5), Straight(0.3), Corner(-90, 0.34), Straight(None), Corner(-130, 0.30))
    last = (Straight(0.3), Corner(40, 0.7, 0.5), Straight(None), Corner(-90, 0.45), Straight(0.6))
    return Layout((*first, *second, *last), width=0.4, spacing=0.03)


LAYOUTS: dict[str, Callable[[], Layout]] = {f.__name__: f for f in (oval, road_course, club, club_b)}
