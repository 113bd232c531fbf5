"""Resampling: exact on what is linear, inside what was measured, and never across a gap."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dynssm_ros.errors import RecordingError
from dynssm_ros.signals.recording import Recording, RecordingInfo
from dynssm_ros.signals.resampling import Stream, resample, sample, uniform_grid
from dynssm_ros.signals.signal_map import REQUIRED_SIGNALS, Commands

START = 1_700_000_000_123_456_789
MAX_GAP = 0.25
COLUMNS = ("v_x", "v_y", "omega", "r_fb", "delta_fb")


def stream(times: np.ndarray, values: np.ndarray) -> Stream:
    return Stream(START + np.round(np.asarray(times) * 1e9).astype(np.int64), np.asarray(values, dtype=float))


def brought_onto_a_grid(streams: dict[str, Stream], rate: float, commands: Commands = "none") -> Recording:
    info = RecordingInfo(sampling_time=1 / rate, commands=commands, source=("drive",))
    return resample(streams, rate, MAX_GAP, commands, info)


@st.composite
def linear_streams(draw: st.DrawFn) -> tuple[dict[str, Stream], dict[str, tuple[float, float]]]:
    """For each signal its own rate, offset and jitter, and the line that its values lie on."""
    streams, lines = {}, {}
    for name in REQUIRED_SIGNALS:
        rate, offset = draw(st.floats(6, 400)), draw(st.floats(0, 0.2))
        jitter, seed = draw(st.floats(0, 0.45)), draw(st.integers(0, 2**16))
        n = int(2 * rate) + 2
        t = offset + (np.arange(n) + jitter * np.random.default_rng(seed).uniform(-1, 1, n)) / rate
        a, b = draw(st.floats(-50, 50)), draw(st.floats(-50, 50))
        stamps = START + np.round(t * 1e9).astype(np.int64)
        streams[name], lines[name] = Stream(stamps, a + b * ((stamps - START) / 1e9)), (a, b)
    return streams, lines


@settings(deadline=None, max_examples=60)
@given(linear_streams(), st.floats(2, 200))
def test_linear_signals_are_reproduced_exactly_at_any_rate_offset_and_jitter(
    drawn: tuple[dict[str, Stream], dict[str, tuple[float, float]]], rate: float
) -> None:
    streams, lines = drawn
    # rates from 6 Hz with jitter leave up to 0.32 s between samples, so bridge that here
    recording = resample(streams, rate, 0.5, "none", RecordingInfo(sampling_time=1 / rate, commands="none"))
    t = (recording.time - START) / 1e9
    for column, name in zip(COLUMNS, REQUIRED_SIGNALS, strict=True):
        a, b = lines[name]
        np.testing.assert_allclose(recording[column], a + b * t, rtol=0, atol=1e-10)
    assert (recording.segment == 0).all()
    covered = max(s.stamps[0] for s in streams.values()), min(s.stamps[-1] for s in streams.values())
    assert recording.time[0] - covered[0] < 1e9 / rate + 1
    assert covered[1] - recording.time[-1] < 1e9 / rate + 1


gappy = st.lists(
    st.tuples(st.sampled_from([0.01, 0.04, 0.1, 0.2, 0.25, 0.250000001, 0.3, 1.0]), st.floats(-9, 9)),
    min_size=2,
    max_size=30,
)


def built(steps: list[tuple[float, float]]) -> Stream:
    gaps, values = np.array(steps).T
    return stream(np.cumsum(gaps), values)


@settings(deadline=None, max_examples=150)
@given(gappy, gappy, st.sampled_from([0.004, 0.04, 0.1, 0.3, 1 / 30]))
def test_rows_and_segments_are_those_of_the_definition_told_step_by_step(
    odometry: list[tuple[float, float]], feedback: list[tuple[float, float]], T_s: float
) -> None:
    streams = dict.fromkeys(("v_x", "v_y", "omega"), built(odometry))
    streams |= dict.fromkeys(("throttle_feedback", "steering_feedback"), built(feedback))
    anchor, end = (int(s) for s in streams["v_x"].stamps[[0, -1]])
    instants = [anchor + round(k * T_s * 1e9) for k in range(int((end - anchor) / (T_s * 1e9)) + 2)]

    def neighbours(s: Stream, instant: int) -> tuple[int, int] | None:
        """Indices of the samples around an instant, if no gap lies there."""
        left, right = bisect_right(s.stamps.tolist(), instant) - 1, bisect_left(s.stamps.tolist(), instant)
        if left < 0 or right == len(s.stamps) or s.stamps[right] - s.stamps[left] > MAX_GAP * 1e9:
            return None
        return left, right

    expected = [t for t in instants if all(neighbours(s, t) for s in streams.values())]
    if not expected:
        with pytest.raises(RecordingError, match="drive: no instant is covered"):
            brought_onto_a_grid(streams, 1 / T_s)
        return
    recording = brought_onto_a_grid(streams, 1 / T_s)
    assert recording.time.tolist() == expected
    for row, instant in enumerate(expected):
        for column, name in (("v_x", "v_x"), ("delta_fb", "steering_feedback")):
            left, right = neighbours(streams[name], instant) or (0, 0)
            low, high = sorted(streams[name].values[[left, right]])
            assert low - 1e-12 <= recording[column][row] <= high + 1e-12
    for (a, b), (s, r) in zip(pairwise(expected), pairwise(recording.segment.tolist()), strict=True):
        uniform = b - a <= T_s * 1e9 + 1
        gap_between = any(
            later - earlier > MAX_GAP * 1e9 and earlier >= a and later <= b
            for one in streams.values()
            for earlier, later in pairwise(one.stamps.tolist())
        )
        assert (r == s) == (uniform and not gap_between)
        assert r - s in (0, 1)


@settings(deadline=None)
@given(st.floats(3, 300), st.floats(0.5, 5))
def test_the_grid_is_uniform_to_the_nanosecond(rate: float, duration: float) -> None:
    t = np.arange(0, duration, 0.01)
    recording = brought_onto_a_grid(dict.fromkeys(REQUIRED_SIGNALS, stream(t, t)), rate)
    steps = np.diff(recording.time)
    assert np.abs(steps - 1e9 / rate).max(initial=0) <= 1
    np.testing.assert_allclose(recording.time - recording.time[0], np.arange(len(recording)) * 1e9 / rate, atol=0.51)


@pytest.mark.parametrize(("gap", "segments"), [(0.25, 1), (0.250001, 2), (3.0, 2)])
def test_max_gap_is_the_longest_time_that_is_bridged(gap: float, segments: int) -> None:
    t = np.concatenate([np.arange(0, 1.001, 0.02), 1.0 + gap + np.arange(0, 1.001, 0.02)])
    steady = stream(np.arange(-1, 9, 0.02), np.zeros(500))
    streams = dict.fromkeys(REQUIRED_SIGNALS, steady) | {"v_x": stream(t, t)}
    recording = brought_onto_a_grid(streams, 50.0)
    assert len(np.unique(recording.segment)) == segments
    np.testing.assert_allclose(recording["v_x"], (recording.time - START) / 1e9, atol=1e-9)
    inside = recording.time - START
    assert not ((inside > 1e9) & (inside < 1e9 * (1 + gap) - 1)).any() or segments == 1


def test_a_gap_that_no_grid_instant_falls_into_still_splits() -> None:
    """At 1 Hz the samples beside the gap are grid instants; what lay between them is unknown all the same."""
    t = np.concatenate([np.arange(0, 1.001, 0.1), np.arange(2, 3.001, 0.1)])
    recording = brought_onto_a_grid(dict.fromkeys(REQUIRED_SIGNALS, stream(t, t)), 1.0)
    assert ((recording.time - START) / 1e9).tolist() == [0.0, 1.0, 2.0, 3.0]
    assert recording.segment.tolist() == [0, 0, 1, 1]


def test_a_gap_in_one_signal_splits_the_recording() -> None:
    t = np.arange(0, 4, 0.01)
    steady = stream(t, t)
    broken = stream(t[(t < 1) | (t > 2)], t[(t < 1) | (t > 2)])
    recording = brought_onto_a_grid(dict.fromkeys(REQUIRED_SIGNALS, steady) | {"steering_feedback": broken}, 100.0)
    seconds = (recording.time - START) / 1e9
    assert len(np.unique(recording.segment)) == 2
    assert not ((seconds > 1.0) & (seconds < 2.0)).any()


def test_a_first_message_without_a_stamp_does_not_make_a_grid_of_fifty_years() -> None:
    t = np.arange(0, 2, 0.01)
    good = stream(t, t)
    unset = Stream(np.concatenate([[0], good.stamps]), np.concatenate([[0.0], good.values]))
    recording = brought_onto_a_grid(dict.fromkeys(REQUIRED_SIGNALS, good) | {"v_x": unset}, 25.0)
    assert 45 <= len(recording) <= 50
    assert recording.time[0] >= START


def test_headings_are_unwrapped_before_they_are_interpolated() -> None:
    t = np.arange(0, 20, 0.05)
    heading = 3.0 + 1.7 * t
    wrapped = np.arctan2(np.sin(heading), np.cos(heading))
    streams = dict.fromkeys(REQUIRED_SIGNALS, stream(t, t)) | {"theta": stream(t, wrapped)}
    recording = brought_onto_a_grid(streams, 33.0)
    seconds = (recording.time - START) / 1e9
    np.testing.assert_allclose(np.diff(recording["theta"]), 1.7 * np.diff(seconds), atol=1e-9)
    np.testing.assert_allclose(np.exp(1j * recording["theta"]), np.exp(1j * (3.0 + 1.7 * seconds)), atol=1e-9)


def test_a_held_signal_keeps_its_last_sample_also_where_a_row_misses_it_by_rounding() -> None:
    grid = START + np.arange(7) * 20_000_000
    slow = Stream(START + np.arange(4) * 50_000_000 + np.array([0, 5, 0, 0]), np.array([0.0, 1.0, 2.0, 3.0]))
    values, stretch = sample(slow, grid, 250_000_000, "zero", 20)
    assert values.tolist() == [0.0, 0.0, 0.0, 1.0, 1.0, 2.0, 2.0]
    assert set(stretch.tolist()) == {0}
    assert sample(slow, grid[:1] + 50_000_000, 250_000_000, "zero", 0)[0].tolist() == [0.0]


def test_commands_become_increments_and_brakes_negative_throttle() -> None:
    t = np.arange(0, 2, 0.01)
    constants = {
        "throttle_feedback": 0.3,
        "brake_feedback": 0.2,
        "steering_feedback": 0.1,
        "throttle_command": 0.5,
        "brake_command": 0.0,
        "steering_command": 0.15,
    }
    streams = dict.fromkeys(REQUIRED_SIGNALS, stream(t, t)) | {k: stream(t, 0 * t + v) for k, v in constants.items()}
    recording = brought_onto_a_grid(streams, 25.0, "topics")
    for column, value in {"r_fb": -0.2, "delta_fb": 0.1, "r_cmd": 0.7, "delta_cmd": 0.05}.items():
        np.testing.assert_allclose(recording[column], value, atol=1e-15)


def test_lookahead_commands_stay_inside_their_segment() -> None:
    t = np.arange(0, 4, 0.01)
    t = t[(t < 1.005) | (t > 2.995)]
    recording = brought_onto_a_grid(dict.fromkeys(REQUIRED_SIGNALS, stream(t, t)), 10.0, "lookahead")
    last = np.flatnonzero(np.append(np.diff(recording.segment), 1))
    assert len(last) == 2
    np.testing.assert_array_equal(recording["delta_cmd"][last], 0.0)
    np.testing.assert_allclose(np.delete(recording["delta_cmd"], last), 0.1, atol=1e-9)


def test_signals_that_never_overlap_are_told_with_their_spans() -> None:
    t = np.arange(0, 1, 0.01)
    streams = dict.fromkeys(REQUIRED_SIGNALS, stream(t, t)) | {"omega": stream(t + 60, t)}
    with pytest.raises(RecordingError, match=r"drive: no instant .* within 0.25 s: v_x 17000\d+\.123\.\..*omega"):
        brought_onto_a_grid(streams, 25.0)


def test_a_lone_sample_covers_its_own_instant_only() -> None:
    lone = stream(np.array([0.5]), np.array([7.0]))
    grid = START + np.array([400_000_000, 500_000_000, 500_000_001])
    values, stretch = sample(lone, grid, 250_000_000)
    assert stretch.tolist() == [-1, 0, -1]
    assert values[1] == 7.0


def test_the_grid_is_laid_inside_the_stretches_of_its_anchor() -> None:
    anchor = np.array([0, 100, 200, 1000, 1100])
    assert uniform_grid(anchor, 30.0, 100).tolist() == [0, 30, 60, 90, 120, 150, 180, 1020, 1050, 1080]
