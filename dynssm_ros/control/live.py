"""The controller of a car that does not wait: plans for the instant at which the command will act, and tells how it
goes.

The answer to an odometry message acts one T_s later, or more where odometry comes late. So each step first carries the
measured state to that instant, under the commands that were sent before, and plans from there. The command is stamped
with that instant.

From far below the line's speed, as from standstill or after a spin, a short horizon sees no way back to the line. So
pure pursuit drives until the car is up to speed; the calibrated car carries the state.
"""

from __future__ import annotations

import math
import time
from collections import Counter, deque
from collections.abc import Callable
from typing import NamedTuple, get_args

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.control.brakes import AT_ONCE, Brakes
from dynssm_ros.control.controller import LOST, Controller
from dynssm_ros.control.evidence import SOURCES
from dynssm_ros.control.horizon_model import STATES
from dynssm_ros.control.nmpc import Status
from dynssm_ros.control.reference import Reference
from dynssm_ros.control.remote import Context, RemoteModel
from dynssm_ros.control.settings import Settings
from dynssm_ros.errors import ConfigurationError
from dynssm_ros.runtime.health import Level
from dynssm_ros.runtime.plausibility import Plausibility
from dynssm_ros.signals.decoding import Frames
from dynssm_ros.signals.history import Refusal
from dynssm_ros.simulation.sensing import MOST_LATE, steps_late
from dynssm_ros.track.driver import Driver, Style
from dynssm_ros.track.tracks import Track
from dynssm_ros.vehicle import COEFFICIENTS, Applied, State, Vehicle
from dynssm_ros.vehicle.kinematics import Pose
from dynssm_ros.vehicle.limits import vehicle_limits
from dynssm_ros.vehicle.single_track import standing_speed

LAUNCH = 0.3, 0.7  # shares of the line's speed: below the first pursuit takes over, above the second it ends
_LAUNCH_STYLE = Style(aggressiveness=0.7, variation=0.0)
_DOUBTED_S = 0.25  # of odometry before it is seen that it is wrong
_RECKONED_S = 10.0  # over which the car is reckoned on: until it stands, from any speed
_KEPT = 200  # messages, for that
_REMEMBERED = 1000  # control steps that the percentiles are of
_TOLERATED = 0.01  # share of plans that may be missing before it is called a warning
_STANDING = 0.2  # of the vehicle's minimum speed, below which a car stands, or half of the physics'
# standing speed: an exponential end of the braking never reaches 0, and noise hides it
_PUNCTUAL = 0.02  # of T_s by which odometry may be off for its difference to the one before to be that of a step
_EARLY = 0.25  # of T_s that odometry may come before its time; what comes earlier is for a later step


class _Believed(NamedTuple):
    """Where the car was."""

    stamp: int  # ns
    x: Vector  # the controller's state, ``(size,)``
    context: Context


class Laps:
    """Follows a car around a track and counts laps, from where it was first seen and anew after each gap."""

    def __init__(self, track: Track) -> None:
        self.count = 0
        """Complete laps."""
        self.last = math.nan
        """Time of the last of them (s)."""
        self.s = math.nan
        """Along the centre line, counted on over the laps (m)."""
        self.lateral = math.nan
        """Beside the centre line (m, positive left)."""
        self.outside = 0.0
        """How far the car's centre is outside the borders (m)."""
        self.worst = 0.0
        """How far it ever was."""
        self._track = track
        self._start = self._mark = math.nan  # where (m) and when (s) the present lap began
        self._before = math.nan, math.nan

    @property
    def width(self) -> float:
        """Of the road here (m)."""
        return float(np.sum(self._track.widths(self.s)))

    def passed(self, t: float, x: float, y: float, together: bool = True) -> None:
        """Takes the car at ``x, y`` (m) at ``t`` (s, of any origin).

        If something is missing since the time before, it is not ``together`` with that and is looked for on the whole
        track.
        """
        together = together and not math.isnan(self.s)
        at, self.lateral = (float(value) for value in self._track.project([x, y], self.s if together else None))
        if not together:
            self.s = self._start = at
            self._mark, self._before = t, (t, at)
        self.s = self._track.centre.counted_on(at, self.s)
        self.outside = max(0.0, -float(self._track.room(self.s, self.lateral)))
        self.worst = max(self.worst, self.outside)
        goal = self._start + self._track.length
        if self.s >= goal:
            before, was = self._before
            crossing = before + (t - before) * (goal - was) / (self.s - was)
            self.count, self.last = self.count + 1, crossing - self._mark
            self._start, self._mark = goal, crossing
        self._before = t, self.s


class LiveController:
    """Drives one car on one track from what comes over a bus.

    Odometry that comes twice, in disorder or that the car cannot have produced is refused. After a gap, or when its time
    jumps back, everything begins anew. What it brakes for is said by :mod:`dynssm_ros.control.brakes`.

    Args:
        vehicle: the car.
        reference: the line.
        track: where.
        settings: of the controller.
        max_age: how old the odometry behind the predictor's coefficients may be (s).
        max_gap: longest time between two odometry messages that is no gap (s).
        delay: from the stamp of an odometry message until it arrives (s), in whole T_s.
        max_late: by how much more odometry may come late (s).
        frames: that the odometry must have; those that are empty are as they come first.
        clock: time now (s), of any origin, for the deadline.

    Raises:
        ConfigurationError: the vehicle has effects on signals that there are not; the delay is too long.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        reference: Reference,
        track: Track,
        settings: Settings,
        *,
        max_age: float = 0.5,
        max_gap: float = 0.2,
        delay: float = 0.0,
        max_late: float = math.inf,
        frames: Frames = ("", ""),
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self.vehicle = vehicle
        self.period = round(vehicle.sampling_time * 1e9)
        """T_s (ns)."""
        self._age = 1 + steps_late(delay, vehicle.sampling_time)  # of the odometry, when the command acts
        if self._age >= MOST_LATE:
            raise ConfigurationError(f"delay {delay:g} s: expected less than {MOST_LATE - 1} times T_s")
        self.answered_after = self._age * self.period
        """A command acts that long after the stamp of the odometry that it answers (ns)."""
        self.remote = RemoteModel(vehicle, max_age)
        """What the predictor says."""
        self._pilot = Controller(self.remote, vehicle.inputs, reference, track, settings, clock=clock)
        self._pursuit = Driver(vehicle, reference.line, vehicle_limits(vehicle), _LAUNCH_STYLE)
        self._reference = reference
        self._brakes = vehicle.inputs.full_brakes
        self._max_age, self._max_gap, self._max_late = max_age, max_gap * 1e9, max_late
        self._track = track
        self._contract = Plausibility(vehicle, frames=frames)
        self._reset()
        # what is loaded, compiled or allocated by the first step is so before the car waits for it
        x, y = (float(value) for value in reference.line.position(0.0))
        start = Pose(x, y, float(reference.line.heading(0.0)))
        self.step(0, start, State(float(reference.speed_at(0.0)), 0.0, 0.0))
        self.learn()
        self._reset()

    def _reset(self) -> None:
        self.laps = Laps(self._track)
        self.counts: Counter[Status] = Counter()
        """Plans by what became of them."""
        self._recent: deque[tuple[float, bool]] = deque(maxlen=_REMEMBERED)  # seconds, and whether there was a plan
        self._last: int | None = None  # stamp of the newest odometry (ns)
        self._strayed = False  # whether the car is off the road since it was driven without odometry
        self._first = self._planned = 0
        self._heading = 0.0
        # commands from the one that acts at the stamp of the newest odometry to the last
        self._sent = deque([Applied(0.0, 0.0)] * self._age, maxlen=self._age)
        self._acting: deque[tuple[int, Applied]] = deque(maxlen=_KEPT)  # commands by when they begin to act (ns)
        self._believed: deque[_Believed] = deque(maxlen=_KEPT)
        self._reckoned: _Believed | None = None  # while it brakes
        stands = max(_STANDING * self.vehicle.minimum_speed, standing_speed(self.vehicle.constants.wheelbase) / 2)
        self.brakes = Brakes(self.vehicle.sampling_time, stands)
        self._contract.forget()
        self._jumps = self._contract.jumps
        self._weights = np.zeros(len(SOURCES))
        self._planned_with = self.remote.calibrated
        self._restart()
        self.remote.forget()

    def _restart(self) -> None:
        """Forgets the plan."""
        self._pilot.forget()
        self._launching = False
        self._memory: Vector | None = None

    def step(
        self, stamp: int, pose: Pose, seen: State, *, frames: Frames | None = None, late: float = 0.0
    ) -> Applied | Refusal | None:
        """Answers an odometry message.

        Args:
            stamp: of the message (ns).
            pose: with a heading that may be wrapped.
            seen: velocities.
            frames: of the message; ``None`` if it has none.
            late: how much later than the fastest the last messages came (s).

        Returns:
            The command from ``stamp + answered_after`` on, finite and within the limits; why the message is refused; or
                nothing if it is too early for a new plan.
        """
        since = math.inf if self._last is None else stamp - self._last
        if -self._max_gap <= since <= 0:
            return Refusal.REPEATED
        if since < 0:
            self._contract.forget()
        refusal = self._contract.check(stamp, pose._asdict() | seen._asdict(), frames)
        if refusal is None and not all(map(math.isfinite, (*pose, *seen))):
            refusal = Refusal.NOT_FINITE
        if refusal in AT_ONCE:
            self.brakes.apply(refusal.value, doubted=True)
            return self.brake(stamp + self.answered_after, _DOUBTED_S)
        if refusal is not None:
            return refusal
        if self._has_jumped(seen.v_x):
            self.brakes.apply("the pose jumped", until_standing=True, doubted=True)
        elif late > self._max_late:
            self.brakes.apply(f"odometry comes {late:.2f} s later than its fastest")
        together = 0 < since <= self._max_gap
        if together and stamp - self._planned < (1 - _EARLY) * self.period:
            self._last = stamp
            return None
        if not together:
            self._restart()
            self._believed.clear()
            self._reckoned = None
        elif abs(stamp - self._planned - self.period) > _PUNCTUAL * self.period:
            self._pilot.interrupt()
        gap = self._last is not None and not together
        if since < 0:
            self.remote.forget()
        if since < 0 or self._last is None:
            self.laps, self._first = Laps(self._track), stamp
        if self._last is None:  # what was asked before is not known; a car that rolls is asked for its speed
            self._sent.extend([Applied(float(self.vehicle.inputs.coasting(seen.v_x)), 0.0)] * self._age)
        self._last = self._planned = stamp
        self.laps.passed((stamp - self._first) / 1e9, pose.x, pose.y, together)
        if self._is_lost(gap):
            self.brakes.apply(f"{self.laps.outside:.3g} m outside the borders")
        if self.brakes.released(seen.v_x, displaced=self._contract.is_displaced):
            return self._answer(stamp, pose, seen)
        if not self.brakes.until_standing:
            self._believe(stamp, pose, seen)
        return self.brake(stamp + self.answered_after + round(1e9 * late))

    def _has_jumped(self, v_x: float) -> bool:
        """Whether the pose has jumped since the last look. That of a car that stands is set by somebody, and right."""
        before, self._jumps = self._jumps, self._contract.jumps
        if self._jumps > before and abs(v_x) <= self.brakes.standing:
            self._contract.settle()
        return self._jumps > before

    def _is_lost(self, gap: bool) -> bool:
        """Whether the car is off the road by too much: by anything since a ``gap``, as it was driven unseen."""
        self._strayed = (self._strayed or gap) and self.laps.outside > 0
        return self._strayed or self.laps.outside > LOST * self.laps.width

    def predicted(self, stamp: int, state: State) -> str:
        """Takes what the predictor says of the instant ``stamp`` (ns). Returns what is wrong with it, else nothing."""
        if self._contract.is_beyond(state._asdict()):
            return self._contract.last
        return self.remote.predicted(stamp, state)

    def learn(self) -> None:
        """Learns from the last step; to be called once its command is out, which does not wait for it."""
        self._pilot.learn()

    def _believe(self, stamp: int, pose: Pose, seen: State) -> tuple[Vector, Context]:
        """The controller's state ``(size,)`` and its context at an odometry message."""
        self._heading += math.remainder(pose.theta - self._heading, 2 * math.pi)
        t = (stamp - self._first) / 1e9
        context = t, *self._track.centre.place(self.laps.s % self._track.length).values()
        x = self.remote.start(Pose(pose.x, pose.y, self._heading), seen, self._sent[0], context, self._memory)
        self._believed.append(_Believed(stamp, x, context))
        self._reckoned = None
        return x, context

    def _answer(self, stamp: int, pose: Pose, seen: State) -> Applied:
        x, context = self._believe(stamp, pose, seen)
        self.remote.measured(stamp, x, context)
        self.remote.update(stamp)
        for increments in np.diff(np.array([self._sent[0], *self._sent]), axis=0):
            x = self.remote.ahead(x, context, self.remote.calibrated, increments)
        pursued = self._pursued(Pose(*x[:3].tolist()), State(*x[3:6].tolist()))
        return self._send(
            stamp + self.answered_after,
            pursued or self._planned_command(context[0], Pose(pose.x, pose.y, self._heading), seen),
        )

    def _send(self, acts: int | None, command: Applied) -> Applied:
        """Notes a command and when it begins to act (ns), if that is known."""
        self._sent.append(command)
        if acts is not None:
            self._acting.append((acts, command))
        return command

    def _pursued(self, pose: Pose, state: State) -> Applied | None:
        """The command of a launch; ``None`` while there is none."""
        on_line = float(self._reference.line.project(pose[:2])[0])
        share = LAUNCH[1] if self._launching else LAUNCH[0]
        launching = state.v_x <= share * float(self._reference.speed_at(on_line))
        if launching != self._launching:
            self._restart()
            self._launching = launching
        return self._pursuit.command(0.0, pose, state, on_line, self._sent[-1]) if launching else None

    def _planned_command(self, t: float, pose: Pose, state: State) -> Applied:
        """The pilot's command for when it acts, from the odometry at ``t`` (s)."""
        decision = self._pilot.step(t + self.answered_after / 1e9, pose, state, self._sent[-1], age=self._age)
        self._memory = None if self._pilot.expected is None else self._pilot.expected[len(STATES) :]
        self._weights, self._planned_with = decision.weights, decision.adapted
        self.counts[decision.plan.status] += 1
        self._recent.append((decision.seconds, decision.plan.status == "solved"))
        return decision.command

    def brake(self, acts: int | None = None, doubted: float = 0.0) -> Applied:
        """The command for when there is nothing to plan from: full brakes, along the line as far as that can be reckoned.

        The calibrated car is stepped on from the last odometry that is believed, under the commands since. It steers as it
        does when it gets up to speed.

        Args:
            acts: when the command acts (ns); ``None``: the steering is held.
            doubted: of the last odometry (s), that is not believed.
        """
        self._restart()
        command = Applied(self._brakes, self._sent[-1].delta)
        x = None if acts is None else self._reckon(acts, doubted)
        if x is not None and x[3] > self.brakes.standing:
            pose = Pose(*x[:3].tolist())
            on_line = float(self._reference.line.project(pose[:2])[0])
            steered = self._pursuit.command(0.0, pose, State(*x[3:6].tolist()), on_line, Applied(*x[6:8].tolist()))
            command = Applied(self._brakes, steered.delta)
        return self._send(acts, command)

    def _reckon(self, acts: int, doubted: float) -> Vector | None:
        """The controller's state ``(size,)`` at ``acts`` (ns), as the calibrated car comes there; ``None`` from too far."""
        if self._reckoned is None and self._believed:
            trusted = self._believed[-1].stamp - 1e9 * doubted
            while len(self._believed) > 1 and self._believed[-1].stamp > trusted:
                self._believed.pop()
            self._reckoned = self._believed[-1]
        if self._reckoned is None or not 0 < acts - self._believed[-1].stamp < _RECKONED_S * 1e9:
            return None
        stamp, x, context = self._reckoned
        while stamp + self.period // 2 < acts:
            sent = (command for since, command in reversed(self._acting) if since <= stamp + self.period // 2)
            increments = np.array(next(sent, x[6:8])) - x[6:8]
            x = self.remote.ahead(x, context, self.remote.calibrated, increments)
            stamp += self.period
        self._reckoned = _Believed(stamp, x, context)
        return x if np.all(np.isfinite(x)) else None

    def verdict(self) -> tuple[Level, str]:
        """How it goes, in words."""
        if self.brakes.reason:
            until = " until the pose is set anew" if self.brakes.waits else ""
            if self.brakes.stays:
                until = " until it is configured anew"
            return Level.ERROR, f"{self.brakes.reason}: brakes{until}"
        output, level, words = self.remote.output, Level.OK, ""
        if output.source == RemoteModel.NOMINAL:
            level, words = Level.WARN, f", nothing from the predictor for {self._max_age:g} s"
        missing = sum(not planned for _, planned in self._recent)
        if missing > _TOLERATED * len(self._recent):
            level, words = Level.WARN, f"{words}; {missing} of {len(self._recent)} plans infeasible or late"
        return level, f"{'gets up to speed' if self._launching else 'drives'}, {output.source}{words}"

    def values(self) -> dict[str, str]:
        """All figures by name, for the key-value list of a diagnostic status."""
        p50, p99 = np.percentile([seconds for seconds, _ in self._recent] or [math.nan], [50, 99])
        laps, output = self.laps, self.remote.output
        theta, correction = (np.atleast_2d(part)[0] for part in self._planned_with)
        return {
            "coefficients": output.source,
            **{f"planned with {source}": f"{w:.2f}" for source, w in zip(SOURCES, self._weights, strict=True)},
            "age of the coefficients (s)": f"{output.age:.3f}",
            "step p50 (ms)": f"{1e3 * p50:.3f}",
            "step p99 (ms)": f"{1e3 * p99:.3f}",
            **{f"plans {status}": str(self.counts[status]) for status in get_args(Status)},
            "braked": str(self.brakes.count),
            "laps": str(laps.count),
            "last lap (s)": f"{laps.last:.3f}",
            "place on the track (m)": f"{laps.s % self._track.length:.3f}",
            "beside the centre line (m)": f"{laps.lateral:.4f}",
            "most outside the borders (m)": f"{laps.worst:.4f}",
            **{name: f"{value:.6g}" for name, value in zip(COEFFICIENTS, theta, strict=True)},
            **{f"added to {name}": f"{value:.6g}" for name, value in zip(State._fields, correction, strict=True)},
        }
