"""When a controller brakes, why, and when it drives on: two states.

It drives until something is wrong that it cannot drive with; then it brakes. It drives on when nothing was wrong for several
odometry messages in a row. If its pose jumped it stands first, until the pose has come back or is set anew: which of the two
places was right cannot be told. Where its odometry was wrong again and again, it stays where it is.
"""

from __future__ import annotations

import math

from dynssm_ros.signals.history import Refusal

AT_ONCE = frozenset(
    {
        Refusal.STANDS_STILL,
        Refusal.MAP_FRAME,
        Refusal.SPEED_SIGN,
        Refusal.SPEED_UNIT,
        Refusal.CONTRADICTION,
        Refusal.FRAMES,
    }
)
"""What is wrong with odometry for longer than a message: it is braked for at once. Others are braked for if they last."""
_WELL_S = 0.1  # of good odometry before it drives on
_AGAIN_S = 30.0  # of driving, within which odometry that is wrong again is not by chance
_TIMES = 3  # that it is believed again


class Brakes:
    """The state of the brakes.

    Args:
        T_s: time between odometry messages that are answered (s).
        standing: speed (m/s) below which the car stands.
    """

    def __init__(self, T_s: float, standing: float) -> None:
        self._enough = max(2, math.ceil(_WELL_S / T_s))
        self.standing = standing
        """Below that speed the car stands (m/s)."""
        self.reason = ""
        """Why it brakes, in words; empty while it drives."""
        self.count = 0
        """How often it began to brake."""
        self._well = 0
        self._soon = math.ceil(_AGAIN_S / T_s)
        self._driven = self._soon  # messages since it drives
        self._times = 0  # that odometry was wrong, each soon after the one before
        self.until_standing = False
        """Whether the car has to stand before it drives on, as it may be elsewhere."""
        self.waits = False
        """Whether it stands, and its pose is all that is wrong."""

    @property
    def stays(self) -> bool:
        """Whether it drives no more."""
        return self._times > _TIMES

    def apply(self, reason: str, *, until_standing: bool = False, doubted: bool = False) -> None:
        """Something is wrong.

        Args:
            reason: what, in words.
            until_standing: whether the car has to stand before it drives on.
            doubted: whether it is the odometry.
        """
        if not self.reason:
            self.count += 1
            if doubted:
                self._times = self._times + 1 if self._driven < self._soon else 1
        self.reason, self._well, self._driven, self.waits = reason, 0, 0, False
        self.until_standing = self.until_standing or until_standing

    def released(self, speed: float, *, displaced: bool = False) -> bool:
        """Takes an odometry message with which nothing is wrong; whether it drives.

        Args:
            speed: of the car (m/s).
            displaced: whether its pose has jumped, and not come back.
        """
        self._well += 1
        self._driven += not self.reason
        released = self._well > self._enough and not self.stays
        if released and self.until_standing:
            stands = abs(speed) <= self.standing
            self.waits, released = stands and displaced, stands and not displaced
        if released:
            self.reason, self.until_standing, self.waits = "", False, False
        return not self.reason
