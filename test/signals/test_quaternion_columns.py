"""Yaw of a quaternion in four columns of a table: what a map says, what inspect suggests, what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

from dynssm_ros.errors import RecordingError
from dynssm_ros.signals.extraction import extract
from dynssm_ros.signals.inspection import inspect
from dynssm_ros.signals.signal_map import SignalMap, Source

T = np.arange(0.0, 10.0, 0.02)
YAW = 0.5 * T


def table(path: Path, pattern: str = "q{}", length: float = 1.0) -> Path:
    """A car on a circle of 4 m at 2 m/s."""
    pose = [4 * np.sin(YAW), 4 - 4 * np.cos(YAW)]
    zero = np.zeros(len(T))
    quaternion = [zero, zero, length * np.sin(YAW / 2), length * np.cos(YAW / 2)]
    columns = np.stack([T, *pose, *quaternion, 0.1 * np.sin(T), 0.2 + 0.1 * np.cos(T)], axis=1)
    names = ["time", "x", "y", *(pattern.format(axis) for axis in "xyzw"), "steering", "throttle"]
    np.savetxt(path, columns, delimiter=",", header=",".join(names), comments="", fmt="%.9f")
    return path


@pytest.mark.parametrize("pattern", ["q{}", "orientation.{}", "pose.orientation.{}", "/odom/quat_{}", "car_q{}"])
def test_inspect_suggests_the_yaw_of_four_columns_and_the_map_extracts(tmp_path: Path, pattern: str) -> None:
    path = table(tmp_path / "log.csv", pattern)
    found = inspect(path)
    assert found.missing == ()
    names = ", ".join(pattern.format(axis) for axis in "xyzw")
    mapped = SignalMap.model_validate(yaml.safe_load(found.signal_map()))
    assert mapped.signals["theta"].column == f"yaw({names})"
    recording = extract([path], mapped, 50.0)
    np.testing.assert_allclose(np.diff(recording["theta"]), 0.01, atol=1e-6)  # unwrapped across the turns
    np.testing.assert_allclose(recording["v_x"], 2.0, atol=1e-3)


def test_a_quaternion_whose_length_is_not_1_is_no_orientation(tmp_path: Path) -> None:
    path = table(tmp_path / "log.csv")
    mapped = SignalMap.model_validate(yaml.safe_load(inspect(path).signal_map()))
    short = table(tmp_path / "short.csv", length=0.5)
    assert "theta" not in inspect(short).signals
    with pytest.raises(RecordingError, match="theta: no good sample, needed for velocities from poses"):
        extract([short], mapped, 50.0)


def test_other_headings_are_one_column() -> None:
    assert Source(column="yaw(a, b, c, d)").columns == ("a", "b", "c", "d")
    assert Source(column="yaw (deg)").columns == ("yaw (deg)",)
    assert Source(column="yaw(a, b)").columns == ("yaw(a, b)",)
