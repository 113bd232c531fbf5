"""Whether the sensors of a log can be right together, also those that are only compared with measured velocities.

What drives a path of fixes is compared with speed and gyro. Then the accelerometers are: ``a_y`` with ``v_x omega`` and the
change of ``v_y``, ``a_x`` with the change of ``v_x``. Which of the units that people mix up explain both ratios is named, if
few do. Speeds of wheels are compared with ``v_x``.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.signals.estimation import positions_of
from dynssm_ros.signals.findings import Finding, number
from dynssm_ros.signals.motion import (
    SPEED_TOLERANCE,
    Checked,
    check_course,
    check_path_speed,
    course_spans,
    in_unit,
    ratio_of,
)
from dynssm_ros.signals.resampling import Stamps, Stream
from dynssm_ros.signals.signal_map import COMPARED, UNITS, SignalMap
from dynssm_ros.signals.spans import SIGMAS, Complex, Drive, Fitted, Spans, fitted, varies

_AXES = "acceleration_axes"
BESIDE = ("a_x_scale", "a_y_scale", "a_x_sign", "a_y_sign", _AXES, "wheel_speed_scale", "wheel_speed_sign")
"""Findings of what no velocity comes from where all of them are measured."""
SENSED = ("fix_axes", "speed_scale", "gyro_scale", "gyro_sign", *BESIDE)
"""Findings of this module."""
_LEAST_S, _SPAN_S, _FEWEST_SPANS = 10.0, 0.4, 40
_MOST_ROWS = 30_000
_TOLERANCE = 0.3
"""Of the ratio of accelerations: bodies roll and pitch, which adds up to 0.1 g per g, and sensors are off the middle."""
_RELATED = 0.5
"""Explained share, from which on an acceleration counts as that of the car."""
_SLIP = 0.1
"""Share by which driven wheels turn faster than the car, at most, over most of a drive."""
_FACTORS = {"v_x": ("m/s", "km/h", "mph"), "omega": ("rad/s", "deg/s"), "a": ("m/s^2", "g")}
"""Units that are mixed up."""
_CAUSES = {"a_x": "d v_x/dt", "a_y": "v_x omega", "wheel_speed": "v_x"}


def sensor_findings(streams: Mapping[str, Stream], signal_map: SignalMap) -> tuple[Finding, ...]:
    """Contradictions between velocities and the sensors beside them; ``streams`` by signal, in SI units.

    Poses beside measured velocities are compared with the recording, not here.
    """
    sensed = [name for name in COMPARED if name in streams]
    if not {"v_x", "omega"} <= set(streams) or len(streams["omega"].stamps) < 2:
        return ()
    estimates = "v_y" not in streams
    if not (estimates or sensed):
        return ()
    drive, compared, stamps = _drive(streams, signal_map, sensed)
    if len(drive) * drive.T_s < _LEAST_S or not drive.speed.max() > 0:
        return ()
    found: list[Finding] = []
    if estimates and drive.position is not None and np.ptp(np.abs(drive.position)) > 0:
        found, drive = _check_fixes(drive, streams, stamps)
        more, drive = check_path_speed(drive)
        found += [_renamed(each, "speed_scale", "v_x") for each in more]
        more, drive = check_course(drive)
        found += [_renamed(each, each.what.replace("omega", "gyro"), "omega") for each in more]
    spans = drive.spans(_SPAN_S)
    if len(spans) < _FEWEST_SPANS:
        return tuple(found)
    found += _accelerations(spans, compared, by_path=drive.position is not None)
    return (*found, *_wheels(spans, compared.get("wheel_speed")))


def _check_fixes(drive: Drive, streams: Mapping[str, Stream], at: Stamps) -> Checked:
    """Whether longitudes are called latitudes: a degree of them has other metres, so the path would be stretched.

    Near the equator and the meridian of Greenwich it is only mirrored.
    """
    if not {"latitude", "longitude"} <= set(streams) or np.abs(streams["longitude"].values).max() >= 90.0:
        return [], drive
    stretch = math.prod(math.cos(math.radians(float(streams[one].values[0]))) for one in ("latitude", "longitude"))
    if stretch > 1.0 - SPEED_TOLERANCE:
        return [], drive
    exchanged = {**streams, "latitude": streams["longitude"], "longitude": streams["latitude"]}
    other = drive.changed(position=_position(exchanged, at))
    spans = course_spans(drive)
    misfits = [_misfit(one.position, spans) for one in (drive, other)]
    if misfits[0] is None or misfits[1] is None:
        return [], drive
    worse = misfits[0] - misfits[1]
    low, high = (float(worse.mean() + side * SIGMAS * worse.std(ddof=1) / math.sqrt(len(worse))) for side in (-1, 1))
    if not low > 0:
        return [], drive
    told = f"with longitude as latitude the path is nearer to v_x, by {number(float(worse.mean()))} of its mean square"
    found = Finding(
        what="fix_axes", told=told, size=float(worse.mean()), low=low, high=high, expected="0 or less",
        remedy="latitude: the field of longitude, longitude: that of latitude",
    )  # fmt: skip
    return [found], other


def _misfit(position: Complex | None, spans: Spans) -> Vector | None:
    """How far a path is from what ``v_x`` makes of it, mean square of each block of a drive as a share of the way's."""
    way, moved = spans.integral(spans.drive.speed), np.abs(spans.change(position))
    fit = ratio_of(moved, way, spans)
    if fit is None:
        return None
    error = np.square(moved / float(fit.values[0]) - way) / np.mean(np.square(way))
    return np.array([error[spans.block == number].mean() for number in np.unique(spans.block)])


def _renamed(finding: Finding, what: str, signal: str) -> Finding:
    """A finding of odometry, of a sensor."""
    remedy = finding.remedy.replace("v_x, v_y", signal).partition(", or x, y")[0]
    told = finding.told.replace("hypot(v_x, v_y)", signal).replace("x, y", "the fixes")
    return finding.model_copy(update={"what": what, "remedy": remedy, "told": told})


def _drive(
    streams: Mapping[str, Stream], signal_map: SignalMap, sensed: Sequence[str]
) -> tuple[Drive, dict[str, Vector], Stamps]:
    """Velocities, gyro and positions at stamps of the gyro, what else is ``sensed`` there, and the stamps."""
    stamps = streams["omega"].stamps
    step = max(1, -(-len(stamps) // _MOST_ROWS))
    first, last = (edge(one.stamps[0 if edge is max else -1] for one in streams.values()) for edge in (max, min))
    rows = np.flatnonzero((stamps >= first) & (stamps <= last))[::step]
    at = stamps[rows]

    def sampled(stream: Stream) -> Vector:
        return np.interp(at, stream.stamps, stream.values)

    apart = np.diff(at, prepend=at[:1])
    segment = np.cumsum(apart > signal_map.max_gap_ns + step * np.median(apart)).astype(np.int32)
    zeros = np.zeros(len(at))
    across = sampled(streams["v_y"]) if "v_y" in streams else zeros
    drive = Drive(
        float(np.median(np.diff(at))) / 1e9 if len(at) > 1 else 1.0, segment, sampled(streams["v_x"]) + 1j * across,
        sampled(streams["omega"]), zeros, zeros,
        _position(streams, at),
    )  # fmt: skip
    return drive, {name: sampled(streams[name]) for name in sensed}, at


def _position(streams: Mapping[str, Stream], at: Stamps) -> Complex | None:
    """Where the car is at some stamps, ``x + iy`` (m) ``(N,)``; ``None`` where nothing tells."""
    fixes = positions_of({name: (one.stamps, one.values) for name, one in streams.items()})
    if fixes is None or not len(fixes[0]):
        return None
    fixed, x, y = fixes
    return np.asarray(np.interp(at, fixed, x) + 1j * np.interp(at, fixed, y), np.complex128)


def _accelerations(spans: Spans, measured: Mapping[str, Vector], *, by_path: bool) -> list[Finding]:
    """Ratios of accelerations that are not 1, with the units that explain them."""
    ratios: dict[str, Fitted] = {}
    velocity, omega = spans.drive.velocity, spans.drive.omega
    across = spans.mean(velocity.real * omega) + spans.change(velocity.imag) / spans.seconds
    causes = {"a_x": spans.change(velocity.real) / spans.seconds, "a_y": across}
    for name, caused in causes.items():
        if name in measured and (fit := _ratio(measured[name], caused, spans)) is not None:
            ratios[name] = fit
    if not ratios and (exchanged := _exchanged(measured, causes, spans)) is not None:
        return [exchanged]
    sizes = {name: float(fit.values[0]) for name, fit in ratios.items()}
    found = [_sign(name, fit) for name, fit in ratios.items() if fit.values[0] < 0]
    if all(_is_near(abs(size), 1.0) for size in sizes.values()):
        return found
    wrong = _units(sizes, by_path=by_path)
    name = next(name for name, size in sizes.items() if not _is_near(abs(size), 1.0))
    return [*found, *(_scale(name, ratios[name], quantity, unit) for quantity, unit in wrong.items())]


def _ratio(measured: Vector, caused: Vector, spans: Spans) -> Fitted | None:
    """An acceleration over what causes it, beside a bias; ``None`` where the two do not go together."""
    if not (varies(measured) and varies(caused)):
        return None
    fit = fitted(np.stack([caused, np.ones(len(spans))], axis=1), spans.mean(measured), spans.block)
    return fit if fit is not None and fit.share > _RELATED else None


def _exchanged(measured: Mapping[str, Vector], causes: Mapping[str, Vector], spans: Spans) -> Finding | None:
    """Accelerations each of which goes with what causes the other, as of a sensor that is turned by a quarter."""
    pairs = (("a_x", "a_y"), ("a_y", "a_x"))
    ratios = [_ratio(measured[one], causes[other], spans) if one in measured else None for one, other in pairs]
    if ratios[0] is None or (ratios[1] is None and "a_y" in measured):
        return None
    ratio, (low, high) = float(ratios[0].values[0]), ratios[0].interval()
    signs = ["" if fit is None or fit.values[0] > 0 else " (scale: -1)" for fit in ratios]
    return Finding(
        what=_AXES, told=f"a_x goes with {_CAUSES['a_y']}, by {number(ratio)}, and not with {_CAUSES['a_x']}", size=ratio,
        low=low, high=high, expected="x forward, y left",
        remedy=f"map what is a_x as a_y{signs[0]}, and what is a_y as a_x{signs[1]}",
    )  # fmt: skip


def _wheels(spans: Spans, measured: Vector | None) -> list[Finding]:
    """Speed of the wheels over ``v_x``: sign and scale."""
    if measured is None or not varies(measured):
        return []
    fit = fitted(spans.mean(spans.drive.velocity.real)[:, None], spans.mean(measured), spans.block)
    if fit is None or fit.share < _RELATED:
        return []
    found = [_sign("wheel_speed", fit)] if fit.values[0] < 0 else []
    (low, high), ratio = sorted(map(abs, fit.interval())), abs(float(fit.values[0]))
    if low < 1.0 + _SLIP and high > 1.0 - _SLIP:
        return found
    scale = Finding(
        what="wheel_speed_scale", told=f"wheel_speed over v_x is {number(ratio)}", size=ratio, low=low, high=high,
        expected=f"1 (within {_SLIP:g})",
        remedy=f"wheel_speed: {in_unit(1.0 / ratio, 'km/h', 'mph', 'kt', 'ft/s')}, or v_x: scale: {number(ratio)}",
    )  # fmt: skip
    return [*found, scale]


def _is_near(ratio: float, expected: float) -> bool:
    return abs(math.log(max(ratio, 1e-12) / expected)) < _TOLERANCE


def _units(sizes: Mapping[str, float], *, by_path: bool) -> dict[str, str]:
    """Units by quantity, the fewest that explain the ratios; of those that the path does not tell. Else of ``a`` none."""
    free = {name: units[:1] if by_path and name != "a" else units for name, units in _FACTORS.items()}
    best: dict[str, str] | None = None
    for units in itertools.product(*free.values()):
        v_x, omega, a = (UNITS[unit] for unit in units)
        expected = {"a_x": v_x / a, "a_y": v_x * omega / a}
        wrong = {name: unit for name, unit in zip(free, units, strict=True) if unit != _FACTORS[name][0]}
        fits = all(_is_near(abs(size), expected[name]) for name, size in sizes.items())
        if fits and (best is None or len(wrong) < len(best)):
            best = wrong
    return best if best is not None else {"a": ""}


def _sign(name: str, fit: Fitted) -> Finding:
    low, high = fit.interval()
    ratio, other = float(fit.values[0]), {"a_y": ", or omega's", "wheel_speed": ", or v_x's"}.get(name, "")
    return Finding(
        what=f"{name}_sign", told=f"{name} over {_CAUSES[name]} is {number(ratio)}", size=ratio, low=low, high=high,
        expected="1: x forward, y left", remedy=f"{name}: scale: -1{other}",
    )  # fmt: skip


def _scale(name: str, fit: Fitted, quantity: str, unit: str) -> Finding:
    """A quantity that is in another unit, or an acceleration of a scale that is none of a unit."""
    ratio, (low, high) = abs(float(fit.values[0])), sorted(map(abs, fit.interval()))
    what = {"v_x": "speed_scale", "omega": "gyro_scale", "a": f"{name}_scale"}[quantity]
    signal = {"a": "a_x, a_y"}.get(quantity, quantity)
    remedy = (
        f"{signal}: unit: {unit}" if unit else f"{name}: scale: {number(1 / ratio)}, or find what {_CAUSES[name]} lacks"
    )
    size = UNITS[unit] if unit else 1 / ratio
    return Finding(
        what=what, told=f"{name} over {_CAUSES[name]} is {number(ratio)}: a factor of {number(size)} is missing", size=size,
        low=1 / high if not unit else UNITS[unit], high=1 / low if not unit else UNITS[unit], expected="1", remedy=remedy,
    )  # fmt: skip
