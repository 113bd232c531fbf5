"""Where on the car ``v_y`` is measured: in bends it tells how far ahead of the rear axle that is.

The rear wheels roll nearly along themselves: ``v_y = l omega - (K a + K_3 a^3) v_x + d v_x`` with ``a = v_x omega``. ``l``
is the distance of the sensor from the rear axle, ``K`` and ``K_3`` the slip of the rear tyres up to their limit, ``d`` the
angle by which the sensor is turned (Gillespie, *Fundamentals of Vehicle Dynamics*, ch. 6).
"""

from __future__ import annotations

import numpy as np

from dynssm_ros.signals.actuation import turns_both_ways
from dynssm_ros.signals.findings import Finding, number
from dynssm_ros.signals.spans import Drive, fitted, varies

_SPAN_S = 0.4
_FEWEST_SPANS = 40
_OF_WHEELBASE = (0.2, 0.9)
"""Of the wheelbase, where a centre of gravity is: drives of four simulated cars, less grip and banked roads among them, give
0.33 to 0.65, logs 0.40 to 0.73. Without ``K_3`` it is -0.3 to 1.1 at the tyres' limit."""
_WIDEST = 0.15
"""Of the wheelbase: half the widest interval that is told; on ovals it is 0.2 and more."""
_RELATED = 0.4


def check_lever(drive: Drive, wheelbase: float) -> list[Finding]:
    """The distance from the rear axle at which ``v_y`` is measured, if no centre of gravity can be there; or its sign."""
    spans = drive.spans(_SPAN_S)
    ahead = spans.mean(drive.velocity.real)
    spans, ahead = spans.where(ahead > 0), ahead[ahead > 0]
    if len(spans) < _FEWEST_SPANS or not turns_both_ways(drive) or not varies(drive.velocity.imag):
        return []
    omega = spans.mean(drive.omega)
    a = ahead * omega
    design = np.stack([omega, a * ahead, a**3 * ahead, ahead, np.ones(len(ahead))], axis=1)
    fit = fitted(design, spans.mean(drive.velocity.imag), spans.block)
    if fit is None or fit.share < _RELATED:
        return []
    lever, (low, high) = float(fit.values[0]), fit.interval()
    least, most = (share * wheelbase for share in _OF_WHEELBASE)
    if high - low > 2 * _WIDEST * wheelbase or (low < most and high > least):
        return []
    told = f"v_y over omega is {number(lever)} m where tyres do not slip"
    if low < -least and high > -most and fit.values[1] > 0:
        return [
            Finding(
                what="v_y_sign", told=told, size=lever, low=low, high=high, unit="m", expected=f"{number(least)} to "
                f"{number(most)} m: y points left", remedy="v_y: scale: -1",
            )
        ]  # fmt: skip
    place = f"{number(abs(lever))} m {'ahead of' if lever > 0 else 'behind'} the rear axle"
    return [
        Finding(
            what="v_y_lever", told=f"{told}: that of a point {place}", size=lever, low=low, high=high, unit="m",
            expected=f"{number(least)} to {number(most)} m, the centre of gravity",
            remedy=f"publish v_y - ({number(lever)} - l_r) omega; of poses, x and y of the centre of gravity",
        )
    ]  # fmt: skip
