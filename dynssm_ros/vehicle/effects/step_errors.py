"""What errors of single steps tell of an effect before it is fitted: when it acts.

Some effects act at instants that no gradient finds: a correction of the estimate, a gear that changes. Their period, phase or
thresholds are read off the errors of one step; only the sizes are then fitted.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from dynssm_ros.arrays import Indices, Vector
from dynssm_ros.vehicle.gears import changes_into, gear_of

_MOST = 4.0  # standard deviations that one error counts for, at most: what recurs is told from what is large once
_LEVEL_ROWS = 7  # whose median is the level that an error is compared with
_CHANCE = 6.5  # standard deviations: with a million periods and phases tried, noise exceeds it in one drive of 10,000
_REPEATS = 12  # of the longest period, at least
_LONGEST_S = 5.0  # period that is looked for
_FEWEST_ROWS = 4  # of the shortest period
_HARMONICS = 12  # of a period that are summed up, at most
_FINER = 8  # times finer than its resolution a spectrum is looked at
_TRIED = 6  # rates of which the errors are folded
_SMOOTH = 401  # of its bins, over which the level of the noise is averaged
_OFFSETS = 4  # places within a row at which an instant is tried
_ONE_INSTANT = 0.3  # of what recurs within a period, that is at a single instant if it is a step
_ALIKE = 0.97  # of the best, from which on a rounder period is taken

_SPEEDS, _SPEED_RANGE = 40, (0.05, 0.95)  # that are tried as those of a gear change, of the speeds under throttle
_HYSTERESIS = (0.03, 0.1, 0.2, 0.3)  # of the speed for the change up, by which the one for the change down is less
_APART = 0.03  # of the speed for the change up, by which that for the change down is less at least
_FINER_SPEEDS = (0.02, 0.007)  # shares of both speeds in which the best pair is placed more finely, one after the other
_STEPS_ASIDE = (0, 1, -1, 2, -2)  # of these that are tried
_SHIFTS, _GAP_ROWS = 4, 3  # changes, at least; rows after one in which the force may have a gap
_TOGETHER_S = 0.5  # over which errors are summed up to find changes of gear: the noise of their ends does not add up
_BENT_TOGETHER_S = 1.0  # the same to find a bend, that lasts longer: evidence grows with it, as noise does not add up
_SHIFT_CHANCE = 25.0  # of twice the log-likelihood: the best pair reached 18 in 41 drives without gears
_FASTEST = 0.98  # quantile of the speeds under throttle that counts as the top speed
_BENT_CHANCE = 25.0  # of twice the log-likelihood of five columns, which chance exceeds in one drive of 7000


class StepErrors(NamedTuple):
    """Errors of ``N`` single steps from measured rows, ``T_s`` apart where nothing is missing.

    Attributes:
        rows: from which the steps were made, shape ``(7, N)``, in order of time.
        context: other signals there, each of shape ``(N,)``; has ``clock``.
        errors: measured minus predicted states after the step (m/s, m/s, rad/s), shape ``(N, 3)``.
        number: of the recording of each, shape ``(N,)``.
        T_s: length of a step (s).
    """

    rows: Vector
    context: Mapping[str, Vector]
    errors: Vector
    number: Indices
    T_s: float

    @property
    def jumps(self) -> Vector:
        """How far each error is off the level of those around it, in standard deviations, shape ``(N, 3)``; bounded."""
        side = _LEVEL_ROWS // 2
        around = np.pad(self.errors, ((side, side), (0, 0)), mode="edge")
        level = np.median(np.lib.stride_tricks.sliding_window_view(around, _LEVEL_ROWS, axis=0), axis=2)
        off = self.errors - level
        spread = 1.4826 * np.median(np.abs(off), axis=0)
        return np.asarray(np.clip(off / np.maximum(spread, 1e-12), -_MOST, _MOST))


class Recurring(NamedTuple):
    """A step that recurs."""

    period: float  # s
    phase: float  # instant of the clock at which it happens, in periods, from 0 to 1
    sure: float  # standard deviations beyond chance


def recurring_step(steps: StepErrors) -> Recurring | None:
    """The period and instant at which errors of the same sign come again and again; ``None`` if none do beyond chance.

    A spectrum whose harmonics are added up tells where to look, and folding the errors over the clock how sure it is.
    """
    clock, jumps = steps.context["clock"], steps.jumps
    whole = steps.number == np.argmax(np.bincount(steps.number))
    found: list[Recurring] = []
    for values in jumps.T:
        if not np.ptp(values) > 0.0:
            continue
        length = float(np.ptp(clock[whole]))
        for rate in _likely_rates(clock[whole], values[whole], steps.T_s):
            best = _folded(clock, values, 1.0 / rate, steps.T_s)
            for reach in (1.0, 1.0 / _FINER):  # of what the spectrum resolves, and then finer
                near = 1.0 / best.period + reach / length * np.linspace(-1.0, 1.0, 2 * _FINER + 1)
                tried = [_folded(clock, values, 1.0 / one, steps.T_s) for one in near if one > 0.0]
                best = max(tried, key=lambda one: one.sure)
            found.append(_rounded(best, clock, values, steps.T_s))
    surest = max(found, key=lambda one: one.sure, default=None)
    return surest if surest is not None and surest.sure > _CHANCE else None


def _likely_rates(clock: Vector, values: Vector, T_s: float) -> list[float]:
    """The rates (1/s) whose harmonics stand out most from the noise around them."""
    row = np.round((clock - clock.min()) / T_s).astype(np.intp)
    count = int(row.max()) + 1
    longest = min(_LONGEST_S, count * T_s / _REPEATS)
    if longest <= _FEWEST_ROWS * T_s:
        return []
    series = np.zeros(count)
    series[row] = values
    size = 1 << int(np.ceil(np.log2(_FINER * count)))
    power = np.abs(np.fft.rfft(series, size)) ** 2
    level = np.convolve(np.pad(power, _SMOOTH // 2, mode="edge"), np.full(_SMOOTH, 1.0 / _SMOOTH), mode="valid")
    power = power / np.maximum(level, 1e-300)
    df = 1.0 / (size * T_s)
    first, last = int(np.ceil(1.0 / (longest * df))), int(1.0 / (_FEWEST_ROWS * T_s * df))
    at = np.arange(first, last + 1)
    total, harmonics = np.zeros(len(at)), np.zeros(len(at))
    for k in range(1, _HARMONICS + 1):
        there = k * at < len(power)
        total[there] += power[k * at[there]]
        harmonics += there
    beyond = (total - harmonics) / np.sqrt(harmonics)
    rates = []
    for _ in range(_TRIED):
        top = int(np.argmax(beyond))
        rates.append(float(at[top] * df))
        beyond[max(0, top - 2 * _FINER) : top + 2 * _FINER + 1] = -np.inf
    return rates


def _folded(clock: Vector, values: Vector, period: float, T_s: float) -> Recurring:
    """At which instant of a period the values are most alike, and how far beyond chance."""
    bins = max(1, round(period / T_s))
    share = np.mod(clock / period, 1.0)
    fine = np.minimum((share * bins * _OFFSETS).astype(np.intp), bins * _OFFSETS - 1)
    count, total = (np.bincount(fine, w, minlength=bins * _OFFSETS) for w in (None, values))
    rows, sums = (sum(np.roll(each, -k) for k in range(_OFFSETS)) for each in (count, total))
    z = (sums - rows * values.mean()) / (np.sqrt(np.maximum(rows, 1)) * max(float(values.std()), 1e-12))
    z = np.where(rows >= _REPEATS // 2, z, 0.0)
    largest = float(np.abs(z).max())
    recurs = float((z**2).sum()) / _OFFSETS - bins  # beyond noise
    if largest**2 < _ONE_INSTANT * recurs:
        return Recurring(period, 0.0, 0.0)
    alike = np.flatnonzero(np.abs(z) > _ALIKE * largest)
    begins = alike[(alike - alike[0]) < _OFFSETS] if alike[-1] - alike[0] < _OFFSETS else _wrapped(alike, len(z))
    middle = float(np.mean(begins)) / _OFFSETS  # the window of one row from here on has the rows before the instant
    return Recurring(period, float(np.mod((middle + 1.0) / bins, 1.0)), largest)


def _wrapped(places: Indices, size: int) -> Indices:
    """Those of ``places`` on a circle of ``size`` that are within a row of the first, counted on beyond its end."""
    off = np.mod(places - places[-1] + size // 2, size) - size // 2
    return np.asarray(places[-1] + off[np.abs(off) < _OFFSETS])


def _rounded(best: Recurring, clock: Vector, values: Vector, T_s: float) -> Recurring:
    """The same with the roundest period that explains as much: sensors and filters work at round rates."""
    for digits in (1, 2, 3, 4):
        period = float(f"{best.period:.{digits}g}")
        tried = _folded(clock, values, period, T_s)
        if tried.sure >= _ALIKE * best.sure:
            return tried
    return best


def changed_above(speed: Vector, up: float, down: float) -> Vector:
    """1 from where ``speed`` has exceeded ``up`` until it falls below ``down``, else 0; in between at first by the middle."""
    told = np.where(speed > up, 1.0, np.where(speed < down, 0.0, np.nan))
    if np.isnan(told[0]):
        told[0] = float(speed[0] > (up + down) / 2)
    last = np.maximum.accumulate(np.where(np.isnan(told), 0, np.arange(len(told))))
    return np.asarray(told[last])


class _DriveErrors(NamedTuple):
    """Errors in v_x of a drive, in sums over some rows in which most of the noise of the measured states cancels."""

    v_x: Vector  # of each row (m/s), ``(N,)``
    driven: Vector  # throttle that drives, ``(N,)``
    braked: Vector  # throttle that brakes, not above 0, ``(N,)``
    together: int  # rows of a sum
    error: Vector  # sums, limited, less what the basis explains, ``(M,)``
    basis: Vector  # orthonormal columns of what is no news, ``(M, k)``

    @classmethod
    def of(cls, steps: StepErrors, seconds: float, bent: bool) -> _DriveErrors | None:
        """No news is what the car's coefficients explain, and what else is smooth if ``bent``; ``None`` without errors."""
        v_x, r = steps.rows[0], steps.rows[3] + steps.rows[5]
        driven, braked, v = np.maximum(r, 0.0), np.minimum(r, 0.0), v_x / max(float(np.abs(v_x).max()), 1e-9)
        together = max(1, round(seconds / steps.T_s))
        smooth = [np.ones_like(v), v**2, r, r * v]
        smooth += [v, driven, driven * v, driven * v**2, driven**2] if bent else []
        columns = np.stack(smooth, axis=1)
        columns += 1e-9 * np.random.default_rng(0).standard_normal(columns.shape)  # of full rank whatever was driven
        basis, error = np.linalg.qr(_summed(columns, together))[0], _summed(steps.errors[:, :1], together)[:, 0]
        error = error - basis @ (basis.T @ error)
        limit = _MOST * 1.4826 * np.median(np.abs(error))
        error = np.clip(error, -limit, limit)
        error = error - basis @ (basis.T @ error)
        return cls(v_x, driven, braked, together, error, basis) if float(error @ error) > 0.0 else None

    def sure(self, columns: Vector) -> float:
        """Twice the log-likelihood that forces ``(N, j)`` add."""
        force = _summed(columns, self.together)
        force = force - self.basis @ (self.basis.T @ force)
        along = force.T @ self.error
        left = float(self.error @ self.error)
        taken = float(along @ np.linalg.lstsq(force.T @ force, along, rcond=1e-9)[0])
        return len(self.error) * float(np.log(left / max(left - taken, 1e-9 * left)))

    def sure_of_shifts(self, up: float, down: float) -> float:
        """Twice the log-likelihood of a force that is another one above these speeds, with a gap where they are passed."""
        gear = changed_above(self.v_x, up, down)
        passed = np.abs(np.diff(gear, prepend=gear[0]))
        gap = sum(np.concatenate([np.zeros(k), passed[: len(passed) - k]]) for k in range(_GAP_ROWS))
        if not _SHIFTS <= passed.sum() <= len(gear) / (4 * _GAP_ROWS):
            return 0.0
        return self.sure(np.stack([self.driven * gear, self.driven * gap], axis=1))


def _summed(columns: Vector, together: int) -> Vector:
    """Sums of so many rows each of columns ``(N, k)``."""
    whole = len(columns) // together * together
    return np.asarray(columns[:whole].reshape(-1, together, columns.shape[1]).sum(axis=1))


def bent_drive(steps: StepErrors) -> float | None:
    """The largest speed (m/s) under throttle if errors in v_x bend over throttle or speed, or differ under the brakes."""
    drive = _DriveErrors.of(steps, _BENT_TOGETHER_S, bent=False)
    if drive is None or not drive.driven.any():
        return None
    top = float(np.quantile(drive.v_x[drive.driven > 0.0], _FASTEST))
    v, driven, braked = drive.v_x / max(top, 1e-9), drive.driven, drive.braked
    bent = np.stack([driven**2, driven**2 * v, driven * v**2, braked, braked * v], axis=1)
    return float(f"{top:.2g}") if drive.sure(bent) > _BENT_CHANCE else None


def shift_speeds(steps: StepErrors) -> tuple[float, float] | None:
    """Speeds (m/s) above and below which the drive force changes, upwards and downwards; ``None`` if it does not change.

    Tried are the usual speeds of the changes into each gear where the recording tells the gear, else a grid of speeds.
    Compared is what a smooth function of speed and throttle leaves of the errors in v_x, with and without a force that is
    another one above the speeds, and a gap in it where they are passed. The best of the grid is then placed more finely.
    """
    drive = _DriveErrors.of(steps, _TOGETHER_S, bent=True)
    if drive is None or np.count_nonzero(drive.driven) < 2 * _SPEEDS:
        return None
    told = _told_speeds(steps)
    tried = _grid_of_speeds(drive.v_x[drive.driven > 0.0]) if told is None else told
    sure, found = max(((drive.sure_of_shifts(*pair), pair) for pair in tried), default=(0.0, None))
    if found is None or sure < _SHIFT_CHANCE:
        return None
    for share in _FINER_SPEEDS if told is None else ():
        near = (
            (found[0] * (1.0 + share * k), found[1] * (1.0 + share * j)) for k in _STEPS_ASIDE for j in _STEPS_ASIDE
        )
        apart = [pair for pair in near if pair[1] <= (1.0 - _APART) * pair[0]]
        found = max(apart, key=lambda pair: drive.sure_of_shifts(*pair))
    return found


def _grid_of_speeds(driving: Vector) -> list[tuple[float, float]]:
    """Speeds for the change up and down that a gear may have, of those under throttle."""
    ups = np.unique(np.quantile(driving, np.linspace(*_SPEED_RANGE, _SPEEDS)))
    return [(float(up), float(up * (1.0 - share))) for up in ups for share in _HYSTERESIS]


def _told_speeds(steps: StepErrors) -> list[tuple[float, float]] | None:
    """Median speeds of the measured changes into each gear, up and down; ``None`` where no gear is told."""
    v_x = steps.rows[0]
    gear = gear_of(steps.context, v_x)
    if gear is None:
        return None
    found = []
    for number in np.unique(gear)[1:].tolist():
        changes = changes_into(gear, v_x, number)
        if len(changes.up) and len(changes.down):
            up = float(np.median(changes.up))
            found.append((up, min(float(np.median(changes.down)), (1.0 - _APART) * up)))
    return found
