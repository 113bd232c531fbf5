"""Whether poses move as the velocities say: scale, sign, frame and time, by kinematics alone.

Three rates of turning are compared in pairs: that of the heading, of the measured yaw rate, and of the course, which is the
direction in which the position moves. Which of them is wrong the other two tell.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.signals.findings import Finding, number
from dynssm_ros.signals.signal_map import UNITS
from dynssm_ros.signals.spans import SIGMAS, Drive, Fitted, Spans, fitted, varies

Checked = tuple[list[Finding], Drive]
"""What was found, and the drive with that mended."""
_COURSE_S = (0.8, 0.4, 0.2, 0.1)
"""Lengths of spans over which positions move (s); the longest is taken in which a car hardly turns."""
_HARDLY_RAD = 0.5
"""Change of the course over a span in which its chord is as long as its arc within 1 %."""
TURN_S = 1.0
"""Length of spans over which the car turns (s)."""
SPEED_TOLERANCE, YAW_TOLERANCE = 0.06, 0.12
"""Relative deviations that healthy logs show: tyre radii and drifting localisation, scale of gyros."""
_ANGLE_TOLERANCE_RAD = 0.2
"""Turn between pose and velocity that a mounting or a heading that settles may have."""
_OPPOSITE = (-2.0, -0.5)
"""Ratio of two lateral velocities whose signs differ; others belong to a v_y that says too little to judge."""
_RELATED = 0.5
"""Explained share, from which on two signals count as related."""
_NOISE, _NOISE_SIZE = 0.1, 0.5
"""Explained share up to which a v_y knows nothing of turning, and its size in that of the path; noise is smaller still."""
_TURNING_RAD_S = 0.02
"""Root mean square yaw rate, below which nothing is said of turning."""
WITHOUT_V_Y = "nothing measures it: give `velocities:` with the pose, or leave v_y out for the estimator"
"""What to do about a v_y that is none."""
AHEAD_RAD = 0.35
"""Angle between the car's axis and its mean velocity that cars have; they drift by more for moments only."""
_SCATTER, ALIGNED, _CLEARER = 0.02, 0.15, 4.0
"""Circular variance of the angle between path and velocity: up to which it is constant, up to which a frame may explain it,
and how many times less than in the other frame it must be."""

_DEGREES = (8e-6, 2e-5)
"""Degrees of latitude or longitude in a metre, up to 60 degrees from the equator."""
_UNIT_WITHIN = 0.03
"""Relative deviation of a factor from that of a unit that is named."""


def unit_of(factor: float, *names: str) -> str:
    """The unit whose factor to SI a factor is, if one is; else empty."""
    return next((name for name in names if abs(factor / UNITS[name] - 1.0) < _UNIT_WITHIN), "")


def in_unit(factor: float, *names: str) -> str:
    """What to write for a factor: the unit if it is that of one, else the scale."""
    unit = unit_of(factor, *names)
    return f"unit: {unit}" if unit else f"scale: {number(factor)}"


def course_spans(drive: Drive) -> Spans:
    """Spans over which the course is nearly constant, where the position moves at all."""
    assert drive.position is not None
    best: tuple[float, Spans] | None = None
    for seconds in _COURSE_S:
        spans = drive.spans(seconds)
        moved = spans.change(drive.position)
        spans, moved = spans.where(np.abs(moved) > 0), moved[np.abs(moved) > 0]
        if len(spans) < 2:
            continue
        turn = np.abs(np.angle(moved[1:] * moved[:-1].conj()))[np.diff(spans.start) == spans.end[0] - spans.start[0]]
        most = float(np.percentile(turn, 80)) if len(turn) else math.inf
        if most < _HARDLY_RAD:
            return spans
        if best is None or most < best[0]:
            best = most, spans
    return best[1] if best else drive.spans(_COURSE_S[-1])


def check_path_speed(drive: Drive) -> Checked:
    """Path speed of the positions over the magnitude of the velocity."""
    spans = course_spans(drive)
    way, moved = spans.integral(drive.speed), np.abs(spans.change(drive.position))
    fit = ratio_of(moved, way, spans)
    if fit is None or is_one(fit, SPEED_TOLERANCE):
        return [], drive
    ratio, (low, high) = float(fit.values[0]), fit.interval()
    if _DEGREES[0] < ratio < _DEGREES[1]:
        found = Finding(
            what="pose_speed", told=f"path speed of x, y over hypot(v_x, v_y) is {number(ratio)}: x, y are in degrees",
            size=ratio, low=low, high=high, expected="1",
            remedy="map latitude and longitude as such, with `estimation:`, or leave x, y, theta out",
        )  # fmt: skip
        return [found], drive.changed(position=None, theta=None)
    unit = unit_of(ratio, "km/h", "mph", "kt", "ft/s")
    told = f"path speed of x, y over hypot(v_x, v_y) is {number(ratio)}"
    of_pose = in_unit(1.0 / ratio, "cm", "mm", "km")
    remedy = f"v_x, v_y: unit: {unit}" if unit else f"v_x, v_y: scale: {number(ratio)}, or x, y: {of_pose}"
    found = Finding(
        what="pose_speed", told=told, size=ratio, low=low, high=high, expected="1", remedy=remedy,
    )  # fmt: skip
    if unit_of(1.0 / ratio, "cm", "mm", "km"):
        return [found], drive.changed(position=drive.position / ratio)  # type: ignore[operator]
    return [found], drive.changed(velocity=drive.velocity * ratio)


def is_one(fit: Fitted, tolerance: float, value: float = 1.0) -> bool:
    """Whether a factor may be 1 within its interval and a tolerance."""
    low, high = fit.interval()
    return low < value + tolerance and high > value - tolerance


class _Turning(NamedTuple):
    """How the heading turns against yaw rate and course."""

    heading_by_omega: Fitted | None
    course_by_omega: Fitted | None
    course_by_heading: Fitted | None


def _turning(drive: Drive) -> _Turning:
    assert drive.theta is not None
    assert drive.position is not None
    spans = drive.spans(TURN_S)
    heading = ratio_of(spans.change(drive.theta), spans.integral(drive.omega), spans)
    course, between = _course(drive)
    return _Turning(
        heading,
        ratio_of(course, between.integral(drive.omega), between),
        ratio_of(course, between.change(drive.theta), between),
    )


def _course(drive: Drive) -> tuple[Vector, Spans]:
    """By how much the course turns from one span to the next, and the spans between their middles."""
    along = course_spans(drive)
    if len(along) < 2:
        return np.empty(0), along.where(np.zeros(len(along), dtype=bool))
    moved = along.change(drive.position)
    next_to = np.flatnonzero(along.start[1:] == along.end[:-1])
    half = (along.end[0] - along.start[0]) // 2
    between = Spans(drive, along.start[next_to] + half, along.start[next_to + 1] + half)
    return np.angle(moved[next_to + 1] * moved[next_to].conj()), between


def check_course(drive: Drive) -> Checked:
    """Turning of the path against omega where no heading is measured: sign and scale."""
    course, between = _course(drive)
    fit = ratio_of(course, between.integral(drive.omega), between)
    if fit is None or not is_turning(drive):
        return [], drive
    found = []
    if not is_one(magnitude(fit), 2 * YAW_TOLERANCE):
        found.append(_omega_scale(fit, "turning of the path over omega"))
    if fit.values[0] < 0:
        found.append(_sign(fit, "omega_sign", "course"))
    return found, drive.changed(omega=drive.omega * float(fit.values[0])) if found else drive


def ratio_of(values: Vector, of: Vector, spans: Spans) -> Fitted | None:
    """``values`` over ``of``; ``None`` where they do not go together.

    Noise in ``of`` makes the ratio too small, by the explained share at most: the deviation counts that.
    """
    found = fitted(of[:, None], values, spans.block) if len(spans) else None
    if found is None or found.share < _RELATED:
        return None
    return Fitted(found.values, found.std + np.abs(found.values) * (1.0 / found.share - 1.0) / SIGMAS, found.share)


def is_turning(drive: Drive) -> bool:
    """Whether the car turns enough that signs and scales of turning show."""
    driving = drive.speed >= drive.least_speed
    return bool(driving.any()) and float(np.sqrt(np.mean(drive.omega[driving] ** 2))) > _TURNING_RAD_S


def check_turning(drive: Drive, steering_sign: int) -> Checked:
    """Heading against yaw rate against course: signs and scales.

    ``steering_sign`` is that of the yaw rate against the steering, 0 if not known: it breaks ties.
    """
    turning = _turning(drive)
    if (unrelated := _unrelated(turning, drive)) is not None:
        return [unrelated], drive
    found, drive = _turning_scales(turning, drive)
    signs = [0 if fit is None else int(np.sign(fit.values[0])) for fit in turning]
    heading, course, both = signs
    if heading == 0 and course != 0 and both != 0:
        heading = course * both
    if course == 0 and heading != 0 and both != 0:
        course = heading * both
    if heading < 0 and course < 0:
        if steering_sign <= 0:
            return [*found, _sign(turning.heading_by_omega or turning.course_by_omega, "omega_sign", "omega")], (
                drive.changed(omega=-drive.omega)
            )
        return [*found, _sign(turning.heading_by_omega or turning.course_by_omega, "pose_mirrored", "pose")], (
            drive.changed(theta=-drive.theta, position=drive.position.conj())  # type: ignore[operator,union-attr]
        )
    if heading < 0:
        return [*found, _sign(turning.heading_by_omega, "theta_sign", "theta")], drive.changed(theta=-drive.theta)  # type: ignore[operator]
    if course < 0:
        return [*found, _sign(turning.course_by_omega, "path_mirrored", "path")], (
            drive.changed(position=drive.position.conj())  # type: ignore[union-attr]
        )
    return found, drive


def _unrelated(turning: _Turning, drive: Drive) -> Finding | None:
    """A yaw rate that is not that of the drive, where heading and path turn alike."""
    heading, course, both = turning
    if heading is not None or course is not None or both is None or not is_one(magnitude(both), 2 * YAW_TOLERANCE):
        return None
    spans = drive.spans(TURN_S)
    fit = fitted(spans.integral(drive.omega)[:, None], spans.change(drive.theta), spans.block)
    share = 0.0 if fit is None else max(fit.share, 0.0)
    return Finding(
        what="omega_unrelated", told=f"omega explains {100 * share:.0f} % of how theta and the path turn", size=share,
        low=share, high=share, expected=f"above {100 * _RELATED:.0f} %",
        remedy="omega: map the yaw rate, about the axis that points up, of this car and drive",
    )  # fmt: skip


_SIGNS = {
    "omega": ("omega over the turning of theta and of the path", "omega: scale: -1"),
    "course": ("turning of the path over omega", "omega: scale: -1"),
    "theta": (
        "d theta/dt over omega",
        "theta: scale: -1 (with x east and y north a compass heading is also turned: offset: 1.571)",
    ),
    "path": ("turning of the path over omega", "y: scale: -1, or x and y exchanged"),
    "pose": (
        "turning of theta and of the path over omega",
        "theta: scale: -1 and y: scale: -1 (north-east-down to x forward, y left); or omega: scale: -1 with the steering's",
    ),
}


def _sign(fit: Fitted | None, what: str, which: str) -> Finding:
    assert fit is not None
    told, remedy = _SIGNS[which]
    low, high = fit.interval()
    value = float(fit.values[0])
    return Finding(
        what=what, told=f"{told} is {number(value)}", size=value, low=low, high=high, expected="1", remedy=remedy
    )


def _turning_scales(turning: _Turning, drive: Drive) -> Checked:
    """Scales of omega and theta that they, or the course, contradict: often one, both where both are in degrees."""
    heading, course, both = turning
    if heading is None and course is None:
        return [], drive
    if heading is None or is_one(magnitude(heading), YAW_TOLERANCE):
        if course is None or both is None or not (_is_in_degrees(course) and _is_in_degrees(both)):
            return [], drive
        of_omega = _omega_scale(course, "turning of the path over omega").model_copy(
            update={"remedy": "omega: unit: deg/s"}
        )
        of_theta = _theta_scale(both, of_course=True).model_copy(update={"remedy": "theta: unit: deg"})
        return [of_omega, of_theta], drive.changed(
            omega=drive.omega * of_omega.size,
            theta=drive.theta / of_theta.size,  # type: ignore[operator]
        )
    theta_is_right = both is not None and is_one(magnitude(both), 2 * YAW_TOLERANCE)
    omega_is_right = course is not None and is_one(magnitude(course), 2 * YAW_TOLERANCE)
    if omega_is_right and not theta_is_right:
        of_theta = _theta_scale(heading)
        return [of_theta], drive.changed(theta=drive.theta / of_theta.size)  # type: ignore[operator]
    of_omega = _omega_scale(heading, "d theta/dt over omega")
    return [of_omega], drive.changed(omega=drive.omega * of_omega.size)


def _is_in_degrees(by_course: Fitted) -> bool:
    """Whether what the turning of the path is divided by counts degrees."""
    return is_one(magnitude(by_course), 2 * YAW_TOLERANCE * UNITS["deg"], UNITS["deg"])


def _omega_scale(fit: Fitted, told: str) -> Finding:
    """A scale of omega by what its right value is divided by it."""
    ratio, (low, high) = abs(float(fit.values[0])), sorted(map(abs, fit.interval()))
    return Finding(
        what="omega_scale", told=f"{told} is {number(ratio)}", size=ratio, low=low, high=high, expected="1",
        remedy=f"omega: {in_unit(ratio, 'deg/s')}",
    )  # fmt: skip


def _theta_scale(fit: Fitted, *, of_course: bool = False) -> Finding:
    """A scale of theta by its rate over omega, or by that ``of_course`` over its rate."""
    ratio, (low, high) = abs(float(fit.values[0])), sorted(map(abs, fit.interval()))
    told = "d theta/dt over omega"
    if of_course:
        ratio, low, high, told = 1.0 / ratio, 1.0 / high, 1.0 / low, "d theta/dt over the turning of the path"
    return Finding(
        what="theta_scale", told=f"{told} is {number(ratio)}", size=ratio, low=low, high=high, expected="1",
        remedy=f"theta: {in_unit(1.0 / ratio, 'deg')}",
    )  # fmt: skip


def magnitude(fit: Fitted) -> Fitted:
    """A fit without its signs."""
    return Fitted(np.abs(fit.values), fit.std, fit.share)


def check_direction(drive: Drive, steering_sign: int = 0) -> Checked:
    """Direction in which the position moves, against heading and velocity.

    ``steering_sign`` is that of the curvature against the steering, 0 if not known: it tells v_x from theta.
    """
    assert drive.theta is not None
    assert drive.position is not None
    spans = course_spans(drive)
    moved = spans.change(drive.position)
    if len(spans) < 8:
        return [], drive
    middle = drive.theta[spans.start] + spans.change(drive.theta) / 2
    course, body = moved / np.abs(moved), directions(spans.mean(drive.velocity))
    heading = np.exp(1j * middle)
    error = course * (heading * body).conj()
    mean = complex(error.mean())
    scatter, scatter_in_map = 1.0 - abs(mean), 1.0 - abs(complex((course * body.conj()).mean()))
    if scatter < max(_SCATTER, scatter_in_map / _CLEARER):
        return _turned(mean, error, spans, drive, steering_sign)
    if scatter_in_map < ALIGNED and scatter_in_map < scatter / _CLEARER:
        cosine = np.cos(np.angle(error))
        size, (low, high) = float(cosine.mean()), _mean_interval(cosine, spans)
        found = Finding(
            what="twist_in_map_frame",
            told=f"v_x, v_y point along the path without theta; with it the cosine of their angle is {number(size)}",
            size=size, low=low, high=high, expected="1",
            remedy="v_x, v_y in the frame of the car: turn them by -theta in the odometry, or `velocities:` from the poses",
        )  # fmt: skip
        return [found], drive.changed(velocity=drive.velocity * np.exp(-1j * drive.theta))
    return [], drive


def _turned(mean: complex, error: Vector, spans: Spans, drive: Drive, steering_sign: int) -> Checked:
    """A constant angle between the path and where the car goes by its heading and velocity."""
    angle = float(np.angle(mean))
    low, high = _mean_interval(np.angle(error * np.exp(-1j * angle)) + angle, spans)
    if low < _ANGLE_TOLERANCE_RAD and high > -_ANGLE_TOLERANCE_RAD:
        return [], drive
    told = f"the path points {number(angle)} rad beside theta and the velocity"
    ahead = float(np.mean(drive.velocity.real[drive.speed >= drive.least_speed] > 0))
    backwards = steering_sign < 0 or (steering_sign == 0 and ahead < 0.5)
    is_opposite = abs(angle) > math.pi - _ANGLE_TOLERANCE_RAD
    if is_opposite and backwards:
        found = Finding(
            what="v_x_sign", told=told, size=angle, low=low, high=high, unit="rad", expected="0",
            remedy="v_x: scale: -1 (or theta: offset: 3.142, if the car drove backwards)",
        )  # fmt: skip
        return [found], drive.changed(velocity=-drive.velocity.conj())
    aside = complex(np.mean(directions(drive.velocity[drive.speed >= drive.least_speed])))
    if not is_opposite and abs(np.angle(aside)) > AHEAD_RAD and abs(np.angle(aside * np.exp(1j * angle))) < AHEAD_RAD:
        beside = number(float(np.angle(aside)))
        found = Finding(
            what="twist_turned", told=f"{told}, and v_x, v_y point {beside} rad beside the car's axis",
            size=angle, low=low, high=high, unit="rad", expected="0: x forward, y left", remedy=turned_remedy(angle),
        )  # fmt: skip
        return [found], drive.changed(velocity=drive.velocity * np.exp(1j * angle))
    found = Finding(
        what="theta_offset", told=told, size=angle, low=low, high=high, unit="rad", expected="0",
        remedy=f"theta: offset: {number(angle)}",
    )  # fmt: skip
    return [found], drive.changed(theta=drive.theta + angle)  # type: ignore[operator]


def is_quarter(angle: float) -> bool:
    """Whether an angle (rad) is a quarter of a turn, to either side."""
    return abs(abs(angle) - math.pi / 2) < _ANGLE_TOLERANCE_RAD


def turned_remedy(angle: float, *, mirrored: bool = False) -> str:
    """What to write where a twist is to be turned by an angle (rad), and its v_y is ``mirrored`` then."""
    if not is_quarter(angle):
        return f"turn v_x, v_y by {number(angle)} rad in the odometry, or `velocities:` from the poses"
    x = "scale: -1 of the field of v_y" if angle > 0 else "the field of v_y"
    y = "that of v_x" if (angle > 0) != mirrored else "scale: -1 of that of v_x"
    return f"v_x: {x}, v_y: {y}"


def directions(values: Any) -> Any:
    """Complex numbers of length 1; 0 of those that are 0."""
    return values / np.maximum(np.abs(values), 1e-12)


def _mean_interval(values: Vector, spans: Spans) -> tuple[float, float]:
    """The 95 % interval of a mean, by blocks."""
    means = np.array([values[spans.block == number].mean() for number in np.unique(spans.block)])
    half = SIGMAS * float(means.std(ddof=1)) / math.sqrt(len(means)) if len(means) > 1 else math.inf
    return float(values.mean()) - half, float(values.mean()) + half


def _v_y_unrelated(size: float) -> Finding:
    return Finding(
        what="v_y_unrelated", told=f"v_y is {number(size)} of the lateral velocity of x, y, and does not turn with the car",
        size=size, low=size, high=size, expected="about 1",
        remedy=WITHOUT_V_Y,
    )  # fmt: skip


def check_side_slip(drive: Drive) -> Checked:
    """Lateral velocity of the position in the car's frame against v_y: sign and scale.

    A point beside the centre of gravity adds a multiple of omega, a turned sensor one of v_x; both are left free.
    """
    assert drive.theta is not None
    assert drive.position is not None
    spans = course_spans(drive)
    if len(spans) < 8:
        return [], drive
    turned = np.exp(1j * drive.theta)
    back = np.exp(-1j * (drive.theta[spans.start] + spans.change(drive.theta) / 2))

    def across(velocity: Any) -> Vector:
        return np.asarray((spans.integral(turned * velocity) * back).imag / spans.seconds)

    moved = (spans.change(drive.position) * back).imag / spans.seconds - across(drive.velocity.real)
    terms = [across(1j * each) for each in (drive.velocity.imag, drive.omega, drive.velocity.real)]
    fit = fitted(np.stack(terms, axis=1), moved, spans.block)
    if fit is None or fit.share < _RELATED:
        return [], drive
    turning = np.stack(terms[1:], axis=1)
    of_path, of_v_y = (fitted(turning, each, spans.block) for each in (moved, terms[0]))
    if of_path and of_path.share > _RELATED and (of_v_y is None or of_v_y.share < _NOISE) and varies(terms[0]):
        size = float(terms[0].std() / moved.std())
        if size < _NOISE_SIZE:
            return [_v_y_unrelated(size)], drive
    slope, (low, high) = float(fit.values[0]), fit.interval()
    if high < 0.0 and _OPPOSITE[0] < slope < _OPPOSITE[1]:
        found = Finding(
            what="v_y_sign", told=f"lateral velocity of x, y over v_y is {number(slope)}", size=slope, low=low, high=high,
            expected="1", remedy="v_y: scale: -1",
        )  # fmt: skip
        return [found], drive.changed(velocity=drive.velocity.conj())
    return [], drive
