"""Velocities from poses, for cars that are seen from outside: motion capture, particle filters.

To the poses of a short window a motion is fitted whose yaw rate and velocities, in the frame of the car, change linearly.
In a log the window lies around each pose. Live it ends at the newest one. Neither has a delay where accelerations are
constant; live the noise is four times as large.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from dynssm_ros.arrays import Indices, Vector
from dynssm_ros.signals.signal_map import POSE_SIGNALS, STATE_SIGNALS

_LEAST = 4  # poses in a window: three make a quadratic, one more smooths it
_STRETCHED = 1.5  # how much longer than wanted a window may be where poses come irregularly
_CHUNK = 50_000  # rows at once


def body_velocities(time: Vector, poses: Vector, at: int) -> Vector:
    """``v_x, v_y, omega`` (m/s, m/s, rad/s) at the pose numbered ``at`` of each window, ``(N, 3)``.

    With the yaw ``theta(t)``, a quadratic, the position as a complex number is ``p_0`` plus the integral of ``exp(i
    theta) (v_0 + t dv)``, which is linear in ``p_0``, ``v_0 = v_x + i v_y`` and ``dv``.

    ``time`` is that of the poses of each window (s), ``(N, n)``; ``poses`` have theta unwrapped (m, m, rad), ``(N, n,
    3)``.
    """
    t = time - time[:, [at]]
    span = np.abs(t).max(axis=1, keepdims=True)
    t = t / span
    powers = np.stack([np.ones_like(t), t, t**2], axis=2)
    yaw = _fitted(powers, poses[..., 2] - poses[:, [at], 2])
    turned = np.exp(1j * (powers @ yaw[..., None])[..., 0])
    position = (poses[..., 0] + 1j * poses[..., 1]) * np.exp(-1j * poses[:, [at], 2])
    basis = np.stack([np.ones_like(turned), _integral(turned, t), _integral(turned * t, t)], axis=2)
    velocity = _fitted(basis, position - position[:, [at]])[:, 1]
    return np.asarray(np.stack([velocity.real, velocity.imag, yaw[:, 1]], axis=1) / span)


def _fitted(A: Any, b: Any) -> Any:
    """Least squares of ``A x = b`` for each window: ``(N, n, k)`` and ``(N, n)`` to ``(N, k)``."""
    transposed = A.conj().swapaxes(1, 2)
    return np.linalg.solve(transposed @ A, transposed @ b[..., None])[..., 0]


def _integral(values: Any, t: Vector) -> Any:
    """Cumulative integral from the first sample on, by trapezoids, shape ``(N, n)``."""
    steps = (values[:, 1:] + values[:, :-1]) / 2 * np.diff(t, axis=1)
    return np.concatenate([np.zeros_like(steps[:, :1]), np.cumsum(steps, axis=1)], axis=1)


def velocities_along(time: Vector, poses: Vector, window: float) -> tuple[Indices, Vector]:
    """Numbers of all poses that have a whole window around them, ``(M,)``, and ``v_x, v_y, omega`` there, ``(M,
    3)``.

    ``time`` is strictly increasing (s), ``(N,)``; ``poses`` have theta unwrapped, ``(N, 3)``; ``window`` is a length
    (s).
    """
    period = float(np.median(np.diff(time))) if len(time) > 1 else window
    half = max(_LEAST // 2, round(window / period / 2))
    if len(time) <= 2 * half:
        return np.empty(0, np.intp), np.empty((0, 3))
    times = sliding_window_view(time, 2 * half + 1)
    seen = sliding_window_view(poses, 2 * half + 1, axis=0).swapaxes(1, 2)
    whole = np.flatnonzero(times[:, -1] - times[:, 0] <= _STRETCHED * 2 * half * period)
    found = [
        body_velocities(times[rows], seen[rows], half) for rows in np.split(whole, range(_CHUNK, len(whole), _CHUNK))
    ]
    return whole + half, np.concatenate(found)


class LiveVelocities:
    """Velocities at the newest pose, by a ``window`` of poses (s)."""

    def __init__(self, window: float) -> None:
        self._window = window
        self._poses: deque[tuple[int, tuple[float, float, float]]] = deque()

    def add(self, stamp: int, values: dict[str, float]) -> dict[str, float]:
        """``v_x``, ``v_y`` and ``omega`` at the pose in ``values``, stamped ``stamp`` (ns); nothing until there are
        poses enough.

        A stamp that is not newer than the last begins anew.
        """
        pose = tuple(values.get(name, math.nan) for name in POSE_SIGNALS)
        if not all(map(math.isfinite, pose)):
            return {}
        x, y, theta = pose
        poses, longest = self._poses, round(self._window * 1e9)
        if poses:
            last, (_, _, before) = poses[-1]
            if not 0 < stamp - last <= _STRETCHED * longest:
                poses.clear()
            theta = before + (theta - before + math.pi) % (2.0 * math.pi) - math.pi
        poses.append((stamp, (x, y, theta)))
        while stamp - poses[0][0] > longest and len(poses) > _LEAST:
            poses.popleft()
        if len(poses) < _LEAST:
            return {}
        time = np.array([(one - stamp) / 1e9 for one, _ in poses])
        found = body_velocities(time[None], np.array([one for _, one in poses])[None], len(poses) - 1)[0]
        return dict(zip(STATE_SIGNALS, found.tolist(), strict=True))
