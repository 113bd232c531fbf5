"""Velocities by the motion filter: of a log with both sides of each instant, live with what came before.

Both feed the same :class:`~dynssm_ros.signals.motion_filter.MotionFilter` with samples in the order of their stamps. Live
a sample may come after younger ones: the filter goes back to the moment before it and on again from there.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Iterator, Mapping
from itertools import islice
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from dynssm_ros.arrays import Vector
from dynssm_ros.errors import RecordingError
from dynssm_ros.signals.motion_filter import (
    GYRO_BIAS,
    THETA,
    V_X,
    V_Y,
    Estimation,
    Moment,
    MotionFilter,
    X,
    Y,
    smoothed,
)
from dynssm_ros.signals.resampling import Stream
from dynssm_ros.signals.signal_map import POSE_SIGNALS, SENSORS, STATE_SIGNALS, SignalMap

Stamps = npt.NDArray[np.int64]
Samples = tuple[int, dict[str, float]]
"""Stamp (ns) and values by signal of one instant."""

MEASURED = ("v_x", "omega", *SENSORS, *POSE_SIGNALS)
"""Signals that the filter takes."""
_BLOCK, _AHEAD = 30_000, 10_000  # moments that are smoothed at once, of 3 kB, and that they look ahead: 20 s or more
_KEPT_NS = 1_000_000_000  # how late a sample may come
_AXIS, _FLATTENING = 6_378_137.0, 1 / 298.257223563  # m, 1; WGS 84
_MEDIAN_OF_NORMAL = 0.6745  # of absolute values, in standard deviations
_NOISIER = 2.0  # times the noise that a map states, from which on it is told


class Plane:
    """The plane that touches the earth at ``origin``, latitude and longitude (deg): x east, y north (m).

    Within 10 km it is right to 1 cm for positions relative to each other on a race track. Radii of curvature are those of
    WGS 84.
    """

    def __init__(self, origin: tuple[float, float]) -> None:
        self.origin = origin
        square = _FLATTENING * (2 - _FLATTENING)
        root = 1 - square * math.sin(math.radians(origin[0])) ** 2
        self._north = _AXIS * (1 - square) / root**1.5
        self._east = _AXIS / math.sqrt(root) * math.cos(math.radians(origin[0]))

    def at(self, latitude: float, longitude: float) -> tuple[float, float]:
        """``x, y`` (m) of a fix (deg)."""
        turned = (longitude - self.origin[1] + 180.0) % 360.0 - 180.0
        return self._east * math.radians(turned), self._north * math.radians(latitude - self.origin[0])


class Estimated(NamedTuple):
    """What was estimated at the stamps of ``omega``."""

    stamps: Stamps  # (N,)
    states: Vector  # v_x, v_y, omega, (N, 3)
    deviations: Vector  # their standard deviations, (N, 3)
    poses: Vector  # x, y, theta, (N, 3); NaN before it is known, and where nothing measures it
    origin: tuple[float, float] | None  # where x and y are 0 (deg), of a log with fixes


def estimated(
    streams: Mapping[str, tuple[Stamps, Vector]],
    settings: Estimation,
    max_gap: int,
    *,
    where: str = "",
    both_sides: bool = True,
) -> Estimated:
    """Velocities of a log.

    Args:
        streams: stamps (ns) and values of each signal, ``(N,)`` both.
        settings: of the filter.
        max_gap: between samples of ``omega``, after which it begins anew (ns).
        where: the log, for errors.
        both_sides: whether samples after an instant count too; live they do not.

    Raises:
        RecordingError: no stretch of ``omega`` in which ``v_x`` is known.
    """
    used = {name: streams[name] for name in MEASURED if name in streams}
    motion = MotionFilter(settings, tuple(used))
    plane = _plane(used, settings)
    found: list[tuple[Stamps, Vector, Vector]] = []
    for stretch in _stretches(_merged(used), max_gap):
        for block in _blocks(_forward(motion, stretch, plane), both_sides):
            at = [k for k, one in enumerate(block.moments) if one.is_ready and one.has_turn]
            if at:
                found.append(_columns(block, at))
    if not found:
        raise RecordingError(f"{where}: no velocities: omega and v_x are nowhere known together")
    stamps, columns, variances = (np.concatenate(parts) for parts in zip(*found, strict=True))
    noise = settings.gyro_noise**2 / np.median(np.diff(stamps)) * 1e9 if len(stamps) > 1 else 0.0
    known = np.stack([variances[:, V_X], variances[:, V_Y], variances[:, GYRO_BIAS] + noise], axis=1)
    return Estimated(stamps, columns[:, :3], np.sqrt(known), columns[:, 3:], plane.origin if plane else None)


class _Block(NamedTuple):
    """Moments in a row with states ``(N, 9)`` and covariances ``(N, 9, 9)``."""

    moments: list[Moment]
    x: Vector
    P: Vector


def _blocks(moments: Iterator[Moment], both_sides: bool) -> Iterator[_Block]:
    """The moments so many at a time, each smoothed by itself and at least so many that follow, which bounds memory."""
    held: list[Moment] = []
    more = True
    while more:
        new = list(islice(moments, _BLOCK + _AHEAD - len(held)))
        held += new
        more = len(held) == _BLOCK + _AHEAD
        count = _BLOCK if more else len(held)
        if not count:
            return
        if both_sides:
            x, P = smoothed(held)
        else:
            x, P = np.stack([one.x for one in held]), np.stack([one.P for one in held])
        yield _Block(held[:count], x[:count], P[:count])
        held = held[count:]


def _columns(block: _Block, at: list[int]) -> tuple[Stamps, Vector, Vector]:
    """Stamps, velocities and poses ``(M, 6)``, and variances ``(M, 9)`` of some moments of a block."""
    moments, x = [block.moments[k] for k in at], block.x[at]
    turns = np.array([one.inputs[2] for one in moments])
    has_pose = np.array([one.has_pose for one in moments])
    states = np.stack([x[:, V_X], x[:, V_Y], turns - x[:, GYRO_BIAS]], axis=1)
    poses = np.where(has_pose[:, None], x[:, [X, Y, THETA]], np.nan)
    stamps = np.array([one.stamp for one in moments])
    return stamps, np.hstack([states, poses]), np.diagonal(block.P, axis1=1, axis2=2)[at]


def require_degrees(streams: Mapping[str, Stream], where: str) -> None:
    """Checks that fixes are places on earth.

    Raises:
        RecordingError: they are not; receivers write degrees and minutes in one number.
    """
    for name, most in (("latitude", 90.0), ("longitude", 360.0)):
        largest = float(np.abs(streams[name].values).max(initial=0.0)) if name in streams else 0.0
        if largest > most:
            raise RecordingError(
                f"{where}: {name} is up to {largest:.7g}; expected at most {most:g} degrees (is it the other one? "
                "Of NMEA's degrees and minutes, 4807.038, first make 48 + 7.038 / 60)"
            )


def _plane(streams: Mapping[str, tuple[Stamps, Vector]], settings: Estimation) -> Plane | None:
    """Of the fixes, by their first one; ``None`` where there are none."""
    if "latitude" not in streams or "longitude" not in streams:
        return None
    if settings.origin is not None:
        return Plane(settings.origin)
    (stamps, latitude), (others, longitude) = streams["latitude"], streams["longitude"]
    _, first, second = np.intersect1d(stamps, others, return_indices=True)
    return Plane((float(latitude[first[0]]), float(longitude[second[0]]))) if len(first) else None


def _merged(streams: Mapping[str, tuple[Stamps, Vector]]) -> list[Samples]:
    """All samples in the order of their stamps."""
    merged: dict[int, dict[str, float]] = {}
    for name, (stamps, values) in streams.items():
        for stamp, value in zip(stamps.tolist(), values.tolist(), strict=True):
            merged.setdefault(stamp, {})[name] = value
    return sorted(merged.items())


def _stretches(samples: list[Samples], max_gap: int) -> Iterator[list[Samples]]:
    """Runs of samples in which ``omega`` comes at least every ``max_gap`` ns; each begins and ends with it."""
    run: list[Samples] = []
    last, length = -math.inf, 0
    for stamp, values in samples:
        if "omega" in values:
            if stamp - last > max_gap:
                if length:
                    yield run[:length]
                run = []
            last = stamp
        elif not run:
            continue
        run.append((stamp, values))
        length = len(run) if "omega" in values else length
    if length:
        yield run[:length]


def _forward(motion: MotionFilter, samples: list[Samples], plane: Plane | None) -> Iterator[Moment]:
    """The moments of a stretch, one for each of its stamps."""
    moment: Moment | None = None
    for stamp, values in samples:
        moment = advanced(motion, moment, stamp, located(values, plane))
        yield moment


def advanced(motion: MotionFilter, last: Moment | None, stamp: int, values: Mapping[str, float]) -> Moment:
    """The moment at ``stamp`` (ns) after ``last``, or the first."""
    return motion.begin(stamp, values) if last is None else motion.step(last, stamp, values)


def located(values: Mapping[str, float], plane: Plane | None) -> Mapping[str, float]:
    """The samples with ``x`` and ``y`` (m) of a fix."""
    if plane is None or "latitude" not in values or "longitude" not in values:
        return values
    x, y = plane.at(values["latitude"], values["longitude"])
    return {**values, "x": x, "y": y}


def positions_of(streams: Mapping[str, tuple[Stamps, Vector]]) -> tuple[Stamps, Vector, Vector] | None:
    """Stamps, x and y (m) of the positions or fixes of a log, each ``(N,)``; ``None`` where there are none."""
    plane = _plane(streams, Estimation())
    names = ("x", "y") if plane is None else ("latitude", "longitude")
    if not set(names) <= set(streams):
        return None
    (stamps, first), (others, second) = streams[names[0]], streams[names[1]]
    both, k, n = np.intersect1d(stamps, others, return_indices=True)
    pairs = zip(first[k].tolist(), second[n].tolist(), strict=True)
    x, y = np.array([plane.at(*pair) if plane else pair for pair in pairs]).reshape(-1, 2).T
    return both, x, y


def noise_notes(streams: Mapping[str, tuple[Stamps, Vector]], settings: Estimation) -> list[str]:
    """Where gyro or accelerometers are noisier than ``settings`` say, by second differences of their samples."""
    notes = []
    for name, option in (("a_x", "acceleration_noise"), ("a_y", "acceleration_noise"), ("omega", "gyro_noise")):
        stamps, values = streams.get(name, (np.empty(0, np.int64), np.empty(0)))
        if len(values) < 10:
            continue
        white = np.median(np.abs(np.diff(values, 2))) / _MEDIAN_OF_NORMAL / math.sqrt(6)
        density = float(white * math.sqrt(np.median(np.diff(stamps)) / 1e9))
        if density > _NOISIER * getattr(settings, option):
            unit = "rad/s" if name == "omega" else "m/s^2"
            notes.append(
                f"{name}: its noise is {density:.2g} {unit} per root Hz, and estimation.{option} is "
                f"{getattr(settings, option):g}; v_y is worse than stated (write {option}: {density:.2g})"
            )
    return notes


class LiveEstimation:
    """Velocities live, by the samples so far.

    Args:
        signal_map: which has ``estimation``.
    """

    def __init__(self, signal_map: SignalMap) -> None:
        assert signal_map.estimation is not None
        self._settings = signal_map.estimation
        active = signal_map.active_signals()
        self._delays = {name: round(active[name].delay * 1e9) for name in MEASURED if name in active}
        self._filter = MotionFilter(self._settings, tuple(self._delays))
        self._max_gap = signal_map.max_gap_ns
        self._plane = None if self._settings.origin is None else Plane(self._settings.origin)
        self._samples: list[Samples] = []
        self._moments: list[Moment] = []  # of the first of them
        self._newest = 0  # stamp of the last omega (ns)
        self._is_cut = False  # whether what came before the first sample is forgotten

    def add(self, stamp: int, values: Mapping[str, float]) -> None:
        """Takes the samples of a message stamped ``stamp`` (ns); those that are not finite or of no use are ignored."""
        late: dict[int, dict[str, float]] = {}
        for name, delay in self._delays.items():
            if math.isfinite(values.get(name, math.nan)):
                late.setdefault(delay, {})[name] = float(values[name])
        for delay, some in late.items():
            self._insert(stamp - delay, some)

    def _insert(self, stamp: int, values: dict[str, float]) -> None:
        first = self._samples[0][0] + self._is_cut if self._samples else stamp
        is_within = bool(self._samples) and first <= stamp <= self._newest + self._max_gap
        if "omega" in values and not is_within:
            self._samples, self._moments, self._newest, self._is_cut = [(stamp, values)], [], stamp, False
            return
        if not is_within:
            return
        if self._plane is None and "latitude" in values and "longitude" in values:
            self._plane = Plane((values["latitude"], values["longitude"]))
        at = bisect_left(self._samples, stamp, key=_stamp)
        if at < len(self._samples) and self._samples[at][0] == stamp:
            self._samples[at] = stamp, self._samples[at][1] | values
        else:
            self._samples.insert(at, (stamp, values))
        del self._moments[at:]
        if "omega" in values:
            self._newest = max(self._newest, stamp)

    def at(self, stamp: int) -> dict[str, float]:
        """``v_x, v_y, omega`` and, where it is known, the pose at ``stamp`` (ns); nothing before they are known."""
        for when, values in self._samples[len(self._moments) :]:
            if when > self._newest:
                break
            last = self._moments[-1] if self._moments else None
            self._moments.append(advanced(self._filter, last, when, located(values, self._plane)))
        if not self._moments or not self._moments[-1].is_ready:
            return {}
        old = bisect_left(self._samples, self._newest - _KEPT_NS, key=_stamp)
        del self._samples[:old], self._moments[:old]
        self._is_cut = self._is_cut or old > 0
        moment = self._moments[-1]
        if not 0 <= stamp - moment.stamp <= self._max_gap:
            return {}
        if stamp > moment.stamp:
            moment = self._filter.step(moment, stamp, {})
        found = dict(zip(STATE_SIGNALS, moment.velocities, strict=True))
        return (
            found | dict(zip(POSE_SIGNALS, moment.x[[X, Y, THETA]].tolist(), strict=True)) if moment.has_pose else found
        )


def _stamp(sample: Samples) -> int:
    return sample[0]
