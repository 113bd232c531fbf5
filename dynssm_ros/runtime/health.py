"""What a live node says of what comes in and goes out: counts, rates, ages, latencies and a verdict in words."""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass, field
from enum import IntEnum
from math import isinf

import numpy as np

from dynssm_ros.signals.history import Refusal

_REMEMBERED = 1000
_CLOCKS = 10  # messages by whose delays clocks are compared
_JUDGED = 100  # outcomes that the verdict is of
_NOW = 5  # of which the last, all refused, mean that there is no prediction now
_MANY = 0.05  # share of them refused, from which on it is said
_OTHER_CLOCK_S = 0.5
_FORGETTING = 1e-3  # s per s by which the fastest delivery may grow: clocks drift less
_REAL_TIME = 0.05  # share by which stamps and clock may differ for lateness to be told: logs are played at other rates
_SETTLED_S = 2.0  # after which that share is known


class Level(IntEnum):
    """Severity, numbered like ``diagnostic_msgs/msg/DiagnosticStatus``."""

    OK = 0
    WARN = 1
    ERROR = 2


class Delivery:
    """How much later messages come than the fastest of them lately, whatever their clock is.

    Nothing is late after a silence, a time that jumps back, or where stamps do not go at the pace of the clock.

    Args:
        max_silence: after which it begins anew (s).
        max_late: lateness (s) beyond which it is not got used to.
    """

    def __init__(self, max_silence: float, max_late: float = np.inf) -> None:
        self._max_silence, self._max_late = max_silence, max_late
        self.forget()

    def forget(self) -> None:
        """The next message is the first."""
        self._first: tuple[float, int] | None = None
        self._last = (0.0, 0)
        self._fastest = np.inf
        self._behind: deque[float] = deque(maxlen=_NOW)

    def arrived(self, now: float, stamp: int) -> None:
        """A message with ``stamp`` (ns) came at ``now`` (s)."""
        elapsed = now - self._last[0]
        if self._first is None or elapsed > self._max_silence or stamp < self._last[1]:
            self.forget()
            self._first, elapsed = (now, stamp), 0.0
        self._last = now, stamp
        delay = now - stamp / 1e9
        if delay - self._fastest < self._max_late:
            self._fastest += _FORGETTING * elapsed
        self._fastest = min(delay, self._fastest)
        self._behind.append(delay - self._fastest)

    @property
    def newest(self) -> float:
        """Of the newest message (s)."""
        return self._behind[-1] if self._behind else 0.0

    @property
    def behind(self) -> float:
        """The least of the last messages (s); 0 where it cannot be told."""
        if self._first is None or len(self._behind) < _NOW:
            return 0.0
        elapsed, driven = self._last[0] - self._first[0], (self._last[1] - self._first[1]) / 1e9
        if elapsed < _SETTLED_S or abs(driven - elapsed) > _REAL_TIME * elapsed:
            return 0.0
        return min(self._behind)


@dataclass
class Health:
    """Collects what happened; times are seconds of a clock that never jumps.

    Attributes:
        topics: the inputs that are expected.
        max_silence: longest time without odometry that is still called healthy (s).
        period: T_s (s), within which an answer is not late.
        publishers: of each input, as far as known.
        wiring: what is wired wrongly, in words; empty if nothing is known to be.
        hindsight: what became of the predictions; see :meth:`~dynssm_ros.runtime.hindsight.Hindsight.verdict`.
        late: answers that were late.
    """

    topics: tuple[str, ...]
    max_silence: float
    period: float = np.inf
    publishers: dict[str, int] = field(default_factory=dict)
    wiring: str = ""
    hindsight: tuple[Level, str] = (Level.OK, "")
    late: int = 0
    refusals: Counter[Refusal] = field(default_factory=Counter)
    predictions: int = 0
    _arrivals: dict[str, deque[float]] = field(default_factory=dict)
    _latencies: deque[float] = field(default_factory=lambda: deque(maxlen=_REMEMBERED))
    _shares: deque[float] = field(default_factory=lambda: deque(maxlen=_REMEMBERED))
    _outcomes: deque[Refusal | None] = field(default_factory=lambda: deque(maxlen=_JUDGED))
    _delays: dict[str, deque[float]] = field(default_factory=dict)
    _deliveries: dict[str, Delivery] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._arrivals = {topic: deque(maxlen=100) for topic in self.topics}
        self._delays = {topic: deque(maxlen=_CLOCKS) for topic in self.topics}
        self._deliveries = {topic: Delivery(self.max_silence) for topic in self.topics}

    def arrived(self, topic: str, now: float, stamp: int | None = None) -> None:
        """A message of ``topic`` came in, with ``stamp`` (ns)."""
        self._arrivals[topic].append(now)
        if stamp is not None:
            self._delays[topic].append(now - stamp / 1e9)
            self._deliveries[topic].arrived(now, stamp)

    def delivery(self, topic: str) -> Delivery:
        """How late the messages of ``topic`` come."""
        return self._deliveries[topic]

    def refused(self, refusal: Refusal) -> None:
        """A sample or a prediction was refused, or odometry passed over."""
        self.refusals[refusal] += 1
        self._outcomes.append(refusal)

    def predicted(self, latency: float, residual_share: float, late: float = 0.0) -> None:
        """A prediction went out ``latency`` seconds after its odometry arrived in the process, itself ``late`` (s)."""
        self.predictions += 1
        self.late += late + latency > self.period
        self._outcomes.append(None)
        self._latencies.append(latency)
        self._shares.append(residual_share)

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
        """How it is now, in words: silent or missing inputs first, then why predictions are or were refused."""
        silent = {topic: self.age(topic, now) for topic in self.topics}
        words = [
            f"{topic}: " + ("nothing received" if isinf(age) else f"silent for {age:.1f} s")
            for topic, age in silent.items()
            if age > self.max_silence
        ]
        words += self._clocks()
        if words:
            return Level.ERROR, "; ".join([*words, *self._mostly_refused()])
        if self.wiring:
            return Level.ERROR, self.wiring
        recent = list(self._outcomes)[-_NOW:]
        newest = recent[-1] if recent else None
        if newest is not None and None not in recent:
            return (Level.WARN if newest is Refusal.FILLING else Level.ERROR), newest.value
        if late := self._lateness():
            return late
        if self.hindsight[0]:
            return self.hindsight
        several = [f"{topic}: {count} publishers" for topic, count in self.publishers.items() if count > 1]
        if several:
            return Level.WARN, "; ".join(several)
        refused = self._mostly_refused()
        return (Level.WARN, refused[0]) if refused else (Level.OK, "predicting")

    def _lateness(self) -> tuple[Level, str] | None:
        """The verdict on inputs or answers of which the last were all late, the worst of them."""
        found = {
            f"{topic}: comes {{}} later than its fastest lately": d.behind for topic, d in self._deliveries.items()
        }
        if len(self._latencies) >= _NOW:
            found["answers come {} after the odometry: it cannot keep up"] = min(list(self._latencies)[-_NOW:])
        words, late = max(found.items(), key=lambda item: item[1])
        if late <= self.period:
            return None
        return Level.ERROR if late > self.max_silence else Level.WARN, words.format(f"{late:.2f} s")

    def _mostly_refused(self) -> list[str]:
        """The share of messages that was refused lately, with the reason of most; nothing if it is small."""
        refused = [outcome for outcome in self._outcomes if outcome is not None]
        share = len(refused) / max(len(self._outcomes), 1)
        most = Counter(refused).most_common(1)
        if share <= _MANY or most[0][0] is Refusal.FILLING:
            return []
        return [f"{share:.0%} of the last messages refused, mostly: {most[0][0].value}"]

    def _clocks(self) -> list[str]:
        """Topics whose stamps are on another clock than those of most others."""
        delays = {topic: min(values) for topic, values in self._delays.items() if values}
        if len(delays) < 2:
            return []
        usual = sorted(delays.values())[(len(delays) - 1) // 2]
        return [
            f"{topic}: its stamps are {abs(off):.3g} s {'behind' if off > 0 else 'ahead of'} those of other topics"
            for topic, delay in delays.items()
            if abs(off := delay - usual) > self.max_silence + _OTHER_CLOCK_S
        ]

    def values(self, now: float) -> dict[str, str]:
        """All figures by name, for the key-value list of the diagnostic status."""
        figures = {
            "predictions": str(self.predictions),
            "latency p50 (ms)": f"{1e3 * self.latency(50):.3f}",
            "latency p99 (ms)": f"{1e3 * self.latency(99):.3f}",
            "late answers": str(self.late),
            "share of the residual": f"{float(np.mean(self._shares)) if self._shares else 0.0:.3f}",
        }
        for topic in self.topics:
            figures[f"{topic} rate (Hz)"] = f"{self.rate(topic, now):.1f}"
            figures[f"{topic} age (s)"] = f"{self.age(topic, now):.3f}"
            figures[f"{topic} publishers"] = str(self.publishers.get(topic, 0))
        for refusal in Refusal:
            figures[f"refused: {refusal.name.lower()}"] = str(self.refusals[refusal])
        return figures
