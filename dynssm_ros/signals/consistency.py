"""Whether the signals of a recording can be right together, by kinematics and physics, with intervals.

Each check compares signals, tells what contradicts, and hands on the drive with that mended, so that one fault is one
finding. The live check of messages is :mod:`dynssm_ros.runtime.consistency`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from dynssm_ros.signals.actuation import check_related, check_steering, check_throttle, steering_sign
from dynssm_ros.signals.findings import Finding
from dynssm_ros.signals.lever import check_lever
from dynssm_ros.signals.liveness import check_liveness, check_wild
from dynssm_ros.signals.motion import (
    check_direction,
    check_path_speed,
    check_side_slip,
    check_turning,
    is_quarter,
    turned_remedy,
)
from dynssm_ros.signals.recording import Recording, RecordingInfo
from dynssm_ros.signals.sensor_consistency import BESIDE, SENSED
from dynssm_ros.signals.spans import Drive, Signal
from dynssm_ros.signals.timing import check_times
from dynssm_ros.signals.velocity_alone import check_axis, check_ranges

CLOCKS: dict[str, tuple[Signal, ...]] = {
    "inputs_clock": ("steering", "throttle"), "steering_clock": ("steering",), "throttle_clock": ("throttle",),
}  # fmt: skip
"""Findings of clocks, and the signals that are stamped by them."""
OF_LOG = (*CLOCKS, *SENSED)
"""Findings that a log tells, and a recording of it no more."""
_OF_VELOCITIES = ("pose_speed", "omega_", "v_x_", "v_y_", "twist_", "odometry_")
"""How findings of measured velocities begin."""
_DEAD = ("_constant", "_frozen")
"""How findings of signals end that do not live, throughout or for long."""
_LEAST_S = 10.0
"""Seconds of a recording, below which nothing is said."""
_MOST_ROWS, _STRETCHES = 30_000, 8
"""Rows that are compared, 10 min at 50 Hz, and in how many stretches they lie in a longer recording."""


def checked(recording: Recording, wheelbase: float | None = None) -> Recording:
    """The recording with what :func:`contradictions` finds in it, and what its log alone told before."""
    info = recording.info.model_copy(update={"findings": contradictions(recording, wheelbase)})
    return replace(recording, info=info)


def contradictions(recording: Recording, wheelbase: float | None = None) -> tuple[Finding, ...]:
    """What of a recording cannot be right.

    Args:
        recording: of one car.
        wheelbase: of the car (m), with which the scale of the steering is known.

    Returns:
        A finding for each fault, those first that others depend on; empty where nothing contradicts. Of a recording that
        was checked before, what its log alone can tell is among them: clocks that are apart, and sensors.
    """
    of_log = tuple(each for each in recording.info.findings if each.what in OF_LOG)
    if recording.duration < _LEAST_S or {each.what for each in of_log} & set(_velocities_from(recording.info)):
        return of_log  # of sensors that are wrong velocities are, and what follows from them
    beside = tuple(each for each in of_log if each.what in BESIDE)
    found = _of_recording(recording, tuple(each for each in of_log if each not in beside), wheelbase)
    wrong = any(each.what.startswith(_OF_VELOCITIES) for each in found)
    return found if wrong else (*beside, *found)  # what is beside wrong velocities need not be wrong


def _velocities_from(info: RecordingInfo) -> tuple[str, ...]:
    """Findings of sensors that the velocities of a recording come from."""
    return SENSED if info.standard_deviations else tuple(each for each in SENSED if each not in BESIDE)


def _of_recording(recording: Recording, of_log: tuple[Finding, ...], wheelbase: float | None) -> tuple[Finding, ...]:
    """What contradicts within a recording, after what its log told."""
    drive = _on_one_clock(Drive.of(_parts(recording)), of_log)
    if not len(drive):
        return of_log
    wild, drive = check_wild(drive)
    found = [*of_log, *wild]
    if drive.stands:
        return tuple(found)
    found += check_liveness(drive)
    dead = {each.what.removesuffix(end) for each in found for end in _DEAD if each.what.endswith(end)}
    rests = np.zeros(len(drive))  # as which an input that does not live tells the other checks nothing
    drive = drive.changed(**{name: rests for name in ("steering", "throttle") if name in dead})
    more, drive = check_times(drive)
    found += more
    position = None if dead & {"pose", "theta"} else drive.position
    moves = position is not None and bool(np.ptp(np.abs(position)) > 0)
    alternative = None
    if moves:
        more, drive, alternative = _poses(drive, "omega" not in dead)
        found += more
    else:
        for check in (check_ranges, check_axis):
            more, drive = check(drive)
            found += more
    if "omega" not in dead and not any(each.what == "v_x_range" for each in found):
        more, drive = check_steering(drive, wheelbase)
        more = more or ([] if len(found) > len(of_log) else check_related(drive))
        if alternative is not None and not _is_scaled(check_steering(alternative(drive), wheelbase)[0]):
            more = [each for each in more if each.what != "steering_scale"]
        found += more
        if wheelbase is not None and not recording.info.standard_deviations and len(found) == len(of_log):
            found += check_lever(drive, wheelbase)
    return (*found, *(check_throttle(drive) if recording.info.set_point == "throttle" else ()))


def _on_one_clock(drive: Drive, findings: tuple[Finding, ...]) -> Drive:
    """The drive with inputs at the time of the odometry, where their clocks are known to be apart."""
    for each in findings:
        if each.what in CLOCKS:
            drive = drive.earlier(-round(each.size / drive.T_s), *CLOCKS[each.what])
    return drive


def _parts(recording: Recording) -> Recording:
    """Stretches of a long recording, evenly spread: what contradicts does so everywhere."""
    if len(recording) <= _MOST_ROWS:
        return recording
    each = _MOST_ROWS // _STRETCHES
    starts = np.linspace(0, len(recording) - each, _STRETCHES).astype(np.intp)
    return recording.select((starts[:, None] + np.arange(each)).ravel())


def _poses(drive: Drive, turns: bool) -> tuple[list[Finding], Drive, Callable[[Drive], Drive] | None]:
    """Poses against velocities; where the speed of either is wrong and nothing tells which, also the other possibility."""
    given = drive
    found, drive = check_path_speed(drive)
    if drive.position is None:
        return found, drive, None
    alternative: Callable[[Drive], Drive] | None = None
    if found and drive.velocity is not given.velocity and "unit" not in found[0].remedy:
        ratio = found[0].size

        def alternative(drive: Drive) -> Drive:
            return drive.changed(velocity=drive.velocity / ratio)

    if turns:
        more, drive = check_turning(drive, steering_sign(drive, either_way=True)[0])
        found += more
    turned, drive = check_direction(drive, steering_sign(drive)[0])
    slip, drive = check_side_slip(drive)
    whats = [each.what for each in (*turned, *slip)]
    if whats == ["twist_turned", "v_y_sign"] and is_quarter(turned[0].size):  # v_x and v_y are each other's, one fault
        turned, slip = [turned[0].model_copy(update={"remedy": turned_remedy(turned[0].size, mirrored=True)})], []
    return [*found, *turned, *slip], drive, alternative


def _is_scaled(found: list[Finding]) -> bool:
    return any(each.what == "steering_scale" for each in found)
