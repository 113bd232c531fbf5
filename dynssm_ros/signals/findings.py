"""A finding: what of a recording's signals cannot be right, how large it is, and what mends it."""

from __future__ import annotations

from collections.abc import Sequence

from pydantic import Field

from dynssm_ros.configuration import StrictModel


class Finding(StrictModel):
    """A contradiction between signals."""

    what: str = Field(description="key, as steering_scale: the signals, then the quantity that is wrong")
    told: str = Field(description="what it is, in words with the size")
    size: float = Field(description="measured value of that quantity")
    low: float = Field(description="lower end of its 95 % interval")
    high: float = Field(description="upper end of its 95 % interval")
    unit: str = Field(default="1", description="of size, low and high")
    expected: str = Field(description="of signals that are right")
    remedy: str = Field(description="what to write into the signal map, or to do")

    @property
    def words(self) -> str:
        """One line: what, size with its interval if it has one, what was expected, and the remedy."""
        low, high = number(self.low), number(self.high)
        between = f" ({low} to {high})" if low != high else ""
        return f"{self.told}{between}; expected {self.expected}: {self.remedy}"

    @property
    def line(self) -> str:
        """The line with its key in front."""
        return f"{self.what}: {self.words}"


def number(value: float) -> str:
    """Three digits; 0.50 rather than 0.5."""
    short = f"{value:#.3g}" if abs(value) >= 1.0 else f"{value:.2f}" if abs(value) >= 0.1 else f"{value:.2g}"
    return short.rstrip(".")


def merged(several: Sequence[tuple[Finding, ...]]) -> tuple[Finding, ...]:
    """The findings of several recordings, each once."""
    return tuple(dict.fromkeys(finding for findings in several for finding in findings))
