"""When samples were measured: which of them have a stamp to believe, and which topics are stamped by another clock."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from dynssm_ros.arrays import Vector
from dynssm_ros.errors import BagError
from dynssm_ros.signals import findings
from dynssm_ros.signals.findings import Finding
from dynssm_ros.signals.resampling import Stamps, Stream
from dynssm_ros.signals.signal_map import JUMP_NS, SignalMap

_LARGEST = 1e12  # in any unit; coordinates of maps in mm are 1e10
_AHEAD = "with a stamp far ahead of those that follow"
_A_PART = 0.1  # of the samples lie ahead of those that follow, from which on they are a drive of their own
_SEVERAL = 0.1  # of the steps go back, from which on several publishers are likelier than a fault
_APART = 0.2  # s by which clocks may be apart; what is measured late is rarely later than that
_DRIFT = 0.1  # s by which clocks may come apart over a log
_JUMP, _OFF_SHARE, _FEWEST_POSITIONS = 10.0, 0.02, 50
"""By how much farther a position lies off both neighbours than they are apart; share of such ones that is told; how many
positions there have to be."""
_KNOWN = {18: "GPS time is 18 s ahead of UTC", 19: "TAI is 19 s ahead of GPS time", 37: "TAI is 37 s ahead of UTC"}


class Lateness(NamedTuple):
    """How much later than its stamp each message of a topic was recorded: log times and latenesses (s), each ``(N,)``."""

    time: Vector
    late: Vector


def possible(values: Vector) -> npt.NDArray[np.bool_]:
    """Whether each value is finite, and of a size that a signal can have."""
    return np.isfinite(values) & (np.abs(values) <= _LARGEST)


def clean(stream: Stream, where: str, drop_bad: bool, jump: int = JUMP_NS) -> tuple[Stream, str]:
    """Checks a stream for values that no signal has and for stamps that repeat, run backwards or are far ahead.

    Of stamps more than ``jump`` ns apart those count that most samples agree with, so that a few far ahead cost no others.

    Returns:
        The stream, without bad samples if ``drop_bad``, and what was dropped (empty if nothing).

    Raises:
        BagError: a bad sample and ``drop_bad`` is off; names the first.
    """
    stamps, values = stream.stamps, stream.values
    finite = possible(values)
    believed = finite.copy()
    believed[finite] = _in_line(stamps[finite], jump)
    oldest = np.iinfo(np.int64).min
    newest = np.maximum.accumulate(np.concatenate([[oldest], np.where(believed, stamps, oldest)]))[:-1]
    kinds = {
        "not finite": ~np.isfinite(values),
        "larger than any signal": np.isfinite(values) & ~finite,
        "with a repeated stamp": finite & (stamps == newest),
        "with a stamp that runs backwards": finite & (stamps < newest),
        _AHEAD: finite & ~believed & (stamps > newest),
    }
    back = int((np.diff(stamps[finite]) < 0).sum())
    several = "; do several nodes publish the topic?" if back > max(_SEVERAL * len(stamps), 2) else ""
    dropped: list[str] = []
    for kind, bad in kinds.items():
        if not bad.any():
            continue
        k = int(np.flatnonzero(bad)[0])
        if not drop_bad:
            hint = several or (_anew(stamps, bad) if kind == _AHEAD else "")
            raise BagError(
                f"{where}: sample {k} at {stamps[k] / 1e9:.3f} s, value {values[k]:g}, is {kind} ({bad.sum()} such"
                f"{hint}); expected finite values at increasing stamps (--drop-bad leaves such samples out)"
            )
        dropped.append(f"{bad.sum()} samples {kind}")
    if not dropped:
        return stream, ""
    keep = ~np.logical_or.reduce(list(kinds.values()))
    return Stream(stamps[keep], values[keep]), ", ".join(dropped) + several


def _anew(stamps: Stamps, ahead: npt.NDArray[np.bool_]) -> str:
    """Where the clock starts anew, if more than a few samples are ``ahead`` of those that follow; empty if not."""
    if ahead.sum() <= _A_PART * len(stamps):
        return ""
    first = int(np.argmin(np.diff(stamps))) + 1
    return f"; the clock starts anew at sample {first}: two drives in one log, which are better cut apart there"


def _in_line(stamps: Stamps, jump: int) -> npt.NDArray[np.bool_]:
    """Whether each stamp belongs to the runs, without jumps inside, that hold most samples while time goes forward."""
    cuts = np.flatnonzero(np.abs(np.diff(stamps)) > jump) + 1
    if not (np.diff(stamps)[cuts - 1] < 0).any():
        return np.ones(len(stamps), dtype=bool)
    runs = [slice(a, b) for a, b in pairwise([0, *cuts.tolist(), len(stamps)])]
    before: list[int] = []  # of each run the one that precedes it in its best line, or -1
    ends: list[int] = []  # of the best lines so far, by their last stamp; longer ones end later
    counts: list[int] = []
    last: list[int] = []
    for number, run in enumerate(runs):
        first, end = int(stamps[run].min()), int(stamps[run].max())
        k = bisect_left(ends, first) - 1
        before.append(last[k] if k >= 0 else -1)
        count = run.stop - run.start + (counts[k] if k >= 0 else 0)
        k = bisect_left(ends, end)
        if (k > 0 and counts[k - 1] >= count) or (k < len(ends) and ends[k] == end and counts[k] >= count):
            continue
        while k < len(ends) and counts[k] <= count:
            del ends[k], counts[k], last[k]
        ends.insert(k, end)
        counts.insert(k, count)
        last.insert(k, number)
    kept, number = np.zeros(len(stamps), dtype=bool), last[-1]
    while number >= 0:
        kept[runs[number]] = True
        number = before[number]
    return kept


def clock_notes(topics: Mapping[str, Lateness], reference: str) -> list[str]:
    """Sentences on topics that are stamped by another clock than the topic ``reference``; of those with stamps alone."""
    own = topics.get(reference)
    if own is None or not len(own.late):
        return []
    found, apart = [], clocks_apart(topics, reference)
    for name, topic in topics.items():
        drift = _change(topic) - _change(own) if name != reference and len(topic.late) else 0.0
        if abs(drift) > _DRIFT:
            found.append(f"{name} is stamped by a clock that drifts by {abs(drift):.2g} s against {reference}'s")
        elif name in apart:
            found.append(f"{name} is stamped {_told_apart(apart[name], reference)}")
    return found


def clocks_apart(topics: Mapping[str, Lateness], reference: str) -> dict[str, float]:
    """By how much topics are stamped before the topic ``reference`` (s), where that is another clock and none that drifts."""
    own = topics.get(reference)
    if own is None or not len(own.late):
        return {}
    apart = {
        name: float(np.median(topic.late) - np.median(own.late))
        for name, topic in topics.items()
        if name != reference and len(topic.late) and abs(_change(topic) - _change(own)) <= _DRIFT
    }
    return {name: seconds for name, seconds in apart.items() if abs(seconds) > _APART}


def clock_findings(apart: Mapping[str, float], signal_map: SignalMap) -> tuple[Finding, ...]:
    """What :func:`clocks_apart` found of the topics of steering and throttle, one finding where both are off alike.

    What the ``delay`` of a signal in the map takes off already is none.
    """
    found: list[Finding] = []
    for name, signal in (("steering", "steering_feedback"), ("throttle", f"{signal_map.set_point}_feedback")):
        source = signal_map.signals[signal]
        seconds = apart.get(source.recorded, -source.delay) + source.delay
        if abs(seconds) <= _APART:
            continue
        if found and abs(found[0].size - seconds) < _APART:
            remedy = f"{found[0].remedy}, {signal} likewise"
            return (found[0].model_copy(update={"what": "inputs_clock", "remedy": remedy}),)
        found.append(
            Finding(
                what=f"{name}_clock", told=f"{signal} is stamped {_told_apart(seconds, signal_map.odometry_topic)}",
                size=seconds, low=seconds - _APART, high=seconds + _APART, unit="s", expected=f"within {_APART:g} s",
                remedy=f"synchronise the clocks, or {signal}: delay: {findings.number(source.delay - seconds)} in this log",
            )
        )  # fmt: skip
    return tuple(found)


def _told_apart(seconds: float, reference: str) -> str:
    known = next((f" ({told})" for s, told in _KNOWN.items() if abs(abs(seconds) - s) < _APART), "")
    return f"{abs(seconds):.3g} s {'before' if seconds > 0 else 'after'} {reference}: another clock?{known}"


def _change(topic: Lateness) -> float:
    """By how much lateness grows from the first third of a topic's messages to the last (s)."""
    third = len(topic.late) // 3
    return float(np.median(topic.late[-third:]) - np.median(topic.late[:third])) if third else 0.0


def log_time_note(topic: str) -> str:
    """A sentence on a topic whose messages have no stamp."""
    return f"{topic}: messages without a stamp; they count by log time"


def frames_note(topic: str, frames: Mapping[str, int]) -> list[str]:
    """A sentence on a topic whose messages name several frames, with how many name the commonest."""
    if len(frames) < 2:
        return []
    common = sorted(frames.items(), key=lambda one: -one[1])[:3]
    told = ", ".join(f"{name or 'none'} ({count})" for name, count in common)
    return [f"{topic}: its messages are in several frames: {told}; do several nodes publish it?"]


def publishers_note(place: str, x: Vector, y: Vector) -> list[str]:
    """A sentence on positions (m) that lie off both neighbours, which agree, again and again: those of two publishers."""
    position = x + 1j * y
    if len(position) < _FEWEST_POSITIONS:
        return []
    step, across = np.abs(np.diff(position)), np.abs(position[2:] - position[:-2])
    off = np.minimum(step[:-1], step[1:]) > _JUMP * np.maximum(across, np.median(across))
    if float(off.mean()) < _OFF_SHARE:
        return []
    by = findings.number(float(np.median(step[:-1][off])))
    told = f"x, y jump by {by} m and back at {100 * off.mean():.0f} % of the samples"
    return [f"{place}: {told}; do several nodes publish it?"]
