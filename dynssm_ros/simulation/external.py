"""A car in real time that somebody else drives: it obeys commands as they come, brakes when they stop coming, and stands
still well.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Callable, Iterator

from dynssm_ros.simulation.laps import Sample, SimulationError
from dynssm_ros.simulation.plant import PlantKind, make_plant, plant_type
from dynssm_ros.track.tracks import Track
from dynssm_ros.vehicle import Applied, State, Vehicle
from dynssm_ros.vehicle.kinematics import Pose
from dynssm_ros.vehicle.low_speed import LowSpeedRolling

Clock = Callable[[], float]
_CAUGHT_UP_S = 1.0  # that a car may be behind its clock, and its commands ahead


class CommandHolder:
    """The last command that has begun to act, within what the actuators of ``vehicle`` can do, while it is at most
    ``timeout`` old (s, by ``clock``).

    After that the car brakes with its steering held.
    """

    def __init__(self, vehicle: Vehicle, timeout: float, clock: Clock) -> None:
        self._limits = vehicle.inputs
        self._T_s = vehicle.sampling_time
        self._timeout = timeout
        self._clock = clock
        self._last = Applied(0.0, 0.0)
        self._since = -math.inf
        self._coming: deque[tuple[float, Applied]] = deque()  # by when they begin to act

    @property
    def fresh(self) -> bool:
        """Whether there is a command to obey."""
        self._begin()
        return self._clock() - self._since <= self._timeout

    def receive(self, command: Applied, *, after: float = 0.0) -> bool:
        """Takes a command in place of those that would begin to act later. Returns whether it was taken.

        Args:
            command: one that is not finite changes nothing.
            after: seconds until it begins to act. More than one is another clock: it acts at once.
        """
        if not all(map(math.isfinite, command)):
            return False
        begins = self._clock() + (max(after, 0.0) if after <= _CAUGHT_UP_S else 0.0)
        while self._coming and self._coming[-1][0] >= begins:
            self._coming.pop()
        self._coming.append((begins, command))
        return True

    def _begin(self) -> None:
        now = self._clock()
        while self._coming and self._coming[0][0] <= now + self._T_s / 2:
            self._since, self._last = self._coming.popleft()

    def command(self, previous: Applied) -> Applied:
        """What the actuators do next, ``previous`` being what they do now."""
        self._begin()
        wanted = self._last if self.fresh else Applied(self._limits.full_brakes, previous.delta)
        return self._limits.reached(wanted, previous, self._T_s)


class Pace:
    """Which sample of a car in real time is due, and with which stamp.

    A car that was held up for at most a second is behind, and catches up. After longer it goes on from where it is, and the
    stamps leave out as much time: they stay those of the clock.

    Args:
        T_s: between the samples, in the car's time (s).
        rate: of that time over real time.
        now: real time (s), of any origin.
        first_stamp: of the first sample, which is due one period later (ns).
        waits: whether it may always be held up: nothing is caught up, and the stamps leave out nothing.
    """

    def __init__(self, T_s: float, rate: float, now: float, first_stamp: int, *, waits: bool = False) -> None:
        self.period = T_s / rate
        """Between the samples, in real time (s)."""
        self.count = 0
        """Samples so far."""
        self.held_up = 0.0
        """Real time that is not caught up (s)."""
        self._T_s, self._rate, self._waits = T_s, rate, waits
        self._begin, self._first_stamp = now + self.period, first_stamp

    def behind(self, now: float) -> int:
        """Samples that are late, beside the one that is due."""
        late = now - self._begin - self.count * self.period
        if late > (self.period if self._waits else _CAUGHT_UP_S):
            self._begin += late
            self.held_up += late
            self._first_stamp += 0 if self._waits else round(1e9 * self._rate * late)
            return 0
        return max(0, int(late / self.period))

    @property
    def stamp(self) -> int:
        """Of the next sample (ns)."""
        return self._first_stamp + round(1e9 * self.count * self._T_s)


def drive_by_commands(
    vehicle: Vehicle, track: Track, plant: PlantKind, next_command: Callable[[Applied], Applied]
) -> Iterator[Sample]:
    """Goes on without end from standstill at the first point of the centre line of ``track``, on and off the road.

    ``next_command`` maps what the actuators do now to what they do next, once per T_s. At low speeds see
    :class:`LowSpeedRolling`.

    Raises:
        SimulationError: the motion is not finite.
    """
    (x, y), theta = track.centre.position(0.0), float(track.centre.heading(0.0))
    start = Pose(float(x), float(y), theta), State(0.0, 0.0, 0.0)
    car = make_plant(
        vehicle,
        plant,
        *start,
        last=(LowSpeedRolling(vehicle, plant_type(plant).step(vehicle)),),
        line=track.centre,
    )
    feedback, s = Applied(0.0, 0.0), 0.0
    for k in itertools.count():
        time, pose, state = k * vehicle.sampling_time, car.pose, car.state
        if not all(map(math.isfinite, (*pose, *state))):
            raise SimulationError(
                f"{vehicle.name}: its motion is not finite after {time:.2f} s; expected other commands"
            )
        on_track, lateral = (float(value) for value in track.project(pose[:2], near=s))
        s = track.centre.counted_on(on_track, s)
        command = next_command(feedback)
        yield Sample(time, state, pose, feedback, command, s, lateral, car.measured)
        car.advance(command, on_track)
        feedback = command
