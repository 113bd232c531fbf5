"""What the live predictor says of itself: counts, rates, ages, latencies and a verdict in words."""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass, field
from enum import IntEnum
from math import isinf

import numpy as np

from dynssm_ros.signals.history import Refusal

_REMEMBERED = 1000


class Level(IntEnum):
    """Severity, numbered like ``diagnostic_msgs/msg/DiagnosticStatus``."""

    OK = 0
    WARN = 1
    ERROR = 2


@dataclass
class Health:
    """Collects what happened; times are seconds of a clock that never jumps.

    Attributes:
        topics: the inputs that are expected.
        max_silence: longest time without odometry that is still called healthy (s).
    """

    topics: tuple[str, ...]
    max_silence: float
    refusals: Counter[Refusal] = field(default_factory=Counter)
    predictions: int = 0
    _arrivals: dict[str, deque[float]] = field(default_factory=dict)
    _latencies: deque[float] = field(default_factory=lambda: deque(maxlen=_REMEMBERED))
    _shares: deque[float] = field(default_factory=lambda: deque(maxlen=_REMEMBERED))
    _last_refusal: tuple[float, Refusal] | None = None
    _last_prediction: float = -np.inf

    def __post_init__(self) -> None:
        self._arrivals = {topic: deque(maxlen=100) for topic in self.topics}

    def arrived(self, topic: str, now: float) -> None:
        """A message of ``topic`` came in."""
        self._arrivals[topic].append(now)

    def refused(self, refusal: Refusal, now: float) -> None:
        """A sample or a prediction was refused."""
        self.refusals[refusal] += 1
        self._last_refusal = (now, refusal)

    def predicted(self, latency: float, residual_share: float, now: float) -> None:
        """A prediction went out ``latency`` seconds after its odometry came in."""
        self.predictions += 1
        self._latencies.append(latency)
        self._shares.append(residual_share)
        self._last_prediction = now

    def rate(self, topic: str, now: float) -> float:
        """Messages per second of ``topic`` over its last hundred messages, 0 once it is silent."""
        times = self._arrivals[topic]
        if len(times) < 2 or now - times[-1] > self.max_silence:
            return 0.0
        return (len(times) - 1) / max(times[-1] - times[0], 1e-9)

    def age(self, topic: str, now: float) -> float:
        """Seconds since the last message of ``topic``, infinite if there was none."""
        times = self._arrivals[topic]
        return now - times[-1] if times else float("inf")

    def latency(self, percent: float) -> float:
        """Percentile of the last latencies (s), 0 if there was no prediction yet."""
        return float(np.percentile(self._latencies, percent)) if self._latencies else 0.0

    def verdict(self, now: float) -> tuple[Level, str]:
        """How it is now, in words: silent or missing inputs first, then why predictions are refused."""
        silent = {topic: self.age(topic, now) for topic in self.topics}
        words = [
            f"{topic}: " + ("nothing received" if isinf(age) else f"silent for {age:.1f} s")
            for topic, age in silent.items()
            if age > self.max_silence
        ]
        if words:
            return Level.ERROR, "; ".join(words)
        if self._last_refusal is not None and self._last_refusal[0] > self._last_prediction:
            refusal = self._last_refusal[1]
            return (Level.WARN if refusal is Refusal.FILLING else Level.ERROR), refusal.value
        return Level.OK, "predicting"

    def values(self, now: float) -> dict[str, str]:
        """All figures by name, for the key-value list of the diagnostic status."""
        figures = {
            "predictions": str(self.predictions),
            "latency p50 (ms)": f"{1e3 * self.latency(50):.3f}",
            "latency p99 (ms)": f"{1e3 * self.latency(99):.3f}",
            "share of the residual": f"{float(np.mean(self._shares)) if self._shares else 0.0:.3f}",
        }
        for topic in self.topics:
            figures[f"{topic} rate (Hz)"] = f"{self.rate(topic, now):.1f}"
            figures[f"{topic} age (s)"] = f"{self.age(topic, now):.3f}"
        for refusal in Refusal:
            figures[f"refused: {refusal.name.lower()}"] = str(self.refusals[refusal])
        return figures
