"""Whether what was predicted lately was nearer to what was then measured than no prediction: the state as it was."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

from dynssm_ros.runtime.health import Level

_SECONDS = 1.0  # that are judged
_FEWEST = 10  # comparisons, before anything is said
_NOTICEABLE = 1.0  # error in usual increments, below which a car that drives evenly is well predicted
_FAR = 3.0  # times as large an error is not for want of training
_KEPT = 1000


class _Pending(NamedTuple):
    due: int  # ns
    predicted: tuple[float, ...]
    before: tuple[float, ...]


class Hindsight:
    """Compares predictions with measurements as they come in.

    Args:
        scale: usual increments of ``v_x, v_y, omega``, from the model card.
        minimum_speed: below it models are not trained, and nothing is compared (m/s).
    """

    def __init__(self, scale: Sequence[float], minimum_speed: float) -> None:
        self._scale, self._minimum_speed = scale, minimum_speed
        self.forget()

    def forget(self) -> None:
        """Nothing was predicted."""
        self._pending: deque[_Pending] = deque(maxlen=_KEPT)
        self._last: tuple[int, tuple[float, ...]] | None = None
        self._squares: deque[tuple[int, float, float]] = deque(maxlen=_KEPT)

    def predicted(self, due: int, predicted: Sequence[float], before: Sequence[float]) -> None:
        """A state was predicted for the instant ``due`` (ns) from the one ``before``; ``v_x, v_y, omega`` each."""
        if abs(before[0]) >= self._minimum_speed:
            self._pending.append(_Pending(due, tuple(predicted), tuple(before)))

    def measured(self, stamp: int, state: Sequence[float]) -> None:
        """The state at ``stamp`` (ns) was measured. Between two measurements it is on a line."""
        now = tuple(state)
        while self._pending and self._pending[0].due <= stamp:
            due, predicted, before = self._pending.popleft()
            if self._last is None or not self._last[0] < due:
                continue
            share = (due - self._last[0]) / (stamp - self._last[0])
            then = [a + share * (b - a) for a, b in zip(self._last[1], now, strict=True)]
            self._squares.append((stamp, self._distance(predicted, then), self._distance(before, then)))
        self._last = stamp, now
        while self._squares and stamp - self._squares[0][0] > _SECONDS * 1e9:
            self._squares.popleft()

    def verdict(self) -> tuple[Level, str]:
        """On the predictions of the last second, in words: OK and none if they were not worse than no prediction."""
        if len(self._squares) < _FEWEST:
            return Level.OK, ""
        own = math.sqrt(math.fsum(square for _, square, _ in self._squares) / len(self._squares))
        none = math.sqrt(math.fsum(square for _, _, square in self._squares) / len(self._squares))
        if own <= max(none, _NOTICEABLE):
            return Level.OK, ""
        level = Level.ERROR if own > _FAR * max(none, _NOTICEABLE) else Level.WARN
        return level, f"predictions were off by {own:.2g} usual steps lately, the state before them by {none:.2g}"

    def _distance(self, one: Sequence[float], other: Sequence[float]) -> float:
        """Mean square of the differences, in usual increments."""
        return sum(((a - b) / s) ** 2 for a, b, s in zip(one, other, self._scale, strict=True)) / len(self._scale)
