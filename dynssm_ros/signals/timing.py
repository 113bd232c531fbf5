"""Which signals come at another time than the others: each input against the response that it must cause, poses against
velocities.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.signals.findings import Finding, number
from dynssm_ros.signals.lags import LONGEST_LAG_S, Lag, lag_of
from dynssm_ros.signals.motion import Checked, is_turning
from dynssm_ros.signals.spans import Drive, Signal, varies

_EXPECTED_S = (-0.2, 0.5)
"""Lags of a response that cars and their sensors have: smoothing looks 0.1 s ahead, actuators and filters take 0.3 s."""
_POSE_EXPECTED_S = (-0.4, 0.4)
"""Likewise of poses behind velocities: filters of either are up to 0.3 s late."""
_POSE_EXPECTED = f"within {_POSE_EXPECTED_S[1]:g} s"
_WIDEST_S = 1.0
"""Widest interval of a lag that is told: wider ones belong to drives that repeat or hardly change."""
_CLEARLY, _EXPLAINED = 0.5, 0.4
"""Of what is unexplained at an expected lag that may be left at the best; share that the best must explain."""
_FARTHEST_S = 40.0
"""Longest lag that is tried where no expected one explains anything: GPS time is 18 s, and TAI 37 s, off UTC."""
_RATE_S = 0.3
"""Over which accelerations, path speeds and rates of the heading are measured (s)."""
_TOGETHER_S = 0.4
"""Lags that differ by less are one."""


def is_known(lag: Lag | None) -> bool:
    """Whether a lag is determined by the drive."""
    return lag is not None and lag.high - lag.low <= _WIDEST_S and lag.share > _EXPLAINED


def is_off(lag: Lag | None, expected: tuple[float, float]) -> bool:
    """Whether a lag is none that is expected, and explains clearly more than those do."""
    return (
        lag is not None
        and is_known(lag)
        and (lag.high < expected[0] or lag.low > expected[1])
        and 1.0 - lag.share < _CLEARLY * (1.0 - max(lag.near, 0.0))
    )


def steering_lag(drive: Drive, longest: float = LONGEST_LAG_S) -> Lag | None:
    """Of the yaw rate behind the steering, up to the ``longest`` one (s)."""
    if not is_turning(drive) or not varies(drive.steering):
        return None
    speed = np.where(drive.speed >= drive.least_speed, drive.velocity.real, np.nan)
    square = (drive.speed / np.maximum(drive.speed.max(), 1e-9)) ** 2
    factors = np.nan_to_num(np.stack([speed, speed * square], axis=1))
    signal = np.stack([drive.steering, drive.steering], axis=1)
    known = np.nan_to_num(np.stack([np.ones(len(drive)), speed], axis=1))
    response = np.where(np.isfinite(speed), drive.omega, np.nan)
    return lag_of(drive, response, signal, known, factors=factors, expected=_EXPECTED_S, longest=longest)


def throttle_lag(drive: Drive, longest: float = LONGEST_LAG_S) -> Lag | None:
    """Of the acceleration behind the throttle, likewise."""
    response = acceleration(drive)
    if not varies(drive.throttle) or not np.isfinite(response).any():
        return None
    v_x = drive.velocity.real / max(float(drive.speed.max()), 1e-9)
    ones = np.ones(len(drive))
    signal = np.stack([drive.throttle, np.minimum(drive.throttle, 0.0)], axis=1)
    known = np.stack([ones, v_x, v_x**2], axis=1)
    factors = np.stack([ones, ones], axis=1)
    return lag_of(drive, response, signal, known, factors=factors, expected=_EXPECTED_S, longest=longest)


def pose_lag(drive: Drive) -> Lag | None:
    """Of the poses behind the velocities: by the heading's rate, or else by the path's speed."""
    assert drive.position is not None
    assert drive.theta is not None
    rows = max(1, round(_RATE_S / drive.T_s / 2))
    moved = np.abs(_difference(drive, drive.position, rows))
    ones = np.ones((len(drive), 1))
    for response, signal in ((_difference(drive, drive.theta, rows), drive.omega), (moved, drive.speed)):
        if varies(signal) and np.isfinite(response).any():
            smooth = _smoothed(signal, rows)[:, None]
            lag = lag_of(drive, response, smooth, ones, factors=ones, expected=_POSE_EXPECTED_S)
            if is_known(lag):
                return lag
    return None


def acceleration(drive: Drive) -> Vector:
    """Longitudinal acceleration by central differences, and NaN where the car stands or a segment ends (m/s^2), ``(N,)``."""
    return np.asarray(_difference(drive, drive.velocity.real, max(1, round(_RATE_S / drive.T_s / 2))))


def _difference(drive: Drive, values: Any, half: int) -> Any:
    """Rate of change over ``2 half`` rows; NaN where the car stands or a segment ends, ``(N,)``."""
    found = np.full(len(drive), np.nan, dtype=values.dtype)
    if len(drive) > 2 * half:
        inner = (values[2 * half :] - values[: -2 * half]) / (2 * half * drive.T_s)
        inside = drive.segment[2 * half :] == drive.segment[: -2 * half]
        moving = drive.speed[half:-half] >= drive.least_speed
        found[half:-half] = np.where(inside & moving, inner, np.nan)
    return found


def _smoothed(values: Vector, half: int) -> Vector:
    """Mean over ``2 half`` rows around each, by trapezoids, as a difference of an integral is; ends as they are, ``(N,)``."""
    total = np.concatenate([[0.0], np.cumsum((values[1:] + values[:-1]) / 2)])
    found = values.astype(np.float64).copy()
    if len(values) > 2 * half:
        found[half:-half] = (total[2 * half :] - total[: -2 * half]) / (2 * half)
    return found


def check_times(drive: Drive) -> Checked:
    """Steering against yaw rate, throttle against acceleration, poses against velocities: the lag of each.

    The drive comes back with lags that are well known taken off, also those that cars have.
    """
    lags: dict[Signal, Lag | None] = {"steering": steering_lag(drive), "throttle": throttle_lag(drive)}
    if (far := _far_lag(drive, lags["steering"])) is not None:
        lags = {"steering": far, "throttle": throttle_lag(drive, _FARTHEST_S)}
    off = [name for name, lag in lags.items() if is_off(lag, _EXPECTED_S)]
    pose = pose_lag(drive) if drive.position is not None else None
    found: list[Finding] = []
    if pose is not None and is_off(pose, _POSE_EXPECTED_S):
        opposed = [
            lag for name, lag in lags.items() if name in off and lag and abs(lag.value + pose.value) < _TOGETHER_S
        ]
        if opposed:  # inputs and poses agree
            found.append(_twist_finding(pose))
            rows = round(pose.value / drive.T_s)
            return found, drive.earlier(rows, "position", "theta", "steering", "throttle")
        found.append(_pose_finding(pose))
        drive = drive.earlier(round(pose.value / drive.T_s), "position", "theta")
    found += _input_findings([(name, lag) for name, lag in lags.items() if name in off and lag is not None])
    for name, lag in lags.items():
        if lag is not None and is_known(lag) and not lag.low < 0.0 < lag.high:
            drive = drive.earlier(-round(lag.value / drive.T_s), name)
    return found, drive


def _far_lag(drive: Drive, lag: Lag | None) -> Lag | None:
    """A lag of the steering that is farther than the usual ones, if it alone explains the yaw rate."""
    if lag is None or lag.near > _EXPLAINED:
        return None
    far = steering_lag(drive, _FARTHEST_S)
    if far is None or not is_off(far, _EXPECTED_S) or abs(far.value) < LONGEST_LAG_S:
        return None
    explains = not is_off(lag, _EXPECTED_S) or 1.0 - far.share < _CLEARLY * (1.0 - lag.share)
    return far if explains else None


_INPUTS = {"steering": ("delta_fb", "omega"), "throttle": ("r_fb", "acceleration")}


def _input_findings(off: Sequence[tuple[str, Lag]]) -> list[Finding]:
    """Inputs at another time than their responses; one finding where both are off by the same."""
    found = []
    for name, lag in off:
        cause, response = _INPUTS[name]
        told = (
            f"{cause} and {response} go together best when {cause} is moved {number(abs(lag.value))} s {_way(lag.value)}"
            f" (explained {number(lag.share)}, {number(max(lag.near, 0.0))} as recorded)"
        )
        signal = f"{name}_feedback"
        remedy = f"{signal}: delay: {number(-lag.value)}, or correct its stamps"
        found.append(
            _lag_finding(f"{name}_time", told, lag, f"{_EXPECTED_S[0]:g} to {_EXPECTED_S[1]:g} s", remedy)
        )  # fmt: skip
    if len(off) == 2 and abs(off[0][1].value - off[1][1].value) < _TOGETHER_S:
        words = "; throttle likewise: the clocks of inputs and odometry are apart"
        return [found[0].model_copy(update={"what": "inputs_time", "told": found[0].told + words})]
    return found


def _way(lag: float) -> str:
    return "earlier" if lag < 0 else "later"


def _twist_finding(pose: Lag) -> Finding:
    told = f"poses and inputs go together best when v_x, v_y, omega are moved {number(abs(pose.value))} s {_way(pose.value)}"
    return _lag_finding("twist_time", told, pose, _POSE_EXPECTED, "correct the stamps of v_x, v_y, omega")


def _pose_finding(pose: Lag) -> Finding:
    told = f"poses and velocities go together best when the poses are moved {number(abs(pose.value))} s {_way(-pose.value)}"
    return _lag_finding("pose_time", told, pose, _POSE_EXPECTED, "correct the stamps of x, y, theta")


def _lag_finding(what: str, told: str, lag: Lag, expected: str, remedy: str) -> Finding:
    return Finding(
        what=what, told=told, size=lag.value, low=lag.low, high=lag.high, unit="s", expected=expected, remedy=remedy
    )
