"""Bags with the standard topics: what a recording becomes is what it is extracted from."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dynssm_ros.signals.bags import open_bag
from dynssm_ros.signals.extraction import extract
from dynssm_ros.signals.inputs import WINDOW_COLUMNS
from dynssm_ros.signals.messages import COMMAND_TOPIC, FEEDBACK_TOPIC, ODOMETRY_TOPIC
from dynssm_ros.signals.recording import Recording, RecordingInfo
from dynssm_ros.signals.signal_map import Commands, load_signal_map
from dynssm_ros.signals.standard import recording_to_bag


def recording(commands: Commands, pose: bool) -> Recording:
    random, n = np.random.default_rng(4), 60
    segment = np.repeat([0, 1], 30).astype(np.int32)
    time = 1_700_000_000_000_000_007 + 40_000_000 * np.arange(n) + 10**9 * segment.astype(np.int64)
    columns = {name: random.normal(size=n) for name in WINDOW_COLUMNS}
    columns |= {name: 0.1 * random.normal(size=n) for name in ("x", "y", "theta")} if pose else {}
    return Recording(RecordingInfo(sampling_time=0.04, commands=commands), time, segment, columns)


@pytest.mark.parametrize("pose", [True, False])
def test_a_recording_survives_being_a_bag(tmp_path: Path, pose: bool) -> None:
    original = recording("topics", pose)
    recording_to_bag(original, tmp_path / "bag")
    again = extract([tmp_path / "bag"], load_signal_map("default"), 25.0)
    np.testing.assert_array_equal(again.time, original.time)
    np.testing.assert_array_equal(again.segment, original.segment)
    np.testing.assert_allclose(again.matrix, original.matrix, atol=1e-12)
    for name in ("x", "y", "theta"):
        np.testing.assert_allclose(again[name], original[name] if pose else 0.0, atol=1e-12)


@pytest.mark.parametrize("commands", ["lookahead", "none"])
def test_commands_that_nobody_sent_are_not_in_the_bag(tmp_path: Path, commands: Commands) -> None:
    recording_to_bag(recording(commands, pose=True), tmp_path / "bag")
    with open_bag(tmp_path / "bag") as bag:
        assert set(bag.types) == {FEEDBACK_TOPIC, ODOMETRY_TOPIC}


def test_actuators_come_before_the_odometry_that_they_belong_to(tmp_path: Path) -> None:
    recording_to_bag(recording("topics", pose=True), tmp_path / "bag")
    with open_bag(tmp_path / "bag") as bag:
        topics = [message.topic for message in bag.messages(list(bag.types))]
    assert topics == [FEEDBACK_TOPIC, COMMAND_TOPIC, ODOMETRY_TOPIC] * 60
