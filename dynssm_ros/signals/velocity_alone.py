"""What velocities tell of themselves where no position moves: their direction in the car, accelerations that no car has."""

from __future__ import annotations

import math

import numpy as np

from dynssm_ros.signals.actuation import steering_sign
from dynssm_ros.signals.findings import Finding, number
from dynssm_ros.signals.motion import (
    AHEAD_RAD,
    ALIGNED,
    TURN_S,
    Checked,
    directions,
    is_one,
    is_turning,
    magnitude,
    ratio_of,
    turned_remedy,
)
from dynssm_ros.signals.signal_map import UNITS
from dynssm_ros.signals.spans import Drive

_SPAN_S = 0.4
"""Over which accelerations are measured (s)."""
_HALF = 0.5
"""Of the yaw rate, by which a velocity in the map's frame may turn more or less."""
_MOST_M_S2 = 60.0
"""Acceleration that no car on wheels has; healthy logs have up to 12."""


def check_axis(drive: Drive) -> Checked:
    """Direction of the velocity in the car's frame, where no position tells that of the path: ahead, and not turning."""
    driving = drive.speed >= drive.least_speed
    if float(np.mean(drive.velocity.real[driving] > 0)) < 0.1:
        if steering_sign(drive)[0] > 0:  # it does drive backwards
            return [], drive
        return [_backwards(drive)], drive.changed(velocity=-drive.velocity.conj())
    spans = drive.spans(TURN_S)
    turned = np.concatenate([[0.0], np.cumsum(np.angle(drive.velocity[1:] * drive.velocity[:-1].conj()))])
    fit = ratio_of(spans.change(turned), spans.integral(drive.omega), spans) if is_turning(drive) else None
    if fit is not None and is_one(magnitude(fit), _HALF):
        ratio, (low, high) = float(fit.values[0]), fit.interval()
        found = Finding(
            what="twist_in_map_frame", told=f"the direction of v_x, v_y turns with omega, by {number(ratio)} of it",
            size=ratio, low=low, high=high, expected="0: x forward, y left, in the frame of the car",
            remedy="turn v_x, v_y by -theta in the odometry, or give `velocities:` with the pose",
        )  # fmt: skip
        return [found], drive.changed(velocity=drive.speed + 0j)
    direction = directions(drive.velocity[driving])
    mean = complex(direction.mean())
    angle = float(np.angle(mean))
    if abs(mean) < 1.0 - ALIGNED or not AHEAD_RAD < abs(angle) < math.pi - AHEAD_RAD:
        return [], drive
    found = Finding(
        what="twist_turned", told=f"v_x, v_y point {number(angle)} rad beside the car's axis", size=-angle,
        low=-angle - (1 - abs(mean)), high=-angle + (1 - abs(mean)), unit="rad", expected="0: x forward, y left",
        remedy=turned_remedy(-angle),
    )  # fmt: skip
    return [found], drive.changed(velocity=drive.velocity * np.exp(-1j * angle))


def _backwards(drive: Drive) -> Finding:
    share = float(np.mean(drive.velocity.real[drive.speed >= drive.least_speed] < 0))
    return Finding(
        what="v_x_sign", told=f"v_x is negative in {100 * share:.0f} % of the drive", size=share, low=share, high=share,
        expected="a car that drives forwards", remedy="v_x: scale: -1",
    )  # fmt: skip


def check_ranges(drive: Drive) -> Checked:
    """Accelerations that no car has, where no position tells the scale of v_x or omega."""
    spans = drive.spans(_SPAN_S)
    if len(spans) < 2:
        return [], drive
    ahead, across = (
        float(np.percentile(np.abs(each), 95))
        for each in (spans.change(drive.velocity.real) / spans.seconds, spans.mean(drive.velocity.real * drive.omega))
    )
    if max(ahead, across) <= _MOST_M_S2:
        return [], drive
    told = f"v_x changes by up to {number(ahead)} m/s^2, and v_x omega is up to {number(across)} m/s^2"
    is_speed = ahead > _MOST_M_S2
    found = Finding(
        what="v_x_range" if is_speed else "omega_range", told=told, size=max(ahead, across), low=_MOST_M_S2,
        high=max(ahead, across), unit="m/s^2", expected=f"at most {_MOST_M_S2:g} m/s^2, 6 g",
        remedy="v_x, v_y: find their unit (mm/s, cm/s?)" if is_speed else "omega: unit: deg/s, or v_x, v_y: find their unit",
    )  # fmt: skip
    return [found], drive.changed(omega=drive.omega * UNITS["deg/s"])
