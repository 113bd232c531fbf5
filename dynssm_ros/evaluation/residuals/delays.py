"""Patterns of delay: errors that vanish if an input acts later or earlier, or if the model is stepped otherwise."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from dynssm_ros.arrays import Indices, Vector
from dynssm_ros.evaluation.residuals.errors import OneStepErrors, PhysicsResponse
from dynssm_ros.evaluation.residuals.evidence import chances, limited, regression, share_explained, sums_of_blocks
from dynssm_ros.evaluation.residuals.patterns import Pattern, Picture
from dynssm_ros.signals.recording import COLUMN_UNITS
from dynssm_ros.signals.signal_map import STATE_SIGNALS

_LAGS_S = (-0.2, 0.5)
"""Delays that are tried (s), those that :mod:`dynssm_ros.signals.timing` expects of cars."""
_DRAWS = 100
_GAIN = (0.2, 2.0)
"""Of the change that a delay makes by the physics, which must be in the errors: another pattern has another size."""
_LIKE_A_DELAY = 0.8  # of what the best delay explains, which fits two numbers; 0.89 where another integrator was right
_LATELY = (0, 2, 5, 10)  # rows before, of whose inputs the change by another integrator follows
_STEPS_GAIN = (0.65, 1.35)
"""The same of the change by another integrator, which has no size of its own: 0.7 to 1.0 where drives had it, 1.4 to 2.0 of
omega where the steering was a sample or two late."""


def delays(errors: OneStepErrors, values: Vector, channel: int, slopes: Vector) -> Iterator[Pattern]:
    """Looks for the delay of throttle and steering in the errors ``values`` ``(N,)`` of a channel.

    Args:
        errors: of the model.
        values: its errors in this channel, less the patterns found before.
        channel: number of it.
        slopes: how the predicted state depends on the last row's signals, shape ``(N, 3, 5)``.

    Yields:
        For each input the delay that explains most, with its 95 % interval by a bootstrap over blocks.
    """
    y, name = limited(values), STATE_SIGNALS[channel]
    lags = np.arange(round(_LAGS_S[0] / errors.T_s), round(_LAGS_S[1] / errors.T_s) + 1)
    for k, (signal, column) in enumerate(errors.inputs.items()):
        slope = slopes[:, channel, len(STATE_SIGNALS) + k]
        now = column[errors.rows]
        changes = [slope * (now - errors.before(column, int(lag))) for lag in lags]
        cross = np.stack([sums_of_blocks(y * change, errors.block) for change in changes])
        square = np.stack([sums_of_blocks(change**2, errors.block) for change in changes])
        total = sums_of_blocks(y**2, errors.block)
        share = _shares(cross, square, total, np.ones(len(total)))
        share[lags == 0] = 0.0
        best = int(np.argmax(share))
        if share[best] <= 0:
            continue
        p = min(1.0, len(lags) * float(chances(cross[best][:, None])[0]))
        fitted, apart, gain = _halves(values, changes[best], errors)
        if not _GAIN[0] <= gain <= _GAIN[1]:
            continue
        value = _top(share, best, lags) * errors.T_s
        low, high = np.percentile(_drawn(cross, square, total, lags), [2.5, 97.5]) * errors.T_s
        low, high = min(float(low), value - errors.T_s / 2), max(float(high), value + errors.T_s / 2)
        if low <= 0.0 <= high:
            continue
        late = "later" if value > 0 else "earlier"
        told = (
            f"{name} answers the {signal} {1e3 * abs(value):.0f} ms {late} than the model "
            f"({1e3 * low:.0f} to {1e3 * high:.0f} ms)"
        )
        seconds = lags.astype(np.float64) * errors.T_s
        picture = Picture("lags", 1e3 * seconds, 100 * share, f"delay of the {signal} (ms)",
                          f"% of the squared error\nof {name} explained", None, (), (1e3 * low, 1e3 * high))  # fmt: skip
        yield Pattern(
            name, "delay", f"{signal}_delay", told, share_explained(values, apart), p, 2,
            {"delay_s": round(value, 6), "low_s": round(low, 6), "high_s": round(high, 6)}, fitted, picture,
        )  # fmt: skip


def other_steps(errors: OneStepErrors, physics: PhysicsResponse, level: float) -> Pattern | None:
    """The difference that another integrator makes, in the channel where it is most of the errors.

    It has to explain errors of all channels together, to be about as large as it should be in each channel where it is sure,
    and to be no delay. Its size is that of the part that follows from the inputs: noise of the state is in both.

    Args:
        errors: of the model.
        physics: its predictions by the other integrator.
        level: chance of a false alarm.
    """
    if physics.otherwise is None:
        return None
    change, square = -physics.otherwise, errors.values**2
    gone = square - (errors.values - change) ** 2
    if not np.any(change) or not np.all(square.any(axis=0)):
        return None
    share = gone.sum(axis=0) / square.sum(axis=0)
    driven = np.stack([regression(column, _driving(errors), errors.block)[0] for column in change.T], axis=1)
    both = (errors.values * driven).sum(axis=0), (change * driven).sum(axis=0)
    gain = both[0] / np.maximum(both[1], 1e-300)
    tested = (gone @ (1.0 / square.mean(axis=0)), *(errors.values * driven).T)
    together, *p = chances(np.stack([sums_of_blocks(each, errors.block) for each in tested], axis=1))
    sure = np.array(p) < level
    right = (gain >= _STEPS_GAIN[0]) & (gain <= _STEPS_GAIN[1])
    like = sure & right & (share > 0)
    if tested[0].sum() <= 0 or together > level or not like.any() or (sure & ~right).any():
        return None
    c = int(np.argmax(np.where(like, share, -np.inf)))
    late = (each.share for each in delays(errors, errors.values[:, c], c, physics.slopes))
    if share[c] < _LIKE_A_DELAY * max(late, default=0.0):
        return None
    name, (own, other) = STATE_SIGNALS[c], physics.integrators
    told = (
        f"{name} errs as {own} steps differ from {other} ones (calibrate with --integrator {other}); "
        f"the rest is with {other}"
    )
    size = np.sqrt([square[:, c].mean(), ((errors.values - change)[:, c] ** 2).mean()])
    drawn = Picture(
        "bars", np.arange(2.0), size, "", f"RMS of {name} ({COLUMN_UNITS[name]})", None, (own, other), (1, 1)
    )
    return Pattern(
        name, "delay", "integrator", told, float(share[c]), float(p[c]), 1, {"integrator": other}, None, drawn
    )


def _driving(errors: OneStepErrors) -> Vector:
    """What the inputs were of late at the speed of then, ``(N, k)``."""
    speed = errors.driven[:, 0] / max(float(np.mean(errors.driven[:, 0])), 1e-9)
    late = [errors.before(column, lag) for column in errors.inputs.values() for lag in _LATELY]
    return np.stack([np.ones(len(errors)), *(column * speed**power for column in late for power in range(3))], axis=1)


def _shares(cross: Vector, square: Vector, total: Vector, weight: Vector) -> Vector:
    """Share explained at each lag, of sums by lag and block, ``(lags,)``; none where the error has the other sign."""
    across = cross @ weight
    return np.maximum(across, 0.0) ** 2 / np.maximum((square @ weight) * (total @ weight), 1e-300)


def _halves(values: Vector, change: Vector, errors: OneStepErrors) -> tuple[Vector, Vector, float]:
    half = errors.block % 2
    gains = [
        float(values[half == h] @ change[half == h]) / max(float(change[half == h] @ change[half == h]), 1e-300)
        for h in (0, 1)
    ]
    gain = float(values @ change) / max(float(change @ change), 1e-300)
    return gain * change, np.asarray(gains)[1 - half] * change, gain


def _top(share: Vector, best: int, lags: Indices) -> float:
    """The top of the parabola through the best lag and its neighbours."""
    if 0 < best < len(share) - 1 and lags[best - 1] * lags[best + 1] > 0:
        before, at, after = share[best - 1 : best + 2]
        bent = before - 2 * at + after
        if bent < 0:
            return float(lags[best] + 0.5 * (before - after) / bent)
    return float(lags[best])


def _drawn(cross: Vector, square: Vector, total: Vector, lags: Indices) -> Vector:
    """Best lags of drives that are drawn from the blocks."""
    rng, blocks, found = np.random.default_rng(0), len(total), []
    for _ in range(_DRAWS):
        weight = sums_of_blocks(np.ones(blocks), np.sort(rng.integers(0, blocks, blocks)))
        weight = np.pad(weight, (0, blocks - len(weight)))
        share = np.where(lags == 0, 0.0, _shares(cross, square, total, weight))
        found.append(_top(share, int(np.argmax(share)), lags))
    return np.array(found)
