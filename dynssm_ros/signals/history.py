"""The live counterpart of resampling: raw samples in ring buffers, a window on the model's grid at any instant.

The window is sampled back from a given stamp at ``T_s``, so odometry of any rate and jitter works. Between samples it
interpolates or holds as the extractor does; beyond the newest it holds.
"""

from __future__ import annotations

from collections.abc import Collection
from ctypes import c_int64
from enum import Enum
from math import isfinite

import numpy as np

from dynssm_ros import compiled
from dynssm_ros.arrays import Vector
from dynssm_ros.compiled import address
from dynssm_ros.errors import ConfigurationError
from dynssm_ros.signals.inputs import WINDOW_COLUMNS, model_inputs
from dynssm_ros.signals.signal_map import ROUNDING, SENSORS, STATE_SIGNALS, SignalMap


class Refusal(Enum):
    """Why there is no prediction; the value says it in words for `/diagnostics`."""

    FILLING = "the window is filling"
    MISSING = "a signal has not been received"
    STALE = "a signal is older than max_age"
    NOT_FINITE = "a sample is not finite"
    REPEATED = "a stamp repeats or is older than the newest"
    JUMPED_BACK = "time jumped back; the window starts anew"
    OUTLIER = "a stamp is far from the last ones, and no second message confirms it"
    IMPLAUSIBLE = "a sample is beyond what the car can do"
    JUMPED = "a sample is farther from the last one than the car can move"
    NO_ORIENTATION = "the orientation is no quaternion of length 1"
    FRAMES = "the odometry is in other frames"
    STANDS_STILL = "the odometry stands still"
    MAP_FRAME = "the twist is in the map's frame"
    SPEED_SIGN = "the speed's sign is swapped"
    SPEED_UNIT = "the speed is in km/h"
    CONTRADICTION = "pose and twist contradict each other"
    SKIPPED = "newer odometry waited"
    BAD_PREDICTION = "the model's output is not finite"
    IMPLAUSIBLE_PREDICTION = "the model's output is beyond what the car can do"


_NUMBER = 8  # bytes
_ABSENT = 0, 0, 0, False  # place of a signal that there is not


class RingBuffer:
    """The newest samples of one signal, in order, without allocation while running.

    Everything is stored twice, one capacity apart, so that the newest samples are one contiguous view. Times are ns
    since an epoch as floats: exact for 104 days, and to 0.3 us even since 1970 (an epoch set by a first message without
    a stamp).
    """

    def __init__(self, capacity: int = 256) -> None:
        """Makes room for ``capacity`` samples, at least 2."""
        self._times = np.empty(2 * capacity)
        self._values = np.empty(2 * capacity)
        self._capacity = capacity
        self._addresses = address(self._times) or 0, address(self._values) or 0
        self._next = 0
        self._count = 0
        self.holds = False
        """Whether a sample is kept until the next one, and not a line drawn between them."""
        self.newest = -np.inf
        """Time of the newest sample (ns since the epoch), ``-inf`` if empty."""

    def __len__(self) -> int:
        return self._count

    @property
    def times(self) -> Vector:
        """Of all stored samples, oldest first; a view."""
        return self._times[self._stored]

    @property
    def values(self) -> Vector:
        """Of all stored samples, oldest first; a view."""
        return self._values[self._stored]

    @property
    def _stored(self) -> slice:
        end = self._next + self._capacity
        return slice(end - self._count, end)

    @property
    def oldest(self) -> float:
        """Time of the oldest sample, ``inf`` if empty."""
        return self._times.item(self._next + self._capacity - self._count) if self._count else np.inf

    def place(self) -> tuple[int, int, int, bool]:
        """Where the compiled loop finds the samples: the oldest one's time and value, their number; whether it holds them."""
        start = _NUMBER * (self._next + self._capacity - self._count)
        times, values = self._addresses
        return times + start, values + start, self._count, self.holds

    def interpolate(self, grid: Vector) -> Vector:
        """Values at the times ``grid``, linear between samples and held beyond the newest."""
        return np.interp(grid, self.times, self.values)

    def held(self, grid: Vector) -> Vector:
        """The last values at or before the times ``grid``; the oldest one for times before it."""
        return np.asarray(self.values[np.maximum(np.searchsorted(self.times, grid, side="right") - 1, 0)])

    def append(self, time: float, value: float, span: float) -> None:
        """Adds a sample newer than all others, growing if the buffer would forget samples younger than ``span`` ns."""
        if self._count == self._capacity and time - self.times[1] < span:
            self._grow()
        k = self._next
        self._times[k] = self._times[k + self._capacity] = time
        self._values[k] = self._values[k + self._capacity] = value
        self._next = (k + 1) % self._capacity
        self._count = min(self._count + 1, self._capacity)
        self.newest = time

    def clear(self) -> None:
        """Forgets all samples."""
        self._next = self._count = 0
        self.newest = -np.inf

    def _grow(self) -> None:
        times, values, count, holds = self.times.copy(), self.values.copy(), self._count, self.holds
        self.__init__(2 * self._capacity)  # type: ignore[misc]
        self.holds = holds
        for buffer, old in ((self._times, times), (self._values, values)):
            buffer[:count] = buffer[self._capacity : self._capacity + count] = old
        self._next = self._count = count


class History:
    """The raw signals of the recent past and the model's window on them.

    Args:
        signal_map: which signals there are; its ``max_gap`` restarts the window after a hole in the data. Stamps further
            back than its ``jump_ns`` mean that time was set back, not disorder. They are believed, as those that are further
            ahead, when a second message confirms them.
        T_s: sampling time of the window (s).
        H: number of rows of the window.
        held: signals that keep their last sample until the next; the others are interpolated.
        max_age: how much older than the requested instant the newest sample of a signal may be (s).
    """

    def __init__(
        self,
        signal_map: SignalMap,
        T_s: float,
        H: int,
        *,
        max_age: float = 0.2,
        held: Collection[str] = (),
    ) -> None:
        inputs = [name for name in signal_map.active_signals() if name not in (*STATE_SIGNALS, *SENSORS)]
        self.names = (*STATE_SIGNALS, *inputs)
        self._buffers = {name: RingBuffer() for name in self.names if name not in ("x", "y", "theta")}
        speaks = "speed" if "speed_feedback" in self._buffers else "throttle"
        actuators = [f"{of}_{kind}" for kind in ("feedback", "command") for of in (speaks, "brake", "steering")]
        ordered = [self._buffers.get(name) for name in (*STATE_SIGNALS, *actuators)]
        self._ordered = [None if buffer is None else buffer.place for buffer in ordered]
        self._places = (c_int64 * (len(ordered) * len(_ABSENT)))()
        sources = signal_map.signals
        for name, source in signal_map.active_signals().items():
            if not 0.0 <= source.delay < 1.0:
                raise ConfigurationError(
                    f"signal map {signal_map.name}: signals.{name}.delay: {source.delay:g} s; live expected at least 0 and "
                    "below 1"
                )
        self._delays = {name: sources[name].delay * 1e9 if name in inputs else 0.0 for name in self._buffers}
        self._max_gap = float(signal_map.max_gap_ns)
        self._max_age = max_age * 1e9
        self._jump = float(signal_map.jump_ns)
        self._suspect: tuple[int, dict[str, float]] | None = None  # a message whose stamp (ns) may be an outlier
        self._epoch: int | None = None
        self._latest = -np.inf  # stamp of a sample (ns since the epoch)
        self.resize(T_s, H, held)

    def resize(self, T_s: float, H: int, held: Collection[str] = ()) -> None:
        """Changes the grid of the window; the samples are kept, so a longer window fills on from what is there."""
        for name, buffer in self._buffers.items():
            buffer.holds = name in held
        self._offsets = -np.arange(H - 1, -1, -1, dtype=np.float64) * (T_s * 1e9)
        self._grid = address(self._offsets)
        self._span = H * T_s * 1e9 + self._max_age + self._max_gap
        self._slack = ROUNDING * T_s * 1e9
        self._first = float(self._offsets[0]) + self._slack

    def add(self, stamp: int, values: dict[str, float]) -> Refusal | None:
        """Takes the samples of one message with header stamp ``stamp`` (ns), SI values by signal name; those not of the
        window are ignored.

        Returns:
            ``None`` if they were taken, else why not. After ``JUMPED_BACK`` the older samples are forgotten, and the
                new window begins with these and those of the message that they confirm.
        """
        known = {name: value for name, value in values.items() if name in self._buffers}
        if self._epoch is None:
            self._epoch = stamp
        jump = self._jump_of(stamp, known)
        if jump == 0.0:
            if self._suspect is not None and known.keys() & self._suspect[1].keys():
                self._suspect = None
            return self._take(stamp, known)
        suspect, self._suspect = self._suspect, (stamp, known)
        if suspect is None or abs(stamp - suspect[0]) > self._jump:
            return Refusal.OUTLIER
        if jump < 0.0:
            self.clear()
            self._epoch = suspect[0]
        self._suspect = None
        self._take(*suspect)
        refusal = self._take(stamp, known)
        return Refusal.JUMPED_BACK if jump < 0.0 else refusal

    def _jump_of(self, stamp: int, values: dict[str, float]) -> float:
        """How far a message's stamp is beyond what can follow the last ones (ns): negative back, positive ahead, else 0."""
        assert self._epoch is not None
        time = float(stamp - self._epoch)
        if abs(time - self._latest) <= self._jump:
            return 0.0
        newest = max((self._buffers[name].newest + self._delays[name] for name in values), default=-np.inf)
        if newest == -np.inf:
            return 0.0
        # a signal may be silent while others go on
        return min(time - (newest - self._jump), 0.0) or max(time - (self._latest + self._jump), 0.0)

    def _take(self, stamp: int, values: dict[str, float]) -> Refusal | None:
        """Appends the samples of one message, as far as they are newer than all others of their signals."""
        assert self._epoch is not None
        refusal, now = None, float(stamp - self._epoch)
        for name, value in values.items():
            buffer, time = self._buffers[name], now - self._delays[name]
            if not isfinite(value):
                refusal = refusal or Refusal.NOT_FINITE
                continue
            if time <= buffer.newest:
                refusal = refusal or Refusal.REPEATED
                continue
            if time - buffer.newest > self._max_gap:
                buffer.clear()  # no window goes across a gap
            buffer.append(time, value, self._span)
            self._latest = max(self._latest, now)
        return refusal

    def clear(self) -> None:
        """Forgets everything, as after a jump of time."""
        self._suspect = None
        for buffer in self._buffers.values():
            buffer.clear()
        self._latest = -np.inf
        self._epoch = None

    def window(self, stamp: int) -> Vector | Refusal:
        """The ``(H, 7)`` window in the order of ``WINDOW_COLUMNS`` whose last row is at ``stamp`` (ns), or why there is
        none.
        """
        if self._epoch is None:
            return Refusal.MISSING
        now = float(stamp - self._epoch)
        first, filling = now + self._first, False
        for buffer in self._buffers.values():
            age = now - buffer.newest
            if age > self._max_age:
                return Refusal.MISSING if age == np.inf else Refusal.STALE
            filling = filling or buffer.oldest > first
        if filling:
            return Refusal.FILLING
        window = np.empty((len(self._offsets), len(WINDOW_COLUMNS)))
        if compiled.LIBRARY is None:
            self._sample(now, window)
        else:
            self._places[:] = [part for place in self._ordered for part in (place() if place else _ABSENT)]
            compiled.LIBRARY.dynssm_window(
                self._places, self._grid, now, self._slack, len(self._offsets), address(window)
            )
        return window

    def _sample(self, now: float, window: Vector) -> None:
        """Fills the window that ends at the time ``now`` (ns since the epoch)."""
        grid = self._offsets + now
        late = grid + self._slack
        sampled = {
            name: buffer.held(late) if buffer.holds else buffer.interpolate(grid)
            for name, buffer in self._buffers.items()
        }
        for k, column in enumerate((*(sampled[name] for name in STATE_SIGNALS), *model_inputs(sampled))):
            window[:, k] = column

    def ages(self, stamp: int) -> dict[str, float]:
        """Age of the newest sample of each signal at ``stamp`` (s); infinite where none was received."""
        now = 0.0 if self._epoch is None else float(stamp - self._epoch)
        return {name: (now - buffer.newest) / 1e9 for name, buffer in self._buffers.items()}
