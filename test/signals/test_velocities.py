"""Velocities from poses: exact where the motion is quadratic, as noisy as they must be, the same live as the window says."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dynssm_ros.errors import RecordingError
from dynssm_ros.signals import messages
from dynssm_ros.signals.decoding import live_decoders
from dynssm_ros.signals.extraction import extract
from dynssm_ros.signals.signal_map import SignalMap, load_signal_map
from dynssm_ros.signals.velocities import LiveVelocities, body_velocities, velocities_along

START = 1_700_000_000_000_000_000
V_X, V_Y, OMEGA = 3.0, -0.2, 1.5


def pose_map(window: float = 0.1) -> SignalMap:
    """The default topics without their twist."""
    content = load_signal_map("default").model_dump()
    signals = {name: one for name, one in content["signals"].items() if name not in ("v_x", "v_y", "omega")}
    return SignalMap.model_validate(content | {"signals": signals, "velocities": {"window": window}})


def circle(time: np.ndarray) -> np.ndarray:
    """Poses of a car that slides around a circle, its yaw within a turn, shape ``(N, 3)``."""
    theta = OMEGA * time
    x = (V_X * np.sin(theta) + V_Y * (np.cos(theta) - 1)) / OMEGA
    y = (V_X * (1 - np.cos(theta)) + V_Y * np.sin(theta)) / OMEGA
    return np.stack([x, y, (theta + np.pi) % (2 * np.pi) - np.pi], axis=1)


def unwrapped(poses: np.ndarray) -> np.ndarray:
    return np.column_stack([poses[:, :2], np.unwrap(poses[:, 2])])


def drive(seconds: float, jitter: float = 0.0, noise: float = 0.0) -> list[Any]:
    """Records of the circle at 100 Hz, with a twist that says nothing."""
    random, records = np.random.default_rng(2), []
    for k in range(round(seconds * 100)):
        t = (k + jitter * random.uniform(-1, 1)) / 100
        pose = circle(np.array([t]))[0] + noise * random.normal(size=3)
        stamp = START + round(t * 1e9)
        records.append(
            (
                messages.FEEDBACK_TOPIC,
                messages.JOINT_STATE,
                stamp,
                messages.joint_state(stamp, {"throttle": 0.1, "steering": 0.1}),
            )
        )
        records.append(
            (messages.ODOMETRY_TOPIC, messages.ODOMETRY, stamp, messages.odometry(stamp, tuple(pose), (0.0, 0.0, 0.0)))
        )
    return records


@pytest.mark.parametrize("at", [0, 3, 6])
def test_straight_motion_with_constant_acceleration_is_exact_at_any_pose_of_the_window(at: int) -> None:
    t = np.array([0.0, 0.01, 0.03, 0.04, 0.055, 0.06, 0.08])
    poses = np.stack([1 + 2 * t + 3 * t**2, -(t**2), np.full(7, 0.2)], axis=1)
    dx, dy = 2 + 6 * t[at], -2 * t[at]
    expected = [np.cos(0.2) * dx + np.sin(0.2) * dy, np.cos(0.2) * dy - np.sin(0.2) * dx, 0.0]
    np.testing.assert_allclose(body_velocities(t[None], poses[None], at)[0], expected, rtol=0, atol=1e-10)


@pytest.mark.parametrize("jitter", [0.0, 0.3])
def test_a_circle_gives_its_speeds_across_the_turn_of_the_yaw(jitter: float) -> None:
    time = (np.arange(1000) + jitter * np.random.default_rng(1).uniform(-1, 1, 1000)) / 100
    rows, found = velocities_along(time, unwrapped(circle(time)), 0.1)
    assert rows.tolist() == [*range(5, 995)]
    np.testing.assert_allclose(found, np.tile([V_X, V_Y, OMEGA], (len(rows), 1)), atol=2e-4)


def test_a_gap_costs_the_windows_across_it_alone() -> None:
    time = np.concatenate([np.arange(50), np.arange(80, 130)]) / 100
    rows, _ = velocities_along(time, unwrapped(circle(time)), 0.1)
    assert rows.tolist() == [*range(5, 45), *range(55, 95)]
    assert len(velocities_along(time[:10], unwrapped(circle(time[:10])), 0.1)[0]) == 0


def test_live_the_noise_is_four_times_that_of_a_log() -> None:
    random, time = np.random.default_rng(0), np.arange(4000) / 100
    poses = unwrapped(circle(time)) + random.normal(scale=1e-3, size=(4000, 3))
    live, found = LiveVelocities(0.2), []
    for t, pose in zip(time, poses, strict=True):
        found.append(live.add(START + round(t * 1e9), dict(zip(("x", "y", "theta"), pose.tolist(), strict=True))))
    assert found[:3] == [{}] * 3
    late = np.array([[one["v_x"], one["v_y"], one["omega"]] for one in found[50:]]) - [V_X, V_Y, OMEGA]
    around = velocities_along(time, poses, 0.2)[1] - [V_X, V_Y, OMEGA]
    np.testing.assert_allclose(late.std(axis=0) / around.std(axis=0), 4.0, rtol=0.25)
    assert np.abs(late.mean(axis=0)).max() < 0.005


def test_live_a_pose_that_is_not_newer_or_comes_after_a_gap_begins_anew() -> None:
    live, pose = LiveVelocities(0.1), {"x": 0.0, "y": 0.0, "theta": 0.0}
    assert [bool(live.add(START + k * 10_000_000, pose)) for k in range(6)] == [False] * 3 + [True] * 3
    assert live.add(START, pose) == {}
    assert [bool(live.add(START + k * 10_000_000, pose)) for k in range(1, 5)] == [False] * 2 + [True] * 2
    assert live.add(START + 1_000_000_000, pose) == {}
    assert live.add(START + 1_010_000_000, pose | {"x": float("nan")}) == {}
    assert live.add(START + 1_010_000_000, {}) == {}


def test_a_log_of_poses_is_extracted_with_velocities(make_bag: Any) -> None:
    recording = extract([make_bag(drive(4.0, jitter=0.2))], pose_map().with_commands("none"), 50.0)
    state = np.stack([recording[name] for name in ("v_x", "v_y", "omega")], axis=1)
    np.testing.assert_allclose(state, np.tile([V_X, V_Y, OMEGA], (len(recording), 1)), atol=5e-4)
    assert recording.info.notes == ("v_x, v_y, omega: from poses, over 0.1 s",)
    with pytest.raises(RecordingError, match="7 poses; expected more"):
        extract([make_bag(drive(0.07), "short")], pose_map().with_commands("none"), 50.0)


def test_live_messages_get_the_velocities_of_the_poses_so_far() -> None:
    decoder = live_decoders(pose_map())[messages.ODOMETRY_TOPIC]
    records = [one[3] for one in drive(1.0) if one[0] == messages.ODOMETRY_TOPIC]
    found = [decoder.decode(message) for message in records]
    assert "v_x" not in found[2]
    assert [found[-1][name] for name in ("v_x", "v_y", "omega")] == pytest.approx([V_X, V_Y, OMEGA], abs=1e-4)
    assert found[-1]["x"] == records[-1].pose.pose.position.x


def test_the_real_car_gives_the_velocities_that_its_laboratory_derived(data: Path) -> None:
    bag, window = data / "dart" / "free_driving_1002", 0.2
    own = extract([bag], pose_map(window).with_commands("none"), 50.0)
    derived = extract([bag], load_signal_map("default").with_commands("none"), 50.0)
    for name, most in (("v_x", 0.02), ("v_y", 0.02), ("omega", 0.06)):
        one = np.interp(derived.time[100:-100] - derived.time[0], own.time - derived.time[0], own[name])
        assert np.sqrt(np.mean((one - derived[name][100:-100]) ** 2)) < most, name
