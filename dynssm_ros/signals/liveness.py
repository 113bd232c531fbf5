"""Signals that do not live or are not of the car: constant where it moves, clipped, in coarse steps, with single spikes."""

from __future__ import annotations

import numpy as np

from dynssm_ros.arrays import Indices, Mask, Vector
from dynssm_ros.signals.actuation import LARGE_RAD
from dynssm_ros.signals.findings import Finding, number
from dynssm_ros.signals.motion import WITHOUT_V_Y, Checked
from dynssm_ros.signals.spans import SIGMAS, Drive, varies

_TURNS_RAD_S, _BOTH_WAYS = 0.02, 0.3
"""Rate of turning that shows (rad/s); share of the largest that it has to both sides."""
_SWING, _SWINGS = 0.3, 4
"""Change of the speed, as a share of the largest, and how often it goes up and down by that."""
_CLIPPED_SHARE, _CLIPPED_S = 0.01, 0.2
"""Share of rows at the very largest value, and the time at a stretch, that no sensor shows that is not clipped."""
_FROZEN_S = 1.0
"""Time at a stretch for which no odometry of a driving car repeats itself; slow ones are interpolated between samples."""
_DEAD_S = 5.0
"""Likewise of a single signal while the car turns to both sides, or its speed swings: on circles and straights it may."""
_DROP, _DROP_EDGE_S, _DROPS, _DROPS_S = 0.25, 0.1, 3, 1.0
"""A signal drops out where it is exactly 0 though so long before and after (s) it is this far to the same side, as a share of
its usual range; how many make a finding, or how long they last in all (s)."""
_DROP_STEERED_S, _STILL_TURNS = 0.5, 0.5
"""A steering may be let go: how long it is 0 at least (s), and what is left of the rate of turning meanwhile."""
_STEP = 0.3
"""Step of a signal in units of its standard deviation, from which on it is coarse."""
_SPIKE, _SPIKE_SHARE = 15.0, 0.05
"""How far off its neighbours a spike is: in standard deviations of that, and as a share of the signal's usual range."""
_IMPOSSIBLE = {"v_x": 150.0, "v_y": 150.0, "omega": 50.0, "steering": LARGE_RAD, "throttle": 1.5}
"""Larger values no car has, in SI units; what other units are taken for is larger throughout."""
_WILD, _WILD_SHARE = 5.0, 0.02
"""Range of the usual values, beyond which an impossible one is wild; share of rows that is left out of that range."""
_SPIKES, _SPIKES_SHARE = 5, 0.01
"""How many make a finding (a healthy motion capture log has four), and how many a row there are at most: more are noise."""


def check_liveness(drive: Drive) -> list[Finding]:
    """Constants, clipping, coarse steps and spikes."""
    lost = _drops_out(drive)
    found = [*_constants(drive), *_frozen(drive), *lost]
    found += [] if found else _dies(drive)
    dead = _names(found) | {each.what.removesuffix("_frozen") for each in lost}
    for name, values in (("v_x", drive.velocity.real), ("v_y", drive.velocity.imag), ("omega", drive.omega)):
        if name not in dead and varies(values):
            found += _coarse(name, values) or _clipped(name, values, drive) or _spikes(name, values, drive)
    return found


def check_wild(drive: Drive) -> Checked:
    """A few values that no car has among others, as logs write where a value is missing (9999, 655.35).

    Each stands for thousands of rows in whatever is averaged. The drive comes back with what is between its neighbours, also
    where they are too few to be told.
    """
    found: list[Finding] = []
    mended: dict[str, Vector] = {}
    signals = {"v_x": drive.velocity.real, "v_y": drive.velocity.imag, "omega": drive.omega}
    signals |= {"steering": drive.steering, "throttle": drive.throttle}
    for name, values in signals.items():
        low, high = np.percentile(values, [100.0 * _WILD_SHARE, 100.0 * (1.0 - _WILD_SHARE)])
        beyond = np.maximum(low - values, values - high) > _WILD * (high - low)
        wild = beyond & (np.abs(values) > _IMPOSSIBLE[name])
        if not wild.any():
            continue
        rows, share, most = np.arange(len(values)), float(wild.mean()), float(values[np.argmax(np.abs(values))])
        mended[name] = np.interp(rows, rows[~wild], values[~wild])
        if wild.sum() < _SPIKES:
            continue
        found.append(
            Finding(
                what=f"{name}_spikes", told=f"{name} is up to {number(most)} in {100 * share:.2g} % of the rows, "
                f"{number(float(low))} to {number(float(high))} else", size=share, low=share, high=share,
                expected="values that a car has",
                remedy="find what the log writes where a value is missing, and leave those cells empty",
            )
        )  # fmt: skip
    velocity = mended.pop("v_x", signals["v_x"]) + 1j * mended.pop("v_y", signals["v_y"])
    return found, drive.changed(velocity=velocity, **mended)


def _constants(drive: Drive) -> list[Finding]:
    moving = (drive.speed >= drive.least_speed) & (drive.speed > 0)
    turn = _turn_rate(drive)
    turns = float(np.sqrt(np.mean(turn[moving] ** 2))) if moving.any() else 0.0
    found = []
    if turns > _TURNS_RAD_S and drive.speed.max(initial=0.0) > 0:
        for name, values, what in (("omega", drive.omega, "turns"), ("v_y", drive.velocity.imag, "turns")):
            if np.ptp(values) == 0:
                found.append(_constant(name, float(values[0]), what, turns))
        low, high = np.percentile(turn[moving], [5.0, 95.0])
        if np.ptp(drive.steering) == 0 and min(-low, high) > _BOTH_WAYS * max(-low, high):
            found.append(_constant("steering", float(drive.steering[0]), "turns to both sides", turns))
    swings = _swings(drive)
    if swings >= _SWINGS and np.ptp(drive.throttle) == 0:
        found.append(_constant("throttle", float(drive.throttle[0]), f"gains and loses speed {swings} times", swings))
    if drive.position is not None and drive.speed.min(initial=1.0) > 0 and np.ptp(np.abs(drive.position)) == 0:
        found.append(_constant("pose", 0.0, "drives", float(drive.speed.mean())))
    heading = drive.theta
    if heading is not None and np.ptp(heading) == 0 and turns > _TURNS_RAD_S and "pose" not in _names(found):
        found.append(_constant("theta", float(heading[0]), "turns", turns))
    return found


def _names(found: list[Finding]) -> set[str]:
    return {each.what.removesuffix("_constant") for each in found}


_REMEDIES = {
    "omega": "take omega from a gyro, or give `velocities:` with the pose",
    "v_y": WITHOUT_V_Y,
    "steering": "steering_feedback: map the measured or commanded angle",
    "throttle": "throttle_feedback: map what drives the car",
    "theta": "leave x, y, theta out, or map what measures the heading",
    "pose": "leave x, y, theta out, or map the localisation",
}


def _constant(name: str, value: float, though: str, size: float) -> Finding:
    told = f"{name} is {number(value)} throughout although the car {though}"
    return Finding(
        what=f"{name}_constant", told=told, size=size, low=size, high=size, expected="a signal that lives",
        remedy=_REMEDIES[name],
    )  # fmt: skip


def _frozen(drive: Drive) -> list[Finding]:
    """An odometry that repeats itself while the inputs go on."""
    values = [drive.velocity.real, drive.velocity.imag, drive.omega]
    values += [] if drive.position is None else [drive.position.real, drive.position.imag]
    same = _repeats(drive, *values) & (drive.speed >= drive.least_speed) & (drive.speed > 0)
    moves = (np.diff(drive.steering, prepend=0.0) != 0) | (np.diff(drive.throttle, prepend=0.0) != 0)
    stays = _longest_run(same) * drive.T_s
    if stays < _FROZEN_S or not (same & moves).any():
        return []
    share = float(same.mean())
    told = (
        f"the odometry repeats itself in {100 * share:.2g} % of the rows, up to {stays:.3g} s, while the inputs go on"
    )
    return [
        Finding(
            what="odometry_frozen", told=told, size=share, low=share, high=share, expected="an odometry that lives",
            remedy="find why it stops (sensor, filter, network), or leave those rows out",
        )
    ]  # fmt: skip


def _dies(drive: Drive) -> list[Finding]:
    """A signal that stays as it is for long: a steering while the car turns to both sides, a yaw rate while the heading
    turns faster and slower, a throttle while the speed swings.
    """
    inputs = {"steering": drive.steering, "throttle": drive.throttle}
    has_heading = drive.theta is not None and np.ptp(drive.theta) > 0
    found = []
    for name, values in (inputs | {"omega": drive.omega} if has_heading else inputs).items():
        first, last = _longest_at(_repeats(drive, values))
        seconds = (last - first) * drive.T_s
        if seconds < _DEAD_S:
            continue
        turn = _turn_rate(drive)[first:last]
        low, high = np.percentile(turn, [5.0, 95.0])
        turns, most = float(np.sqrt(np.mean(turn**2))) >= _TURNS_RAD_S, _BOTH_WAYS * max(-low, high)
        does = {
            "steering": "turns to both sides" if turns and min(-low, high) >= most else "",
            "omega": "turns faster and slower" if turns and high - low >= most else "",
            "throttle": "gains and loses speed" if _swings(drive, slice(first, last)) >= _SWINGS else "",
        }[name]
        if does:
            stays = f"{name} stays at {number(float(values[first]))} for {seconds:.3g} s"
            found.append(
                Finding(
                    what=f"{name}_frozen", told=f"{stays} although the car {does}", size=seconds, low=seconds, high=seconds,
                    unit="s", expected="a signal that lives", remedy="find why it stops, or leave those rows out",
                )
            )  # fmt: skip
    return found


def _drops_out(drive: Drive) -> list[Finding]:
    """A signal that is exactly 0 for rows, and before and after as if nothing had been: what has no value is written as 0."""
    signals = {"v_x": drive.velocity.real, "omega": drive.omega, "steering": drive.steering}
    turn, least_rows = np.abs(_turn_rate(drive)), _DROP_STEERED_S / drive.T_s
    found = []
    for name, values in signals.items():
        runs = _zeros(values, drive)
        if name == "steering":
            runs = [
                (first, last) for first, last in runs if last - first >= least_rows and _turns_on(turn, first, last)
            ]
        seconds = sum(last - first for first, last in runs) * drive.T_s
        if len(runs) < _DROPS and seconds < _DROPS_S:
            continue
        stretches = "1 stretch" if len(runs) == 1 else f"{len(runs)} stretches"
        told = f"{name} is exactly 0 in {stretches} of {seconds:.3g} s in all, between values far from it"
        found.append(
            Finding(
                what=f"{name}_frozen", told=told, size=seconds, low=seconds, high=seconds, unit="s",
                expected="a signal that lives",
                remedy="find why it drops out (plug, network, driver), or leave those rows out",
            )
        )  # fmt: skip
    return found


def _zeros(values: Vector, drive: Drive) -> list[tuple[int, int]]:
    """Runs of exact zeros, first row and the row after, that lie between values far to the same side."""
    edge = max(1, round(_DROP_EDGE_S / drive.T_s))
    least = _DROP * float(np.ptp(np.percentile(values, [2.0, 98.0])))
    starts, ends = _runs(values == 0.0)
    inside = (starts >= edge) & (ends + edge <= len(values))
    starts, ends = starts[inside], ends[inside]
    before, after = starts - edge, ends + edge - 1
    far = np.minimum(np.abs(values[before]), np.abs(values[after])) > least
    same = (np.sign(values[before]) == np.sign(values[after])) & (drive.segment[before] == drive.segment[after])
    return list(zip(starts[far & same].tolist(), ends[far & same].tolist(), strict=True))


def _turns_on(turn: Vector, first: int, last: int) -> bool:
    """Whether a car that turns so fast (rad/s) goes on doing so between two rows as before them and after."""
    return bool(turn[first:last].mean() > _STILL_TURNS * max(turn[first - 1], turn[last], _TURNS_RAD_S))


def _repeats(drive: Drive, *signals: Vector) -> Mask:
    """Rows at which all these signals are as in the row before."""
    same = [np.diff(each, prepend=np.nan) == 0 for each in signals]
    return np.logical_and.reduce([np.diff(drive.segment, prepend=-1) == 0, *same])  # type: ignore[no-any-return]


def _turn_rate(drive: Drive) -> Vector:
    """Rate of turning by the heading, the yaw rate where there is none, or the steering (rad/s), ``(N,)``."""
    if drive.theta is not None and np.ptp(drive.theta) > 0:
        step = max(1, round(0.2 / drive.T_s))
        found = np.zeros(len(drive))
        same = drive.segment[step:] == drive.segment[:-step]
        found[step:] = np.where(same, (drive.theta[step:] - drive.theta[:-step]) / (step * drive.T_s), 0.0)
        return found
    return drive.omega if np.ptp(drive.omega) > 0 else drive.steering


def _swings(drive: Drive, rows: slice = slice(None)) -> int:
    """How often the speed goes up or down by a share of its largest, in some ``rows``."""
    speed = drive.speed[rows][:: max(1, round(0.2 / drive.T_s))]
    least, count, way = _SWING * float(np.percentile(drive.speed, 99)), 0, 0
    low = high = float(speed[0]) if len(speed) else 0.0
    for value in speed.tolist():
        low, high = min(low, value), max(high, value)
        if way <= 0 and value - low > least:
            count, way, high = count + 1, 1, value
        elif way >= 0 and high - value > least:
            count, way, low = count + 1, -1, value
    return count


def _clipped(name: str, values: Vector, drive: Drive) -> list[Finding]:
    """A signal that stays at its largest value."""
    for end in (float(values.max()), float(values.min())):
        at = (values == end) & (np.abs(values) > 0.5 * np.abs(values).max())
        stays = _longest_run(at) * drive.T_s
        if at.mean() > _CLIPPED_SHARE and stays >= _CLIPPED_S and len(_runs(at)[0]) > 1:
            told = f"{name} is exactly {number(end)} in {100 * at.mean():.2g} % of the rows, up to {stays:.2g} s at a stretch"
            return [
                Finding(
                    what=f"{name}_clipped", told=told, size=end, low=end, high=end, expected="no such limit",
                    remedy="a sensor with a larger range, or leave those rows out",
                )
            ]  # fmt: skip
    return []


def _runs(at: Mask) -> tuple[Indices, Indices]:
    """First rows of the runs, and the rows after their last."""
    first, last = np.flatnonzero(np.diff(at.astype(int), prepend=0, append=0)).reshape(-1, 2).T
    return first, last


def _longest_run(at: Mask) -> int:
    first, last = _longest_at(at)
    return last - first


def _longest_at(at: Mask) -> tuple[int, int]:
    """First row of the longest run, and the row after it."""
    if not at.any():
        return 0, 0
    first, last = _runs(at)
    longest = np.argmax(last - first)
    return int(first[longest]), int(last[longest])


def _coarse(name: str, values: Vector) -> list[Finding]:
    """A signal that knows few values."""
    kinds, counts = np.unique(values, return_counts=True)
    common = kinds[counts >= 3]
    if counts[counts >= 3].sum() < 0.5 * len(values) or len(common) < 2:
        return []
    step, spread = float(np.median(np.diff(common))), float(values.std())
    if step < _STEP * spread:
        return []
    return [
        Finding(
            what=f"{name}_coarse", told=f"{name} comes in steps of {number(step)}", size=step, low=step, high=step,
            expected=f"steps below {number(_STEP * spread)}", remedy="find the field that is not rounded",
        )
    ]  # fmt: skip


def _spikes(name: str, values: Vector, drive: Drive) -> list[Finding]:
    """A signal that leaves for a row or two and comes back, again and again: no car moves like that."""
    if len(values) < 5:
        return []
    five = np.lib.stride_tricks.sliding_window_view(values, 5)
    off = np.where(drive.segment[4:] == drive.segment[:-4], five[:, 2] - np.median(five, axis=1), 0.0)
    usual = float(np.ptp(np.percentile(values, [2.0, 98.0])))
    spread = 1.4826 * float(np.median(np.abs(off[off != 0.0]))) if (off != 0.0).any() else 0.0
    at = np.abs(off) > max(_SPIKE * spread, _SPIKE_SHARE * usual)
    count, minutes = len(_runs(at)[0]), len(values) * drive.T_s / 60.0
    if count < _SPIKES or count > _SPIKES_SHARE * len(values):
        return []
    rate, half, size = count / minutes, SIGMAS * float(np.sqrt(count)) / minutes, float(np.median(np.abs(off[at])))
    return [
        Finding(
            what=f"{name}_spikes", told=f"{name} jumps by {number(size)} and back {number(rate)} times a minute", size=rate,
            low=max(rate - half, 0.0), high=rate + half, unit="1/min", expected="no spikes of a row or two",
            remedy="find where they come from (plug, radio, a filter's restart), or leave those rows out",
        )
    ]  # fmt: skip
