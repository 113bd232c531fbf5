"""Whether the poses of a car move as its velocities say, and what is wrong if they do not.

A message that lies farther from the one before than the car can have moved is refused until a second one confirms it.
Over stretches of two wheelbases the way of the poses is compared with that of the velocities. If they differ by more than
half, what goes wrong in odometry is tried instead: poses that stand still, a twist in the map's frame, a swapped sign,
km/h. The one that explains the way is named, if no other does. It stands until poses and velocities agree again over such
a stretch: a car that stands shows nothing of that.
"""

from __future__ import annotations

import cmath
import math
from collections import deque
from typing import NamedTuple

from dynssm_ros.signals.history import Refusal
from dynssm_ros.vehicle import State
from dynssm_ros.vehicle.kinematics import Pose

_GAP_S = 0.5  # between messages, after which they are compared anew
_JUMP = 1.0  # wheelbases that a pose may be off from one message to the next: corrections of real logs are 0.3
_TURN = 0.35  # rad, likewise; 0.26 in real logs
_FASTER = 1.5  # times the way, and twice the turn, that the velocities say
_WAY = 2.0  # wheelbases that are compared
_SPAN_S = 0.1  # likewise, at least; as long the poses may be those of before, and contradict their velocities
_FEWEST = 3  # messages, likewise
_DIFFERENT = 0.6  # of the way, from which on poses and velocities contradict each other; 0.3 in real logs
_EXPLAINED = 0.25  # of the difference that may be left
_REMEMBERED = 0.98  # of differences, from message to message
_SLOW = 0.5  # of the minimum speed, below which nothing is said of the motion: headings of real logs settle at 0.4
_SLOW_IN_DOUBT = 0.2  # likewise after a jump or a contradiction; below that a car stands
_KEPT = 1000  # messages

_EXPLANATIONS = (Refusal.STANDS_STILL, Refusal.MAP_FRAME, Refusal.SPEED_SIGN, Refusal.SPEED_SIGN, Refusal.SPEED_UNIT)


class _Passed(NamedTuple):
    """A message, with the ways until there as the velocities say them, complex ones as ``x + iy``."""

    stamp: int  # ns
    position: complex  # m
    speed: float  # m/s
    velocity: complex  # m/s, in the map's frame
    body: complex  # m/s, in the car's
    mirrored: complex  # m/s, in the map's frame with the lateral velocity's sign swapped
    way: float  # m
    moved: complex  # m, by `velocity`
    moved_as_body: complex  # m, by `body`
    moved_mirrored: complex  # m, by `mirrored`

    def explained(self, since: _Passed) -> tuple[complex, ...]:
        """The way ``since`` another message under each of the explanations (m)."""
        moved = self.moved - since.moved
        mirrored = self.moved_mirrored - since.moved_mirrored
        return 0j, self.moved_as_body - since.moved_as_body, -moved, -mirrored, moved / 3.6


class Consistency:
    """Follows the odometry of one car.

    Args:
        wheelbase: of the car (m).
        minimum_speed: of the car's model (m/s).
    """

    def __init__(self, wheelbase: float, minimum_speed: float) -> None:
        self._wheelbase, self._minimum_speed = wheelbase, minimum_speed
        self.jumps = 0
        """Jumps that a second message confirmed."""
        self.words = ""
        """What was refused last."""
        self.forget()

    @property
    def is_displaced(self) -> bool:
        """Whether jumps have moved the pose away from where it was, and none has moved it back."""
        way, turn = self._driven
        turned = abs(math.remainder(self._turned, 2 * math.pi))
        return abs(self._moved) > _JUMP * self._wheelbase + way or turned > _TURN + turn

    def settle(self) -> None:
        """The pose is right as it is."""
        self._moved, self._turned = 0j, 0.0  # m, rad, by jumps
        self._driven = 0.0, 0.0  # m, rad, of it at most

    def forget(self) -> None:
        """The next message is the first, and right."""
        self.settle()
        self._begin()

    def _begin(self) -> None:
        self._suspect: tuple[int, Pose, State] | None = None
        self._restart()

    def _restart(self, in_doubt: bool = False) -> None:
        self._in_doubt = in_doubt  # whether poses and velocities have yet to agree
        self._contradicted: Refusal | None = None  # what they did before they agree again
        self._last: tuple[int, Pose, State] | None = None
        self._passed: deque[_Passed] = deque(maxlen=_KEPT)
        self._different = 0  # messages that contradict each other, one after the other
        self._since = 0  # ns, when the first of them came
        self._squares = (0.0,) * (1 + len(_EXPLANATIONS))  # of what is left of their ways
        self._still = 0  # messages with the same pose
        self._still_since: tuple[int, float] = (0, 0.0)  # ns, m

    def check(self, stamp: int, pose: Pose, seen: State) -> Refusal | None:
        """Judges a message of finite numbers.

        Args:
            stamp: of the message (ns).
            pose: in any fixed frame (m, m, rad).
            seen: velocities in the frame of the car.

        Returns:
            ``None`` if pose and velocities agree with what came before, else why not.
        """
        if self._last is not None and not 0 < stamp - self._last[0] <= _GAP_S * 1e9:
            if -_GAP_S * 1e9 < stamp - self._last[0] <= 0:
                return None  # in disorder: refused elsewhere
            self._begin()
        if self._last is not None and not self._follows(self._last, stamp, pose, seen):
            suspect, self._suspect = self._suspect, (stamp, pose, seen)
            if suspect is None or suspect[0] >= stamp or not self._follows(suspect, stamp, pose, seen):
                before = self._last[1]
                self.words = (
                    f"pose {pose.x:.4g} m, {pose.y:.4g} m, {pose.theta:.3g} rad after "
                    f"{before.x:.4g} m, {before.y:.4g} m, {before.theta:.3g} rad"
                )
                return Refusal.JUMPED
            self._jump(self._last, *suspect)
            self._restart(in_doubt=True)
        self._suspect = None
        self._pass(stamp, pose, seen)
        return self._contradiction(stamp)

    def _possible(self, before: tuple[int, Pose, State], stamp: int, seen: State) -> tuple[float, float]:
        """How far (m) and by how much (rad) the car can have moved and turned since ``before``."""
        then, _, had = before
        if before is self._last:
            then = self._still_since[0]  # a slow localisation may say the same several times
        elapsed = abs(stamp - then) / 1e9
        speed = max(math.hypot(seen.v_x, seen.v_y), math.hypot(had.v_x, had.v_y))
        return _FASTER * speed * elapsed, 2.0 * max(abs(seen.omega), abs(had.omega)) * elapsed

    def _follows(self, before: tuple[int, Pose, State], stamp: int, pose: Pose, seen: State) -> bool:
        """Whether the car can have moved to ``pose`` since ``before``."""
        was, (way, turn) = before[1], self._possible(before, stamp, seen)
        if math.hypot(pose.x - was.x, pose.y - was.y) > _JUMP * self._wheelbase + way:
            return False
        return abs(math.remainder(pose.theta - was.theta, 2 * math.pi)) <= _TURN + turn

    def _jump(self, before: tuple[int, Pose, State], stamp: int, pose: Pose, seen: State) -> None:
        """Notes a jump to ``pose``, and how much of it may have been driven."""
        was, (way, turn) = before[1], self._possible(before, stamp, seen)
        self.jumps += 1
        self._moved += complex(pose.x - was.x, pose.y - was.y)
        self._turned += pose.theta - was.theta
        self._driven = self._driven[0] + way, self._driven[1] + turn

    def _pass(self, stamp: int, pose: Pose, seen: State) -> None:
        turn, body = cmath.rect(1.0, pose.theta), complex(seen.v_x, seen.v_y)
        velocity, mirrored = turn * body, turn * body.conjugate()
        speed, way, ways = abs(body), 0.0, (0j, 0j, 0j)
        if self._last is not None:
            last = self._passed[-1]
            half = (stamp - last.stamp) / 2e9
            way = last.way + half * (last.speed + speed)
            ways = (
                last.moved + half * (last.velocity + velocity),
                last.moved_as_body + half * (last.body + body),
                last.moved_mirrored + half * (last.mirrored + mirrored),
            )
            self._still = self._still + 1 if pose == self._last[1] else 0
        if not self._still:
            self._still_since = stamp, way
        self._last = stamp, pose, seen
        self._passed.append(_Passed(stamp, complex(pose.x, pose.y), speed, velocity, body, mirrored, way, *ways))
        while len(self._passed) > 1 and self._is_far(self._passed[1]):
            self._passed.popleft()

    def _is_far(self, start: _Passed) -> bool:
        """Whether the way since ``start`` is long enough to be compared."""
        newest = self._passed[-1]
        return newest.way - start.way >= _WAY * self._wheelbase and newest.stamp - start.stamp >= _SPAN_S * 1e9

    def _contradiction(self, stamp: int) -> Refusal | None:
        start, newest = self._passed[0], self._passed[-1]
        since, way = self._still_since
        slow = self._minimum_speed * (_SLOW_IN_DOUBT if self._in_doubt else _SLOW)  # m/s
        if (
            self._still >= _FEWEST - 1
            and stamp - since >= _SPAN_S * 1e9
            and newest.way - way >= max(self._wheelbase / 2, slow * (stamp - since) / 1e9)
        ):
            self.words = f"the same pose for {(stamp - since) / 1e9:.2f} s and {newest.way - way:.3g} m"
            return self._doubted(Refusal.STANDS_STILL)
        way = newest.way - start.way
        if not self._is_far(start) or way < slow * (newest.stamp - start.stamp) / 1e9:
            self._different = 0
            return self._contradicted
        moved = newest.position - start.position
        share = abs(moved - (newest.moved - start.moved)) / way
        if share < _DIFFERENT:
            self._different, self._in_doubt, self._contradicted = 0, False, None
            return None
        shares = share, *(abs(moved - explained) / way for explained in newest.explained(start))
        if not self._different:
            self._since, self._squares = stamp, (0.0,) * len(shares)
        self._different += 1
        sums = zip(self._squares, shares, strict=True)
        self._squares = tuple(_REMEMBERED * before + share**2 for before, share in sums)
        if self._different < _FEWEST or stamp - self._since < _SPAN_S * 1e9:
            return self._contradicted
        self.words = f"{abs(moved):.3g} m where the velocities say {way:.3g} m"
        return self._doubted(self._named())

    def _doubted(self, what: Refusal) -> Refusal:
        self._in_doubt, self._contradicted = True, what
        return what

    def _named(self) -> Refusal:
        """The only explanation, if there is one."""
        as_it_is, *explained = self._squares
        explaining = {
            what for what, square in zip(_EXPLANATIONS, explained, strict=True) if square < _EXPLAINED**2 * as_it_is
        }
        return explaining.pop() if len(explaining) == 1 else Refusal.CONTRADICTION
