"""The live history beside one that is a plain list: any sequence of messages has the same answers."""

from __future__ import annotations

from itertools import pairwise
from math import inf, isfinite, nan

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from dynssm_ros.signals.history import History, Refusal
from test.signals.test_history import JUMP_BACK, MAX_AGE, NO_COMMANDS, SECOND, SIGNALS, START, feedback, odometry


class PlainHistory:
    """What :class:`History` must do, told with lists of ``(stamp, value)`` and nothing forgotten."""

    def __init__(self, T_s: float, H: int) -> None:
        self.held = ("throttle_feedback",)
        self.offsets = [round(k * T_s * SECOND) for k in range(H - 1, -1, -1)]
        self.samples: dict[str, list[tuple[int, float]]] = {name: [] for name in SIGNALS}
        self.suspect: tuple[int, dict[str, float]] | None = None

    def add(self, stamp: int, values: dict[str, float]) -> Refusal | None:
        values = {name: value for name, value in values.items() if name in self.samples}
        own = [samples[-1][0] for name, samples in self.samples.items() if samples and name in values]
        every = [samples[-1][0] for samples in self.samples.values() if samples]
        back = bool(own) and stamp < max(own) - round(JUMP_BACK * SECOND)
        if not (back or (own and stamp > max(every) + round(JUMP_BACK * SECOND))):
            if self.suspect is not None and set(values) & set(self.suspect[1]):
                self.suspect = None
            return self.take(stamp, values)
        before, self.suspect = self.suspect, (stamp, values)
        if before is None or abs(before[0] - stamp) > round(JUMP_BACK * SECOND):
            return Refusal.OUTLIER
        self.suspect = None
        if back:
            self.samples = {other: [] for other in SIGNALS}
        self.take(*before)
        refusal = self.take(stamp, values)
        return Refusal.JUMPED_BACK if back else refusal

    def take(self, stamp: int, values: dict[str, float]) -> Refusal | None:
        refusal = None
        for name, value in values.items():
            if not isfinite(value):
                refusal = refusal or Refusal.NOT_FINITE
                continue
            if self.samples[name] and stamp <= self.samples[name][-1][0]:
                refusal = refusal or Refusal.REPEATED
                continue
            self.samples[name].append((stamp, value))
        return refusal

    def window(self, stamp: int) -> list[list[float]] | Refusal:
        filling = False
        for samples in self.samples.values():
            if not samples:
                return Refusal.MISSING
            if stamp - samples[-1][0] > MAX_AGE * SECOND:
                return Refusal.STALE
            begin = samples[-1][0]
            for earlier, _ in reversed(samples):
                if begin - earlier > NO_COMMANDS.max_gap_ns:
                    break
                begin = earlier
            filling |= begin > stamp - self.offsets[0]
        if filling:
            return Refusal.FILLING
        rows = []
        for offset in self.offsets:
            row = [self.at(name, stamp - offset) for name in SIGNALS]
            rows.append([*row, 0.0, 0.0])
        return rows

    def at(self, name: str, instant: int) -> float:
        samples = self.samples[name]
        if name in self.held:
            return [value for stamp, value in samples if stamp <= instant][-1]
        for (t, a), (u, b) in pairwise(samples):
            if t <= instant <= u:
                return a + (b - a) * (instant - t) / (u - t)
        return samples[-1][1]


values = st.one_of(st.floats(-50, 50), st.just(nan), st.just(inf)) | st.floats(-50, 50)
message = st.one_of(
    st.builds(lambda a, b, c: {"v_x": a, "v_y": b, "omega": c, "x": 0.0}, values, values, values),
    st.dictionaries(st.sampled_from(SIGNALS[3:]), values),
    st.builds(feedback, st.floats(-50, 50)),
    st.builds(odometry, st.floats(-50, 50)),
)
moves = st.sampled_from([0.0, 0.005, 0.01, 0.01, 0.01, 0.02, 0.02, 0.1, 0.25, 0.26, 1.0, -0.005, -0.5, -0.51, -3.0])


@settings(deadline=None, max_examples=300)
@given(st.lists(st.tuples(moves, message), min_size=5, max_size=60))
def test_any_sequence_of_messages_is_answered_as_by_a_plain_list(
    sequence: list[tuple[float, dict[str, float]]],
) -> None:
    plain = PlainHistory(0.02, 4)
    history = History(NO_COMMANDS, 0.02, 4, max_age=MAX_AGE, held=plain.held)
    stamp = START
    for move, taken in sequence:
        stamp += round(move * SECOND)
        assert history.add(stamp, taken) is plain.add(stamp, taken)
        found, expected = history.window(stamp), plain.window(stamp)
        if isinstance(expected, Refusal):
            assert found is expected
        else:
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)
