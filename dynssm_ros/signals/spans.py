"""Drives cut into spans of equal length, and robust regressions over them with intervals.

Over a span noise averages out, and what a rate sums up to is compared with what it is the rate of. Intervals come from
blocks of neighbouring spans, since errors of neighbours are alike.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from dynssm_ros.arrays import Indices, Vector
from dynssm_ros.signals.recording import Recording
from dynssm_ros.signals.resampling import unwrapped

SIGMAS = 1.96
"""Standard deviations of a 95 % interval."""
BLOCKS = 24
"""Blocks of a drive whose scatter gives the intervals."""
_TUKEY = 4.685
"""Standard deviations at which a residual has no weight: 95 % efficient with normal errors (Tukey's biweight)."""
_ALIVE = 1e-3
"""Share of the spread of values that those with weight must have: else most are equal, as of a steering that rests."""
_ROUNDS = 20
_DRIVING = 0.3
"""Share of the 95th percentile of the speed, from which on a car counts as driving."""

_STANDS = 0.25
"""Mean square of the velocity over seconds, in that of rows, up to which a car stands; those that drive have 0.94 and more,
and noise at 10 Hz has 0.1."""

Complex = npt.NDArray[np.complex128]
Signal = Literal["velocity", "omega", "throttle", "steering", "position", "theta"]


@dataclass(frozen=True)
class Drive:
    """The signals that are compared, each ``(N,)``.

    Velocity in the car's frame and position in the map's are complex numbers, x the real part.
    """

    T_s: float
    segment: npt.NDArray[np.int32]
    velocity: Complex  # m/s
    omega: Vector  # rad/s
    throttle: Vector  # fraction, negative braking
    steering: Vector  # rad at the road wheel
    position: Complex | None = None  # m
    theta: Vector | None = None  # rad, unwrapped

    @classmethod
    def of(cls, recording: Recording) -> Drive:
        """The signals of a recording."""
        position = theta = None
        if recording.has_pose:
            position, theta = recording["x"] + 1j * recording["y"], unwrapped(recording["theta"])
        velocity = recording["v_x"] + 1j * recording["v_y"]
        return cls(
            recording.T_s, recording.segment, velocity, recording["omega"], recording["r_fb"], recording["delta_fb"],
            position, theta,
        )  # fmt: skip

    def __len__(self) -> int:
        return len(self.segment)

    @cached_property
    def speed(self) -> Vector:
        """Magnitude of the velocity (m/s)."""
        return np.asarray(np.abs(self.velocity))

    @cached_property
    def least_speed(self) -> float:
        """From which on the car counts as driving (m/s)."""
        return _DRIVING * float(np.percentile(self.speed, 95)) if len(self) else 0.0

    @property
    def stands(self) -> bool:
        """Whether the car stands throughout: over a second its velocity is noise that averages out."""
        slow, rows = self._velocities_of_seconds, max(1, round(1.0 / self.T_s))
        if not len(slow):
            return False
        fast = self._limited_velocity[: len(slow) * rows]
        return not float(np.mean(np.abs(slow) ** 2)) > _STANDS * float(np.mean(np.abs(fast) ** 2))

    @property
    def speed_but_glitches(self) -> float:
        """Speed (m/s) over whole seconds that 2 % of them exceed; infinite where there is no second."""
        slow = self._velocities_of_seconds
        return float(np.percentile(np.abs(slow), 98)) if len(slow) else math.inf

    @property
    def _velocities_of_seconds(self) -> Complex:
        """Mean velocity of each second, one after the other (m/s)."""
        rows = max(1, round(1.0 / self.T_s))
        found: Complex = self._limited_velocity[: len(self) // rows * rows].reshape(-1, rows).mean(axis=1)
        return found

    @cached_property
    def _limited_velocity(self) -> Complex:
        """The velocity, no faster than the speed that 2 % of the rows exceed: single wild values weigh nothing (m/s)."""
        limit = float(np.percentile(self.speed, 98)) if len(self) else 0.0
        found: Complex = self.velocity * (limit / np.maximum(self.speed, max(limit, 1e-300)))
        return found

    def changed(self, **signals: Any) -> Drive:
        """The drive with other signals."""
        return replace(self, **signals)

    def earlier(self, rows: int, *signals: Signal) -> Drive:
        """The drive with some signals moved to ``rows`` earlier; rows without a partner are left out."""
        if rows == 0:
            return self
        at = np.arange(len(self))
        partner = at + rows
        there = (partner >= 0) & (partner < len(self))
        there[there] = self.segment[at[there]] == self.segment[partner[there]]
        kept: dict[str, Any] = {"segment": self.segment[there]}
        for name in ("velocity", "omega", "throttle", "steering", "position", "theta"):
            values = getattr(self, name)
            if values is not None:
                kept[name] = values[partner[there] if name in signals else there]
        return replace(self, **kept)

    def spans(self, seconds: float, least_rows: int = 2) -> Spans:
        """Spans of about that length, one after the other, inside segments, in which the car drives throughout."""
        rows = max(least_rows, round(seconds / self.T_s))
        first = np.flatnonzero(np.diff(self.segment, prepend=-1))
        ends = np.append(first[1:], len(self)) - 1
        laid = [np.arange(a, b - rows + 1, rows, dtype=np.intp) for a, b in zip(first, ends, strict=True)]
        starts = np.concatenate([np.empty(0, np.intp), *laid])
        slow = np.concatenate([[0], np.cumsum(self.speed < self.least_speed)])
        starts = starts[slow[starts + rows + 1] == slow[starts]]
        return Spans(self, starts, starts + rows)


@dataclass(frozen=True)
class Spans:
    """Stretches of a drive by their first and last rows, ``(n,)``."""

    drive: Drive
    start: Indices
    end: Indices

    def __len__(self) -> int:
        return len(self.start)

    @property
    def seconds(self) -> float:
        """Length of each."""
        return float(self.end[0] - self.start[0]) * self.drive.T_s if len(self) else 0.0

    def integral(self, values: Any) -> Any:
        """Integral over each span, by trapezoids."""
        total = np.concatenate([[0], np.cumsum((values[1:] + values[:-1]) / 2 * self.drive.T_s)])
        return total[self.end] - total[self.start]

    def mean(self, values: Any) -> Any:
        """Mean over each span."""
        return self.integral(values) / self.seconds

    def change(self, values: Any) -> Any:
        """Last value less the first."""
        return values[self.end] - values[self.start]

    def where(self, which: npt.NDArray[np.bool_]) -> Spans:
        """Some of the spans."""
        return Spans(self.drive, self.start[which], self.end[which])

    @property
    def block(self) -> Indices:
        """Number of the block of neighbours that each belongs to."""
        return blocks(len(self))


def blocks(count: int) -> Indices:
    """Number of the block of neighbours that each of ``count`` rows, in the order of time, belongs to, ``(count,)``."""
    return np.arange(count) * BLOCKS // max(count, 1)


@dataclass(frozen=True)
class Fitted:
    """Coefficients of a regression with standard deviations, ``(k,)``; the explained share of the variance, of the
    mean square where no column is constant.
    """

    values: Vector
    std: Vector
    share: float

    def interval(self, number: int = 0) -> tuple[float, float]:
        """The 95 % interval of a coefficient."""
        half = SIGMAS * float(self.std[number])
        return float(self.values[number]) - half, float(self.values[number]) + half


def fitted(design: Vector, values: Vector, block: Indices) -> Fitted | None:
    """Robust regression of ``values`` ``(n,)`` on the columns of ``design`` ``(n, k)``.

    Iteratively reweighted least squares with Tukey's biweight; the covariance is the sandwich over blocks (Liang and
    Zeger 1986). ``None`` where too few rows or blocks determine it.
    """
    n, k = design.shape
    size = np.sqrt((design**2).mean(axis=0)) if n else np.zeros(k)
    if n < 4 * k or len(np.unique(block)) < max(4, k + 1) or not (size > 0).all():
        return None
    scaled, weight = design / size, np.ones(n)
    found, bread = np.zeros(k), np.asarray(np.eye(k))
    for _ in range(_ROUNDS):
        gram = scaled.T @ (weight[:, None] * scaled)
        if np.linalg.cond(gram) > 1e10:
            return None
        bread = np.asarray(np.linalg.inv(gram))
        before, found = found, bread @ (scaled.T @ (weight * values))
        residual = values - scaled @ found
        scale = 1.4826 * float(np.median(np.abs(residual)))
        if scale <= 1e-9 * float(np.abs(values).max()) or np.abs(found - before).max() < 1e-6 * np.abs(found).max():
            break
        weight = np.clip(1.0 - (residual / (_TUKEY * scale)) ** 2, 0.0, None) ** 2
    scores = np.zeros((int(block.max()) + 1, k))
    np.add.at(scores, block, scaled * (weight * residual)[:, None])
    blocks = len(np.unique(block))
    covariance = bread @ (scores.T @ scores) @ bread * blocks / (blocks - 1)
    centred = bool((np.ptp(design, axis=0) == 0).any())
    total = values - (np.average(values, weights=weight) if centred else 0.0)
    left = np.sqrt(np.average((values - np.average(values, weights=weight)) ** 2, weights=weight))
    if centred and left < _ALIVE * float(np.std(values)):
        return None
    share = 1.0 - float(weight @ residual**2) / max(float(weight @ total**2), 1e-300)
    return Fitted(found / size, np.sqrt(np.diag(covariance)) / size, share)


def varies(values: Vector) -> bool:
    """Whether a signal changes at all, beyond rounding, in more than a few rows."""
    return float(np.ptp(np.percentile(values, [2.0, 98.0]))) > 1e-9 * float(np.abs(values).max(initial=0.0))
