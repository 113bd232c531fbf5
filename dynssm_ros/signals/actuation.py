"""Whether steering and throttle can be those of the drive: time, sign, scale, offset, by what they cause.

Steering is compared with curvature including understeer: ``delta = L k + K v^2 k`` (Gillespie, *Fundamentals of Vehicle
Dynamics*, ch. 6), fitted together, on gentle driving where there is enough of it. Throttle is compared with acceleration.
"""

from __future__ import annotations

import math

import numpy as np

from dynssm_ros.arrays import Indices, Vector
from dynssm_ros.signals.findings import Finding, number
from dynssm_ros.signals.motion import Checked, is_turning
from dynssm_ros.signals.rest_value import rest_value
from dynssm_ros.signals.signal_map import UNITS
from dynssm_ros.signals.spans import SIGMAS, Drive, Fitted, blocks, fitted, varies
from dynssm_ros.signals.timing import acceleration

_SPAN_S = 0.4
"""Of steering and curvature that are compared (s)."""
_GENTLE = 0.5
"""Share of the 99th percentile of the lateral acceleration, up to which tyres count as linear."""
UNDERSTEER = (-0.4, 4.0)
"""Understeer ``K v^2`` over wheelbase that cars have: below -1 they are unstable, above 4 they push straight on."""
_ENOUGH_SPANS = 40
LARGE_RAD = 1.6
"""Larger values are no road-wheel angle in rad."""
SCALES = (0.5, 2.0)
"""Steering scales that are left alone: hidden gains of a steering, a wrong wheelbase and tyres at their limit are within."""
_UNRELATED = 0.4
"""Explained share of the curvature, below which a steering is not that of the drive; healthy logs have 0.97 and more."""
_REVERSED, _GOES_WITH = 0.1, 0.9
"""Share of the bends in which omega turns against the steering, from which on a car reverses (healthy logs: 0.03);
share of the curvature that the steering then explains but for its sign."""
_BRAKES = 0.02
"""Share of driving forwards with a negative value, from which on it is no set-point of the speed."""
_LIKE_UNIT = 0.25
"""By how much a scale of the steering may differ from that which a wrong unit of speed or yaw rate gives."""
OFFSET_RAD = 0.04
"""Straight-ahead steering that is left alone: servos are trimmed worse than that by nobody; banked roads need 0.02."""
_LEAST_REST, _RESTS_S, _STANDS = 0.03, 1.0, 0.05
"""Rest value of a throttle that is told; for how long the car rests with it (s); share of its speed at which it stands."""


def steering_fit(drive: Drive) -> Fitted | None:
    """``delta = offset + L k + K v^2 k`` as recorded: ``(offset, L, K)``; on gentle driving where there is enough."""
    spans = drive.spans(_SPAN_S)
    if len(spans) < _ENOUGH_SPANS or not varies(drive.steering):
        return None
    ahead = spans.mean(drive.velocity.real)
    spans, ahead = spans.where(ahead > 0), ahead[ahead > 0]
    if len(spans) < _ENOUGH_SPANS:
        return None
    curvature = spans.mean(drive.omega) / ahead
    return understeer(spans.mean(drive.steering), curvature, ahead, block=spans.block)


def understeer(steering: Vector, curvature: Vector, speed: Vector, *, block: Indices) -> Fitted | None:
    """``delta = offset + L k + K v^2 k`` from steering (as recorded), curvature (1/m) and speed (m/s), each ``(n,)``.

    ``block`` numbers neighbours. Tyres at their limit add a term of the third order in ``v^2 k``: of gentle driving without
    it and all driving with it, ``K`` then at the root mean square of ``v^2 k``, that which knows ``L`` better. Half of what
    they are apart counts as a standard deviation beside its own.
    ``None`` where the rows determine neither.
    """
    lateral = curvature * speed**2
    gentle = np.abs(lateral) <= _GENTLE * np.percentile(np.abs(lateral), 99)
    if gentle.sum() < max(_ENOUGH_SPANS, 0.2 * len(lateral)):
        gentle = np.ones(len(lateral), dtype=bool)
    linear = np.stack([np.ones(len(lateral)), curvature, lateral], axis=1)
    fit = fitted(linear[gentle], steering[gentle], block[gentle])
    bent = lateral**3 / max(float(np.mean(lateral**2)), 1e-300)
    full = fitted(np.concatenate([linear, bent[:, None]], axis=1), steering, block)
    if full is None:
        return fit
    full = Fitted(np.append(full.values[:2], full.values[2] + full.values[3]), full.std[:3], full.share)
    if fit is None:
        return full
    better = min(fit, full, key=lambda each: float(each.std[1]))
    return Fitted(better.values, np.hypot(better.std, (full.values - fit.values) / 2.0), better.share)


def turns_both_ways(drive: Drive) -> bool:
    """Whether left and right bends are driven, each for a tenth of the time."""
    right, left = np.percentile(drive.omega[drive.speed >= drive.least_speed], [10.0, 90.0])
    return bool(right < 0.0 < left)


def steering_sign(drive: Drive, *, either_way: bool = False) -> tuple[int, Fitted | None]:
    """Sign of the curvature against the steering, 0 where they do not go together, with their regression.

    ``either_way`` counts the way that the car drives mostly as forwards: the sign of v_x may be what is wrong.
    """
    spans = drive.spans(_SPAN_S)
    if len(spans) < 8 or not is_turning(drive) or not varies(drive.steering):
        return 0, None
    ahead = spans.mean(drive.velocity.real)
    if either_way:
        ahead = ahead * (np.sign(np.median(ahead)) or 1.0)
    moving = ahead > 0 if either_way else np.abs(ahead) >= drive.least_speed / 2
    spans, ahead = spans.where(moving), ahead[moving]
    curvature = spans.mean(drive.omega) / ahead
    fit = fitted(np.stack([np.ones(len(spans)), curvature], axis=1), spans.mean(drive.steering), spans.block)
    if fit is None or fit.share < _UNRELATED:
        return 0, fit
    low, high = fit.interval(1)
    return (1 if low > 0 else -1 if high < 0 else 0), fit


def check_steering(drive: Drive, wheelbase: float | None) -> Checked:
    """Sign, scale and offset of the steering against curvature; the scale with the ``wheelbase`` (m) alone."""
    sign, rough = steering_sign(drive)
    found: list[Finding] = []
    if sign < 0 and rough is not None:
        slope, (low, high) = float(rough.values[1]), rough.interval(1)
        found.append(
            Finding(
                what="steering_sign", told=f"delta_fb falls with the curvature, by {number(slope)} m", size=slope, low=low,
                high=high, unit="m", expected="above 0: left is positive in both",
                remedy="steering_feedback: scale: -1; or, if y points right, omega, v_y, y and theta: scale: -1",
            )
        )  # fmt: skip
        drive = drive.changed(steering=-drive.steering)
    fit = steering_fit(drive) if sign else None
    scale = _scale(drive, fit, wheelbase)
    if scale is not None:
        return [*found, scale], drive.changed(steering=drive.steering * scale.size)
    if fit is not None and fit.share > 0.4:
        found += _offset(drive, fit)
    return found, drive


def check_related(drive: Drive) -> list[Finding]:
    """A steering that has nothing to do with the curvature of a car that turns to both sides, or not where it reverses."""
    sign, fit = steering_sign(drive)
    if (share := _reversed(drive)) > _REVERSED:
        return [
            Finding(
                what="v_x_unsigned", told=f"v_x is never negative, and omega turns against delta_fb in "
                f"{100 * share:.0f} % of the bends", size=share, low=share, high=share,
                expected="a v_x that is negative where the car reverses",
                remedy="give v_x its sign (gear, wheel speeds), or leave out where the car reverses",
            )
        ]  # fmt: skip
    if sign or fit is None or fit.share > _UNRELATED or not turns_both_ways(drive):
        return []
    return [
        Finding(
            what="steering_unrelated", told=f"delta_fb explains {100 * max(fit.share, 0.0):.0f} % of the curvature",
            size=fit.share, low=fit.share, high=fit.share, expected=f"above {100 * _UNRELATED:.0f} %",
            remedy="map the steering of this car and drive, and find how far its clock is off",
        )
    ]  # fmt: skip


def _reversed(drive: Drive) -> float:
    """Share of the bends that a car goes through backwards, by its steering, while v_x is never negative.

    It stands for a moment before; one that never does has a steering of other bends.
    """
    spans, signed = drive.spans(_SPAN_S), float(np.percentile(drive.velocity.real, 1.0)) < -drive.least_speed / 4
    if len(spans) < _ENOUGH_SPANS or signed or drive.speed.min() > drive.least_speed / 2:
        return 0.0
    curvature, steering = spans.mean(drive.omega) / spans.mean(drive.speed), spans.mean(drive.steering)
    bends = (np.abs(curvature) > np.median(np.abs(curvature))) & (np.abs(steering) > np.median(np.abs(steering)))
    against = curvature * steering < 0
    both = np.stack([np.ones(len(spans)), np.where(against, -curvature, curvature)], axis=1)
    fit = fitted(both, steering, spans.block)
    return float(against[bends].mean()) if fit is not None and fit.share > _GOES_WITH and bends.any() else 0.0


def _scale(drive: Drive, fit: Fitted | None, wheelbase: float | None) -> Finding | None:
    """What to multiply the steering with, if that is not about 1."""
    largest = float(np.percentile(np.abs(drive.steering), 99))
    if fit is not None and wheelbase is not None and fit.share > 0.4:
        square = float(np.mean(drive.speed[drive.speed >= drive.least_speed] ** 2))
        low, high = believable(fit, square)
        if 0 < low <= high and (wheelbase / high > SCALES[1] or wheelbase / low < SCALES[0]):
            scale = wheelbase / float(fit.values[1])
            told = f"wheelbase over delta_fb per curvature is {number(scale)}, understeer taken off"
            return Finding(
                what="steering_scale", told=told, size=scale, low=wheelbase / high, high=wheelbase / low,
                expected=f"1 ({SCALES[0]:g} to {SCALES[1]:g})",
                remedy=_scale_remedy(scale) + ("" if drive.position is not None else _or_unit(scale)),
            )  # fmt: skip
        return None
    if largest > LARGE_RAD:
        return Finding(
            what="steering_range", told=f"delta_fb is up to {number(largest)}, which asks for a factor of "
            f"{number(LARGE_RAD / largest)} or less", size=math.pi / 180, low=0.0,
            high=LARGE_RAD / largest, unit="1", expected=f"below {LARGE_RAD:g} rad at the road wheel",
            remedy="steering_feedback: unit: deg, or scale: 1 over the ratio of the steering",
        )  # fmt: skip
    return None


def believable(fit: Fitted, square: float) -> tuple[float, float]:
    """The interval of ``L`` as far as cars go: at the mean ``square`` of the speed understeer is ``UNDERSTEER`` of it.

    Their sum at that speed is known best. Empty, the first larger than the second, where the fit is that of no car.
    """
    low, high = fit.interval(1)
    total = float(fit.values[1] + fit.values[2] * square)
    ends = [total / (1.0 + share) for share in UNDERSTEER]
    if not min(ends) <= float(fit.values[1]) <= max(ends):
        return math.inf, -math.inf
    return max(low, min(ends)), min(high, max(ends))


def _scale_remedy(scale: float) -> str:
    if abs(scale * 180 / math.pi - 1.0) < 0.35:
        return f"steering_feedback: unit: deg (factor 0.0175), or scale: {number(scale)}"
    if 1 / 25 < scale < 1 / 8:
        return f"steering_feedback: scale: {number(scale)} (steering wheel, ratio {1 / scale:.3g})"
    return f"steering_feedback: scale: {number(scale)}"


def _or_unit(scale: float) -> str:
    """What else may be wrong where nothing confirms the curvature ``omega / v_x``."""
    alike = {f"; or v_x, v_y: unit: {unit}": UNITS[unit] for unit in ("km/h", "mph")}
    alike["; or omega: unit: deg/s"] = 1.0 / UNITS["deg/s"]
    return "".join(words for words, factor in alike.items() if abs(scale / factor - 1.0) < _LIKE_UNIT)


def _offset(drive: Drive, fit: Fitted) -> list[Finding]:
    """Steering at which the car goes straight, if that is not about 0; told where it turned to both sides."""
    offset, (low, high) = float(fit.values[0]), fit.interval(0)
    if (low < OFFSET_RAD and high > -OFFSET_RAD) or not turns_both_ways(drive):
        return []
    return [
        Finding(
            what="steering_offset", told=f"the car goes straight at delta_fb = {number(offset)} rad", size=offset, low=low,
            high=high, unit="rad", expected=f"0 (within {OFFSET_RAD:g} rad)",
            remedy=f"steering_feedback: offset: {number(-offset)}",
        )
    ]  # fmt: skip


def check_throttle(drive: Drive) -> list[Finding]:
    """Range and sign of the throttle, and whether it is ever used."""
    r, largest = drive.throttle, float(np.percentile(np.abs(drive.throttle), 99.5))
    a = acceleration(drive)
    known = np.isfinite(a)
    if not known.any() or largest == 0:
        return []
    if largest > 1.5:
        return [_throttle_range(drive, known, largest)]
    if largest < 0.03:
        return [
            Finding(
                what="throttle_scale", told=f"r_fb is at most {number(largest)}", size=largest, low=largest, high=largest,
                expected="a fraction whose full throttle is 1", remedy="throttle_feedback: scale: so that full is 1",
            )
        ]  # fmt: skip
    never_used = _never_used(r[known], a[known]) if drive.velocity.real.mean() > 0 else []
    return _throttle_sign(drive, a, known) or never_used or _resting(drive, a)


def _throttle_range(drive: Drive, known: Vector, largest: float) -> Finding:
    """A throttle beyond 1: a speed set-point, or a percentage."""
    speed, r = drive.velocity.real[known], drive.throttle[known]
    fit = fitted(np.stack([np.ones(len(r)), speed], axis=1), r, blocks(len(r)))
    brakes = float(np.mean(r[speed > 0] < 0)) > _BRAKES
    if fit is not None and fit.share > 0.5 and abs(float(fit.values[1]) - 1.0) < 0.3 and not brakes:
        low, high = fit.interval(1)
        return Finding(
            what="throttle_setpoint", told=f"r_fb follows v_x with {number(float(fit.values[1]))} per m/s, up to "
            f"{number(largest)}: a speed set-point", size=float(fit.values[1]), low=low, high=high,
            expected="a throttle between -1 and 1", 
            remedy="map it as speed_feedback, for a vehicle with inputs.set_point: speed, or find the throttle",
        )  # fmt: skip
    unit = "unit: '%'" if 20.0 < largest <= 105.0 else f"scale: {number(1 / largest)} or what is full"
    return Finding(
        what="throttle_range", told=f"r_fb is up to {number(largest)}", size=largest, low=largest, high=largest,
        expected="a fraction between -1 and 1", remedy=f"throttle_feedback: {unit}",
    )  # fmt: skip


def _never_used(r: Vector, a: Vector) -> list[Finding]:
    """A throttle that is never positive although the car accelerates as hard as it brakes."""
    rest = float(r.max())
    if rest > 0 or not float(np.percentile(a, 95)) > 0.2 * float(np.abs(np.percentile(a, 5))):
        return []
    remedy = f"brake_feedback rests at {number(-rest)}, not 0: offset: {number(rest)}, or a curve with a dead band"
    return [
        Finding(
            what="throttle_never_used", told=f"r_fb is at most {number(rest)} although the car accelerates", size=-rest,
            low=-rest, high=-rest, expected="above 0 where the car accelerates",
            remedy=remedy if rest < 0 else "throttle_feedback: map what drives the car",
        )
    ]  # fmt: skip


def _resting(drive: Drive, a: Vector) -> list[Finding]:
    """A throttle whose rest value is not 0: at it the car stands or rolls out."""
    r = drive.throttle
    limit = rest_value(r[r >= 0.0])
    at = (r > 0.0) & (r <= limit)
    rolling = a[at & np.isfinite(a)]
    standing = at & (drive.speed < _STANDS * float(np.percentile(drive.speed, 95)))
    if limit < _LEAST_REST or (len(rolling) + standing.sum()) * drive.T_s < _RESTS_S:
        return []
    if len(rolling) and float(np.percentile(rolling, 75)) > 0.0:
        return []
    rest, (low, high) = float(np.median(r[at])), np.percentile(r[at], [2.5, 97.5]).tolist()
    does = "stands" if standing.sum() > len(rolling) else "rolls out"
    return [
        Finding(
            what="throttle_rest", told=f"the car {does} at r_fb = {number(rest)}, its least value", size=rest, low=low,
            high=high, expected="0 where nothing drives",
            remedy=f"throttle_feedback: offset: {number(-rest)}, or a curve with a dead band",
        )
    ]  # fmt: skip


def _throttle_sign(drive: Drive, a: Vector, known: Vector) -> list[Finding]:
    v_x = drive.velocity.real[known]
    design = np.stack([drive.throttle[known], np.ones(len(v_x)), v_x, v_x**2], axis=1)
    fit = fitted(design, a[known], blocks(len(v_x)))
    if fit is None or fit.share < 0.4:
        return []
    slope, (low, high) = float(fit.values[0]), fit.interval()
    if high >= 0 or abs(slope) < 2 * SIGMAS * float(fit.std[0]):
        return []
    return [
        Finding(
            what="throttle_sign", told=f"the car decelerates by {number(-slope)} m/s^2 per r_fb", size=slope, low=low,
            high=high, unit="m/s^2", expected="above 0: throttle accelerates",
            remedy="throttle_feedback: scale: -1; or it is the brake, or a set-point",
        )
    ]  # fmt: skip
