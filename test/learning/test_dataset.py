"""TrainingWindows and their split: nothing leaks, nothing crosses a gap, and scales are of the training data."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dynssm_ros.errors import RecordingError
from dynssm_ros.learning.dataset import TrainingWindows, normalisation, split_ends, split_windows
from dynssm_ros.learning.models.base import ModelConfig, TrainingConfig
from dynssm_ros.signals.inputs import WINDOW_COLUMNS
from dynssm_ros.signals.recording import Recording, RecordingInfo

T_s = 0.04


def counting(N: int, segments: list[int], slow: list[int] = ()) -> Recording:  # type: ignore[assignment]
    """A recording whose columns count rows, with segments that begin at the given rows and slow single rows."""
    segment = np.zeros(N, np.int32)
    segment[[k for k in segments if k < N]] = 1
    columns = {name: np.arange(N) + 1000.0 * k for k, name in enumerate(WINDOW_COLUMNS)}
    columns["v_x"] = np.where(np.isin(np.arange(N), slow), 1.0, 10.0 + np.arange(N))
    info = RecordingInfo(sampling_time=T_s, commands="none", source=("counting",))
    return Recording(info, (np.arange(N) * T_s * 1e9).astype(np.int64), np.cumsum(segment, dtype=np.int32), columns)


def training(**changes: float | str) -> TrainingConfig:
    fields = {"epochs": 1, "batch_size": 1, "learning_rate": 0.1, "patience": 1}
    return TrainingConfig.model_validate(fields | {"validation_block": 20 * T_s, "validation_every": 3} | changes)


def rows(windows: TrainingWindows) -> set[int]:
    """All rows that these windows and their targets touch."""
    return {int(end) + k for end in windows.ends for k in range(1 - windows.H, 2)}


@given(
    N=st.integers(130, 400),
    H=st.integers(1, 12),
    block=st.integers(15, 40),
    every=st.integers(2, 5),
    segments=st.lists(st.integers(1, 399), max_size=5),
    slow=st.lists(st.integers(0, 399), max_size=5),
)
@settings(max_examples=80)
def test_no_row_serves_both_and_no_window_crosses_a_gap_or_a_slow_stretch(
    N: int, H: int, block: int, every: int, segments: list[int], slow: list[int]
) -> None:
    recording = counting(N, segments, slow)
    try:
        both = split_windows(recording, H, training(validation_block=block * T_s, validation_every=every), 5.0, 1)
    except RecordingError:
        return
    assert not rows(both[0]) & rows(both[1])
    for windows in both:
        for end in windows.ends.tolist():
            touched = np.arange(end - H + 1, end + 2)
            assert len(set(recording.segment[touched])) == 1
            assert (recording["v_x"][touched] >= 5.0).all()


@given(seed=st.integers(0, 1000), every=st.integers(2, 8), segments=st.lists(st.integers(1, 399), max_size=3))
@settings(max_examples=30)
def test_a_random_split_has_every_window_once_and_is_the_same_for_windows_of_any_length(
    seed: int, every: int, segments: list[int]
) -> None:
    recording, how = counting(400, segments), training(validation="random", validation_every=every, seed=seed)
    (train, held), (longer_train, longer_held) = (split_windows(recording, H, how, 5.0, 1) for H in (3, 4))
    assert sorted([*train.ends.tolist(), *held.ends.tolist()]) == recording.window_ends(3, min_speed=5.0).tolist()
    assert set(longer_train.ends.tolist()) <= set(train.ends.tolist())
    assert set(longer_held.ends.tolist()) <= set(held.ends.tolist())
    assert torch.equal(split_windows(recording, 3, how, 5.0, 1)[1].ends, held.ends)


def test_a_random_split_holds_out_one_window_in_n_as_the_seed_says() -> None:
    recording = counting(5000, [])
    by_seed = [
        split_windows(recording, 5, training(validation="random", validation_every=5, seed=seed), 5.0, 1)[
            1
        ].ends.tolist()
        for seed in (0, 1)
    ]
    for held in by_seed:
        assert len(held) == pytest.approx(1000, abs=4 * np.sqrt(5000 * 0.2 * 0.8))
    assert len(set(by_seed[0]) & set(by_seed[1])) == pytest.approx(200, abs=60)


def test_without_gaps_only_windows_on_a_border_are_lost() -> None:
    H, recording = 5, counting(300, [])
    train, validation = split_windows(recording, H, training(validation_block=20 * T_s, validation_every=3), 5.0, 1)
    # 15 blocks of 20 rows: 5 for validation, 5 stretches of 40 for training, each good for rows - H windows
    assert len(train) == 5 * (40 - H)
    assert len(validation) == 5 * (20 - H)


def test_a_batch_is_windows_in_order_with_the_increment_that_follows() -> None:
    recording = counting(100, [])
    train, _ = split_windows(recording, 4, training(), 5.0, 1)
    window, increment = train.batch(torch.tensor([0, 3]))
    assert window.shape == (2, 4, 7)
    np.testing.assert_array_equal(window[0].numpy(), recording.matrix[0:4])
    np.testing.assert_array_equal(window[1].numpy(), recording.matrix[3:7])
    np.testing.assert_array_equal(increment.numpy(), np.ones((2, 3)))


def test_scales_are_those_of_the_training_windows(laps: Recording, make_config: Callable[..., ModelConfig]) -> None:
    config = make_config()
    ends, _ = split_ends(laps, config.rows(0.02), config.training, 0.0, config.training.batch_size)
    found = normalisation(laps, ends)
    now = laps.matrix[ends]
    target = laps.matrix[ends + 1, :3]
    np.testing.assert_allclose(found.input_mean, now.mean(axis=0))
    np.testing.assert_allclose(found.input_std, now.std(axis=0))
    np.testing.assert_allclose(found.state_scale, target.std(axis=0))
    np.testing.assert_allclose(found.increment_scale, (target - now[:, :3]).std(axis=0))


def test_a_constant_input_is_not_scaled(laps: Recording, make_config: Callable[..., ModelConfig]) -> None:
    quiet = laps.with_commands("none")
    config = make_config()
    ends, _ = split_ends(quiet, config.rows(0.02), config.training, 0.0, config.training.batch_size)
    found = normalisation(quiet, ends)
    assert found.input_std[5:] == (1.0, 1.0)
    assert found.input_mean[5:] == (0.0, 0.0)


def test_a_state_that_never_changes_is_refused_by_name(laps: Recording) -> None:
    columns = {**laps.columns, "omega": np.zeros(len(laps))}
    straight = Recording(laps.info, laps.time, laps.segment, columns)
    with pytest.raises(RecordingError, match="drive 0: omega never changes; expected a car that drives corners"):
        normalisation(straight, straight.window_ends(4))


@pytest.mark.parametrize(
    ("N", "changes", "expected"),
    [
        (3, {}, r"0 training and 0 validation windows of 4 rows at 5 m/s or more"),
        (30, {}, r"16 training and 6 validation windows .*; expected at least 100 and 1"),
        (300, {"slowest": 1e6}, "0 training and 0 validation windows of 4 rows at 1e\\+06 m/s or more"),
        (300, {"validation_block": 1e6}, "0 validation windows"),
    ],
)
def test_too_little_driving_is_refused_with_what_was_found(N: int, changes: dict[str, float], expected: str) -> None:
    changes = dict(changes)
    slowest = changes.pop("slowest", 5.0)
    with pytest.raises(RecordingError, match=expected):
        split_windows(counting(N, []), 4, training(validation_every=2, **changes), slowest, 100)
