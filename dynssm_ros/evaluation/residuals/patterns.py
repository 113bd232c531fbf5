"""A pattern that was looked for in the errors of a channel."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from dynssm_ros.arrays import Vector

Family = Literal["time", "size", "where", "delay", "learner"]


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

    def to_json(self) -> dict[str, Any]:
        """For ``results.json``."""
        return {
            "channel": self.channel, "family": self.family, "kind": self.kind, "words": self.words,
            "share": round(self.share, 6), "p": self.p, **self.size,
        }  # fmt: skip
