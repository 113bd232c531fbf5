"""The ring buffer is the end of a plain list, and as long as its span needs."""

from __future__ import annotations

from math import inf

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from dynssm_ros.signals.history import RingBuffer


@given(st.lists(st.integers(1, 50), max_size=200), st.integers(2, 8), st.integers(0, 400))
def test_the_buffer_is_the_end_of_a_plain_list_and_keeps_what_is_young(
    steps: list[int], capacity: int, span: int
) -> None:
    buffer, plain = RingBuffer(capacity), []
    for time in np.cumsum(steps, dtype=float).tolist():
        buffer.append(time, -time, span)
        plain.append(time)
        assert len(buffer) == len(buffer.times) == len(buffer.values)
        assert buffer.times.tolist() == plain[len(plain) - len(buffer) :]
        np.testing.assert_array_equal(buffer.values, -buffer.times)
        assert buffer.newest == time
        # whatever lies inside the span can be interpolated: it starts at or after the oldest sample kept
        assert len(buffer) == len(plain) or buffer.times[0] <= time - span


def test_a_buffer_grows_only_as_far_as_its_span_needs() -> None:
    buffer = RingBuffer(4)
    for k in range(10_000):
        buffer.append(float(k), 0.0, 100.0)
    assert 100 <= len(buffer) <= 256


def test_an_emptied_buffer_is_as_new() -> None:
    buffer = RingBuffer(2)
    assert buffer.newest == -inf
    for k in range(5):
        buffer.append(float(k), 1.0, 3.0)
    buffer.clear()
    assert (len(buffer), buffer.newest, buffer.times.tolist()) == (0, -inf, [])
    buffer.append(0.0, 2.0, 3.0)
    assert buffer.values.tolist() == [2.0]
