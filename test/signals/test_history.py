"""The live window: equal to a plain list's, equal to the extractor's, and never cut from bad data."""

from __future__ import annotations

from math import inf, nan

import numpy as np
import pytest
from hypothesis import given, reject, settings
from hypothesis import strategies as st

from dynssm_ros.errors import ConfigurationError, RecordingError
from dynssm_ros.signals.history import History, Refusal
from dynssm_ros.signals.inputs import WINDOW_COLUMNS
from dynssm_ros.signals.recording import RecordingInfo
from dynssm_ros.signals.resampling import Stream, resample
from dynssm_ros.signals.signal_map import SignalMap, load_signal_map

START = 1_700_000_000_123_456_789
SECOND = 1_000_000_000
DEFAULT = load_signal_map("default")
NO_COMMANDS = DEFAULT.with_commands("none")
SIGNALS = ("v_x", "v_y", "omega", "throttle_feedback", "steering_feedback")
MAX_AGE, JUMP_BACK = 0.2, 0.5


def odometry(value: float = 1.0) -> dict[str, float]:
    return {"v_x": value, "v_y": -value, "omega": 2 * value, "x": 0.0, "y": 0.0, "theta": 0.0}


def feedback(value: float = 1.0) -> dict[str, float]:
    return {"throttle_feedback": value, "steering_feedback": -value}


def filled(T_s: float = 0.04, H: int = 5, until: float = 1.0, rate: float = 100.0) -> tuple[History, int]:
    """A history with samples at ``rate`` whose values are the time since the start, and the stamp of the last."""
    history, stamp = History(NO_COMMANDS, T_s, H, max_age=MAX_AGE), START
    for k in range(int(until * rate) + 1):
        stamp = START + round(k * SECOND / rate)
        for values in (feedback((stamp - START) / SECOND), odometry((stamp - START) / SECOND)):
            assert history.add(stamp, values) is None
    return history, stamp


# --- against the extractor ----------------------------------------------------------------------


@settings(deadline=None, max_examples=40)
@given(st.data(), st.sampled_from([0.02, 0.04]), st.integers(0, 2**16))
def test_the_window_is_the_extractors_where_all_samples_are_known(data: st.DataObject, T_s: float, seed: int) -> None:
    random, H = np.random.default_rng(seed), 6
    streams = {}
    for name in SIGNALS:
        longest = data.draw(st.sampled_from([0.01, 0.1, 0.3]))
        gaps = random.uniform(0.001, longest, int(4 / longest))
        stamps = START + np.cumsum(np.round(gaps * SECOND)).astype(np.int64)
        streams[name] = Stream(stamps, random.normal(size=len(stamps)))
    held = ("steering_feedback",)
    info = RecordingInfo(sampling_time=T_s, commands="none", held=held)
    try:
        recording = resample(streams, 1 / T_s, NO_COMMANDS.max_gap, "none", info)
    except RecordingError:  # so many gaps that the streams never overlap
        reject()
    ends = set(recording.window_ends(H, 0).tolist())
    for row in random.choice(len(recording), min(len(recording), 15), replace=False):
        now, history = int(recording.time[row]), History(NO_COMMANDS, T_s, H, max_age=MAX_AGE, held=held)
        for name, stream in streams.items():
            known = np.searchsorted(stream.stamps, now) + 1  # up to the first sample that is not older
            for stamp, value in zip(stream.stamps[:known].tolist(), stream.values[:known].tolist(), strict=True):
                assert history.add(stamp, {name: value}) is None
        window = history.window(now)
        if row in ends:
            assert not isinstance(window, Refusal)
            # the recording's grid is rounded to nanoseconds, the window's is not
            np.testing.assert_allclose(window, recording.matrix[row - H + 1 : row + 1], rtol=0, atol=1e-5)
        else:
            assert window is Refusal.FILLING


@pytest.mark.parametrize("jitter", [0.0, 0.4])
@pytest.mark.parametrize("rate", [25.0, 100.0, 400.0, 2000.0])
def test_any_odometry_rate_gets_a_window_per_message_once_it_is_full(rate: float, jitter: float) -> None:
    T_s, H, random = 0.04, 15, np.random.default_rng(3)
    history, refused, windows = History(NO_COMMANDS, T_s, H, max_age=MAX_AGE), 0, 0
    feedback_due = 0.0
    for k in range(int(2.0 * rate)):
        t = (k + jitter * random.uniform(-1, 1)) / rate
        while feedback_due <= t:  # at 30 Hz, whatever the odometry does
            stamp = START + round(feedback_due * SECOND)
            assert history.add(stamp, feedback((stamp - START) / SECOND)) is None
            feedback_due += 1 / 30
        stamp = START + round(t * SECOND)
        assert history.add(stamp, odometry((stamp - START) / SECOND)) is None
        window = history.window(stamp)
        if isinstance(window, Refusal):
            assert windows == 0, "a window once full must stay so"
            refused += 1
            continue
        windows += 1
        grid = (stamp - START) / SECOND + T_s * np.arange(1 - H, 1)
        np.testing.assert_allclose(window[:, 0], grid, atol=2e-9)
        known = grid <= feedback_due - 1 / 30
        np.testing.assert_allclose(window[known, 3], grid[known], atol=2e-9)
        np.testing.assert_allclose(window[~known, 3], feedback_due - 1 / 30, atol=2e-9)
    assert refused <= (H - 1) * T_s * rate + 2


def test_real_stamps_lose_no_precision() -> None:
    """A float of nanoseconds since 1970 is good to 256 ns only, which at this slope would be 0.26."""
    history, slope = History(NO_COMMANDS, 0.04, 5, max_age=MAX_AGE), 1e6
    for k in range(40):
        stamp = START + k * 10_000_001
        history.add(stamp, feedback(0.0))
        history.add(stamp, {"v_x": slope * k * 0.010000001, "v_y": 0.0, "omega": 0.0})
    window = history.window(stamp)
    assert not isinstance(window, Refusal)
    np.testing.assert_allclose(window[:, 0], slope * (39 * 0.010000001 + 0.04 * np.arange(-4, 1)), rtol=0, atol=1e-4)


def test_a_first_message_without_a_stamp_does_no_harm() -> None:
    history = History(NO_COMMANDS, 0.04, 5, max_age=MAX_AGE)
    history.add(0, odometry(99.0))
    for k in range(40):
        stamp = START + k * 10_000_000
        history.add(stamp, feedback(0.01 * k))
        history.add(stamp, odometry(0.01 * k))
    window = history.window(stamp)
    assert not isinstance(window, Refusal)
    np.testing.assert_allclose(window[:, 0], 0.39 + 0.04 * np.arange(-4, 1), atol=1e-6)


def test_the_window_may_end_before_the_newest_feedback() -> None:
    """Odometry comes out of a filter and is late; the feedback it meets is newer and must not be held."""
    history, last = filled(until=1.0)
    window = history.window(last - 77_000_000)
    assert not isinstance(window, Refusal)
    np.testing.assert_allclose(window[:, 3], 1.0 - 0.077 + 0.04 * np.arange(-4, 1), atol=1e-9)


def test_slow_actuators_are_held_where_the_model_saw_them_held() -> None:
    history = History(NO_COMMANDS, 0.04, 3, max_age=MAX_AGE, held=("steering_feedback",))
    for k in range(41):
        stamp = START + k * 10_000_000
        if k % 10 == 0:
            history.add(stamp, feedback(0.01 * k))
        history.add(stamp, odometry(0.01 * k))
    window = history.window(stamp - 10_000_000)
    assert not isinstance(window, Refusal)
    np.testing.assert_allclose(window[:, 3], [0.31, 0.35, 0.39], atol=1e-9)
    np.testing.assert_allclose(window[:, 4], [-0.3, -0.3, -0.3], atol=1e-9)
    history.resize(0.04, 3)
    again = history.window(stamp - 10_000_000)
    assert not isinstance(again, Refusal)
    np.testing.assert_allclose(again[:, 4], [-0.31, -0.35, -0.39], atol=1e-9)


def test_a_signal_that_is_stamped_late_is_taken_back_to_when_it_was_true() -> None:
    signals = {name: source.model_dump() for name, source in NO_COMMANDS.signals.items()}
    signals["steering_feedback"]["delay"] = 0.02
    history = History(SignalMap(name="own", commands="none", signals=signals), 0.04, 3, max_age=MAX_AGE)
    for k in range(41):
        stamp = START + k * 10_000_000
        assert history.add(stamp, feedback(0.01 * k)) is None
        assert history.add(stamp, odometry(0.01 * k)) is None
    window = history.window(stamp - 20_000_000)
    assert not isinstance(window, Refusal)
    np.testing.assert_allclose(window[:, 3], 0.38 + 0.04 * np.arange(-2, 1), atol=1e-9)
    np.testing.assert_allclose(window[:, 4], -window[:, 3] - 0.02, atol=1e-9)
    assert history.ages(stamp)["steering_feedback"] == pytest.approx(0.02)


def test_signals_of_one_topic_may_come_in_separate_messages() -> None:
    history = History(NO_COMMANDS, 0.04, 5, max_age=MAX_AGE)
    for k in range(40):
        stamp = START + k * 10_000_000
        assert history.add(stamp, {"steering_feedback" if k % 2 else "throttle_feedback": 0.01 * k}) is None
        history.add(stamp, odometry())
    window = history.window(stamp)
    assert not isinstance(window, Refusal)
    grid = 0.39 + 0.04 * np.arange(-4, 1)
    np.testing.assert_allclose(window[:, 4], grid, atol=1e-9)
    np.testing.assert_allclose(window[:, 3], np.minimum(grid, 0.38), atol=1e-9)


def test_commands_and_brakes_are_merged_as_in_the_extractor() -> None:
    history = History(DEFAULT, 0.04, 3, max_age=MAX_AGE)
    for k in range(20):
        stamp = START + k * 10_000_000
        history.add(stamp, feedback(0.3))
        history.add(stamp, {"throttle_command": 0.5, "steering_command": 0.1})
        history.add(stamp, odometry())
    window = history.window(stamp)
    assert not isinstance(window, Refusal)
    expected = {"v_x": 1, "v_y": -1, "omega": 2, "r_fb": 0.3, "delta_fb": -0.3, "r_cmd": 0.2, "delta_cmd": 0.4}
    np.testing.assert_allclose(window, [[expected[column] for column in WINDOW_COLUMNS]] * 3, atol=1e-12)
    assert history.window(stamp) is not window


# --- bad data -----------------------------------------------------------------------------------


def test_a_window_needs_H_rows_of_history_and_no_more() -> None:
    """With samples at the window's own instants it is full at the H-th message."""
    history, H = History(NO_COMMANDS, 0.04, 5, max_age=MAX_AGE), 5
    for k in range(8):
        stamp = START + k * 40_000_000
        history.add(stamp, feedback())
        history.add(stamp, odometry())
        assert isinstance(history.window(stamp), Refusal) == (k < H - 1)


@pytest.mark.parametrize(("gap", "answer"), [(250_000_000, None), (250_000_001, Refusal.FILLING)])
def test_a_gap_longer_than_max_gap_starts_the_window_anew(gap: int, answer: Refusal | None) -> None:
    history, last = filled()
    for values in (feedback(), odometry()):
        assert history.add(last + gap, values) is None
    window = history.window(last + gap)
    assert (window if isinstance(window, Refusal) else None) is answer


def test_after_a_gap_the_window_holds_only_what_came_after_it() -> None:
    history, last = filled(H=5)
    windows = []
    for k in range(20):
        stamp = last + 3 * SECOND + k * 10_000_000
        history.add(stamp, feedback(100.0 + k))
        history.add(stamp, odometry(100.0 + k))
        window = history.window(stamp)
        if not isinstance(window, Refusal):
            windows.append(window.copy())
    assert len(windows) == 4
    assert min(window[:, [0, 3]].min() for window in windows) >= 100.0


@pytest.mark.parametrize(("age", "answer"), [(200_000_000, None), (200_000_001, Refusal.STALE)])
def test_a_signal_older_than_max_age_is_stale(age: int, answer: Refusal | None) -> None:
    history, last = filled()
    for k in range(1, 21):
        history.add(last + k * 10_000_000, odometry())
    history.add(last + age, odometry())
    window = history.window(last + age)
    assert (window if isinstance(window, Refusal) else None) is answer
    assert history.ages(last + age)["throttle_feedback"] == pytest.approx(age / SECOND)


def test_a_signal_that_never_came_is_missing() -> None:
    history = History(DEFAULT, 0.04, 5, max_age=MAX_AGE)
    assert history.window(START) is Refusal.MISSING
    history.add(START, odometry())
    assert history.window(START) is Refusal.MISSING
    assert history.ages(START) == {
        "v_x": 0.0,
        "v_y": 0.0,
        "omega": 0.0,
        "throttle_feedback": inf,
        "steering_feedback": inf,
        "throttle_command": inf,
        "steering_command": inf,
    }


def test_ages_are_known_before_the_first_message() -> None:
    assert set(History(NO_COMMANDS, 0.04, 5).ages(START).values()) == {inf}


@pytest.mark.parametrize("bad", [nan, inf, -inf])
def test_a_sample_that_is_not_finite_is_refused_and_the_next_good_one_taken(bad: float) -> None:
    history, last = filled()
    assert history.add(last + 10_000_000, odometry() | {"v_y": bad}) is Refusal.NOT_FINITE
    history.add(last + 20_000_000, feedback(1.02))
    assert history.add(last + 20_000_000, odometry(1.02)) is None
    window = history.window(last + 20_000_000)
    assert not isinstance(window, Refusal)
    np.testing.assert_allclose(window[:, 1], -(1.02 + 0.04 * np.arange(-4, 1)), atol=1e-9)


@pytest.mark.parametrize("back", [0, 1, 10_000_000, 500_000_000])
def test_a_repeated_or_slightly_older_stamp_is_refused_and_changes_nothing(back: int) -> None:
    history, last = filled()
    before = np.array(history.window(last))
    assert history.add(last - back, odometry(99.0)) is Refusal.REPEATED
    np.testing.assert_array_equal(history.window(last), before)


def test_a_jump_back_in_time_forgets_what_was_before() -> None:
    history, _ = filled()
    assert history.add(START + 99_000_000, feedback(7.0)) is Refusal.OUTLIER
    assert history.add(START + 100_000_000, odometry(7.0)) is Refusal.JUMPED_BACK
    assert history.window(START + 100_000_000) is Refusal.FILLING
    assert history.ages(START + 100_000_000) == pytest.approx(dict.fromkeys(SIGNALS, 0.0), abs=0.001)
    for k in range(1, 20):
        stamp = START + 100_000_000 + k * 10_000_000
        assert history.add(stamp, feedback(7.0)) is None
        assert history.add(stamp, odometry(7.0)) is None
    window = history.window(stamp)
    assert not isinstance(window, Refusal)
    np.testing.assert_array_equal(window[:, 0], 7.0)


def test_a_late_message_from_before_the_jump_delays_recovery_but_does_not_stop_it() -> None:
    history, last = filled()
    history.add(START, odometry(7.0))
    history.add(last + 1, feedback(1.0))  # was still in the queue
    answers = []
    for k in range(1, 40):
        stamp = START + k * 10_000_000
        history.add(stamp, feedback(7.0))
        history.add(stamp, odometry(7.0))
        answers.append(history.window(stamp))
    assert isinstance(answers[0], Refusal)
    assert not isinstance(answers[-1], Refusal)
    np.testing.assert_array_equal(answers[-1][:, [0, 3]], 7.0)


@pytest.mark.parametrize("off", [-3600.0, -1.0, 1.0, 10.0, 3600.0])
@pytest.mark.parametrize("message", ["odometry", "feedback"])
def test_a_single_stamp_far_off_costs_its_message_alone(off: float, message: str) -> None:
    history, last = filled()
    sample = odometry(99.0) if message == "odometry" else feedback(99.0)
    for k in range(1, 40):
        stamp = last + k * 10_000_000
        if k == 5:
            assert history.add(stamp + round(off * SECOND), sample) is Refusal.OUTLIER
        history.add(stamp, feedback(7.0))
        history.add(stamp, odometry(7.0))
        assert not isinstance(history.window(stamp), Refusal)
    window = history.window(stamp)
    assert not isinstance(window, Refusal)
    assert window[:, [0, 3]].max() <= 7.0


def test_a_publisher_on_another_clock_does_not_cost_the_window() -> None:
    """Two publishers share the odometry topic, and one of them counts from the start of its computer."""
    history, last = filled()
    for k in range(1, 40):
        stamp = last + k * 10_000_000
        history.add(stamp, feedback(7.0))
        history.add(stamp, odometry(7.0))
        assert history.add(stamp - START // 2, odometry(99.0)) is Refusal.OUTLIER
        window = history.window(stamp)
        assert not isinstance(window, Refusal)
        assert window[:, 0].max() <= 7.0


def test_every_reason_says_itself_in_words() -> None:
    assert len({refusal.value for refusal in Refusal}) == len(Refusal)
    assert all(" " in refusal.value for refusal in Refusal)


@pytest.mark.parametrize("delay", [-0.1, 1.0, 18.0])
def test_delays_that_only_a_log_can_have_are_refused_live(delay: float) -> None:
    content = DEFAULT.model_dump()
    content["signals"]["steering_feedback"]["delay"] = delay
    with pytest.raises(ConfigurationError, match=r"steering_feedback\.delay: .* live expected at least 0"):
        History(SignalMap.model_validate(content), 0.02, 5)
