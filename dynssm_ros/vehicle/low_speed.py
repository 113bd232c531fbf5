"""Low-speed rolling model: below the speed at which the tyres respond within one step, the wheels roll without slip."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from dynssm_ros.vehicle.single_track import Array, Coefficients, Motion, StageEffect, rolling, settling_rate

if TYPE_CHECKING:
    from dynssm_ros.vehicle.parameters import Vehicle


class LowSpeedRolling(StageEffect):
    """Takes the place of the tyres at low speed: the wheels roll without slip, forwards or backwards.

    The tyres' response quickens as the car slows down. Below the speed at which it is as quick as the integrator's steps
    forward Euler rings.

    Args:
        vehicle: the car.
        step: of the integrator (s).
    """

    def __init__(self, vehicle: Vehicle, step: float) -> None:
        self._step = step
        self.speed = settling_rate(Coefficients(*vehicle.nominal.tolist()), vehicle.constants) * step / 2
        """Speed up to which the wheels roll (m/s)."""

    def accelerations(self, xp: Any, q: Motion) -> None:
        """Sets the rates of the state such that it rolls within one step, and comes to rest before it turns back."""
        rest = -q.v_x / self._step
        turns = (q.a_x < rest) * (q.v_x > 0) + (q.a_x > rest) * (q.v_x < 0)
        a_x = _where(turns, rest, q.a_x)
        slow = abs(q.v_x) <= self.speed
        rates = (a_x, *rolling(xp, q, self._step))
        q.a_x, q.a_y, q.omega_dot = (
            _where(slow, *pair) for pair in zip(rates, (q.a_x, q.a_y, q.omega_dot), strict=True)
        )


def _where(condition: Array, one: Array, other: Array) -> Array:
    """``one`` where ``condition`` holds, else ``other``; also of casadi symbols."""
    return condition * one + (1 - condition) * other
