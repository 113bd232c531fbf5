"""A pattern that was looked for in the errors of a channel."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from dynssm_ros.arrays import Vector

Family = Literal["time", "size", "where", "delay", "learner"]


_RECURRING = "Find what runs at that period: a sensor or filter that corrects the estimate, a task that comes late."
_GEARS = "Take gears and the gap of a change into the model (effect gear_shift)."
_LATE = "Check the actuator and the stamps; take the delay into the signal map or an effect (*_lag, odometry_delay)."
_ANSWER = "Look for what swings, gives way or has play between the input and the tyres."
_WORLD = "It stays with the road or the hall: bank, grade, wind, cameras, or the floor."
_SPIKES = "Look at the raw samples there: drop-outs of a sensor, or gears at the speeds named."
_FORCE = "Look for a resistance or a drive force that the car has there (effects drag, drive_map, gear_shift)."
ADVICE = {
    "period": _RECURRING, "period_of_size": _RECURRING, "period_of_spikes": _RECURRING,
    "echo": "Compare the time with the length of a filter or with the period of a sensor.",
    "wheel_synchronous": "Compare the way with the wheels' circumference: balance them, check rims and wheel-speed sensors.",
    "spikes": _SPIKES, "repeated": "Record the sensor at its own rate.",
    "quantised": "Take the signal with more digits.", "clipped": "Widen the range of the sensor or of its message.",
    "steering_delay": _LATE, "throttle_delay": _LATE, "answer_to_steering": _ANSWER,
    "answer_to_throttle": _ANSWER, "integrator": "Calibrate with that integrator.",
    "gear": _GEARS, "gear_and_pedal": _GEARS,
    "time_since_a_change_up_of_the_gear": _GEARS, "time_since_a_change_down_of_the_gear": _GEARS,
    "heading": _WORLD, "place_on_the_lap": _WORLD,
    "speed": _FORCE, "throttle": _FORCE, "speed_and_pedal": _FORCE,
}  # fmt: skip
"""What a team would do about a kind of pattern; others have none."""
_ALONG = (_GEARS, _FORCE)  # of v_x alone


@dataclass(frozen=True)
class Picture:
    """What a small figure of a pattern shows.

    Attributes:
        kind: ``bars`` by category, ``bins`` over a quantity, ``comb`` over a phase, ``lags``, ``levels`` of a signal.
        x, y: values drawn; ``x`` are the edges of ``bins``, one more than ``y``.
        title_x, title_y: with their units.
        spread: standard error of ``y``; empty if not known.
        labels: of ``bars``.
        mark: the part of ``x`` that the pattern is about, from and to.
    """

    kind: Literal["bars", "bins", "comb", "lags", "levels"]
    x: Vector
    y: Vector
    title_x: str
    title_y: str
    spread: Vector | None = None
    labels: tuple[str, ...] = ()
    mark: tuple[float, float] | None = None


@dataclass(frozen=True)
class Pattern:
    """A pattern of the errors of one channel.

    Attributes:
        channel: ``v_x``, ``v_y`` or ``omega``.
        family: of tests that it comes from.
        kind: what it is, one word.
        words: what it is, in the words of the field.
        share: of the channel's squared error, on stretches that it was not fitted to where it was fitted.
        p: chance of it in errors without any pattern, all of its own trials counted.
        terms: numbers that were fitted.
        size: numbers that describe it, with their units in the names.
        fitted: what it says of each error, shape ``(N,)``; ``None`` if that is not its kind.
        picture: what to draw.
    """

    channel: str
    family: Family
    kind: str
    words: str
    share: float
    p: float
    terms: int = 1
    size: dict[str, Any] = field(default_factory=dict)
    fitted: Vector | None = field(default=None, repr=False)
    picture: Picture | None = field(default=None, repr=False)

    @property
    def advice(self) -> str:
        """What a team would do about it; empty if nothing is known."""
        found = ADVICE.get(self.kind, "")
        return "" if found in _ALONG and self.channel != "v_x" else found

    def to_json(self) -> dict[str, Any]:
        """For ``results.json``."""
        return {
            "channel": self.channel, "family": self.family, "kind": self.kind, "words": self.words, "advice": self.advice,
            "share": round(self.share, 6), "p": self.p, **self.size,
        }  # fmt: skip
