"""What a measured sample must be, for predictor, controller and recordings alike.

Numbers within what the car can do, no farther from the last ones than it can move, an orientation that is one, the frames
of before, and poses that move as the velocities say (:mod:`dynssm_ros.runtime.consistency`). A jump is believed when a
second sample confirms it, as after a collision or where a filter was set anew.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from operator import le
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from dynssm_ros.errors import UserError
from dynssm_ros.runtime.consistency import Consistency
from dynssm_ros.signals.decoding import Frames
from dynssm_ros.signals.history import Refusal
from dynssm_ros.signals.signal_map import POSE_SIGNALS, STATE_SIGNALS
from dynssm_ros.vehicle import COEFFICIENTS, State, Vehicle
from dynssm_ros.vehicle.kinematics import Pose
from dynssm_ros.vehicle.limits import vehicle_limits
from dynssm_ros.vehicle.single_track import standing_speed

if TYPE_CHECKING:  # reading files is not what a node starts with
    from dynssm_ros.signals.recording import Recording

_BEYOND = 1.5  # times a limit
_SPIN = 3.0  # times the yaw rate of the tightest corner at the limit
_HARD = 4.0  # times the car's accelerations: kerbs, hits
_NOISE = 0.5  # jump that is no sign of anything, in units of the car's own speed and yaw rate
_COLUMNS = {"throttle_feedback": "r_fb", "speed_feedback": "r_fb", "steering_feedback": "delta_fb"}
_COMMANDED = {
    "throttle_command",
    "speed_command",
    "steering_command",
}  # not measured: a controller may ask for anything
_NAME = 60  # characters of a frame's name that are told
_SINGLE = 1e-6  # rounding of what a graph computes
_FARTHEST = 1e8  # m; coordinates of the whole earth are below
_BACKWARDS = 5  # rows over which a car that reverses is seen to speed up: noise is less
_FEWEST_BACKWARDS = 15  # such rows that are told
_PUSHES = 0.05  # throttle, below which the road pushes as much
_ACTUATOR_RANGE_S = 0.01  # an actuator that crosses its range faster than this, does not


class Range(NamedTuple):
    """What one signal can be.

    Attributes:
        low, high: its values.
        rate: change per second.
        noise: change that is always possible.
    """

    low: float
    high: float
    rate: float
    noise: float


def ranges(vehicle: Vehicle) -> dict[str, Range]:
    """What the signals of a car can be, by name: from its limits, generously; empty for a car that cannot drive."""
    try:
        limits = vehicle_limits(vehicle)
    except UserError:
        return {}
    inputs, constants = vehicle.inputs, vehicle.constants
    wheelbase = constants.wheelbase
    grip = float(max(limits.lateral.max(), limits.brake.max(), limits.drive.max()))
    radius = wheelbase / math.tan(min(max(map(abs, inputs.steering)), 1.2))
    top, yaw = _BEYOND * limits.top_speed, _SPIN * math.sqrt(grip / radius)
    speed_noise, yaw_noise = _NOISE * math.sqrt(grip * wheelbase), _NOISE * math.sqrt(grip / wheelbase)
    turning = _HARD * grip / wheelbase
    found = {
        "v_x": Range(-top, top, _HARD * grip, speed_noise),
        "v_y": Range(-top, top, _HARD * grip, speed_noise),
        "omega": Range(-yaw, yaw, turning, yaw_noise),
        **dict.fromkeys(("x", "y"), Range(-_FARTHEST, _FARTHEST, 0.0, math.inf)),
    }
    first = inputs.throttle
    if inputs.set_point == "throttle":  # a fraction, whatever this car uses of it
        first = min(first[0], -1.0), max(first[1], 1.0)
    for actuator, (low, high) in ((inputs.set_point, first), ("steering", inputs.steering)):
        middle, half = (low + high) / 2, (high - low) / 2
        of_actuator = Range(middle - _BEYOND * half, middle + _BEYOND * half, 2 * half / _ACTUATOR_RANGE_S, 2 * half)
        found |= dict.fromkeys((f"{actuator}_feedback", f"{actuator}_command"), of_actuator)
    return found


def implausible_rows(recording: Recording, vehicle: Vehicle) -> Iterator[str]:
    """What a recording holds that the car cannot have done, in words: a line for each kind, with its first row."""
    of = ranges(vehicle)
    for signal in of.keys() - _COMMANDED:
        limit, name = of[signal], _COLUMNS.get(signal, signal)
        if name in POSE_SIGNALS and not recording.has_pose:
            continue
        values = recording[name]
        beyond = np.flatnonzero(~((limit.low <= values) & (values <= limit.high)))
        if len(beyond):
            row = int(beyond[0])
            yield (
                f"{_place(recording, row)}: {name} = {values[row]:.4g}; expected {limit.low:.4g} to {limit.high:.4g} of "
                f"vehicle {vehicle.name} ({len(beyond)} such rows)"
            )
    if (words := _driven_backwards(recording, vehicle)) is not None:
        yield words
    if recording.has_pose:
        yield from _inconsistent_rows(recording, vehicle)


def _driven_backwards(recording: Recording, vehicle: Vehicle) -> str | None:
    """Whether the throttle drives the car backwards otherwise than its vehicle file has it."""
    constants = vehicle.constants
    v_x, r = recording["v_x"], recording["r_fb"]
    if vehicle.inputs.set_point == "speed":
        return None
    ahead = np.append(v_x[_BACKWARDS:], np.full(min(_BACKWARDS, len(v_x)), np.inf))
    faster = (v_x < -standing_speed(constants.wheelbase)) & (ahead < v_x)
    faster &= (r > _PUSHES) | ((r < -_PUSHES) & (not constants.reverse))
    if faster.sum() < _FEWEST_BACKWARDS:
        return None
    row = int(np.argmax(faster))
    sign = "positive" if r[faster].mean() > 0 else "negative"
    return (
        f"{_place(recording, row)}: speeds up backwards under a {sign} throttle; expected a negative one, and reverse: "
        f"true in the constants of vehicle {vehicle.name} ({int(faster.sum())} such rows)"
    )


def _inconsistent_rows(recording: Recording, vehicle: Vehicle) -> Iterator[str]:
    """Where pose and velocities contradict each other."""
    checked, found = _consistency(vehicle), dict[Refusal, list[tuple[int, str]]]()
    rows = np.stack([recording[name] for name in (*POSE_SIGNALS, *STATE_SIGNALS)], axis=1)
    finite = np.all(np.isfinite(rows), axis=1).tolist()
    for row, (stamp, values) in enumerate(zip(recording.time.tolist(), rows.tolist(), strict=True)):
        if not finite[row]:
            continue
        refusal = checked.check(stamp, Pose(*values[:3]), State(*values[3:]))
        if refusal is not None:
            found.setdefault(refusal, []).append((row, checked.words))
    for refusal, which in found.items():
        row, words = which[0]
        yield f"{_place(recording, row)}: {refusal.value}: {words} ({len(which)} such rows)"


def _place(recording: Recording, row: int) -> str:
    return f"row {row} at {(recording.time[row] - recording.time[0]) / 1e9:.2f} s"


def _consistency(vehicle: Vehicle) -> Consistency:
    return Consistency(vehicle.constants.wheelbase, vehicle.minimum_speed)


class Plausibility:
    """Checks samples as they come.

    Args:
        vehicle: whose limits hold.
        frames: ``frame_id`` and ``child_frame_id`` that the odometry must have; those that are empty are as they come
            first.
    """

    def __init__(self, vehicle: Vehicle, *, frames: Frames = ("", "")) -> None:
        self._ranges = ranges(vehicle)
        self._frames = frames
        self._consistency = _consistency(vehicle)
        rounding = _SINGLE * np.maximum(np.abs(vehicle.lower), np.abs(vehicle.upper))
        self._lower = (vehicle.lower - rounding).tolist()
        self._upper = (vehicle.upper + rounding).tolist()
        self.top = self._ranges["v_x"].high if self._ranges else 0.0
        """Largest plausible speed (m/s); 0 where it is not known."""
        self.last = ""
        """What was refused last, in words."""
        self.forget()

    @property
    def jumps(self) -> int:
        """Jumps of the pose that a second message confirmed."""
        return self._consistency.jumps

    @property
    def is_displaced(self) -> bool:
        """Whether jumps have moved the pose away from where it was, and none has moved it back."""
        return self._consistency.is_displaced

    def settle(self) -> None:
        """The pose is right as it is."""
        self._consistency.settle()

    def forget(self) -> None:
        """The next samples are the first."""
        self._consistency.forget()
        self._accepted: dict[str, tuple[int, float]] = {}
        self._suspect: dict[str, tuple[int, float]] = {}

    def check(self, stamp: int, values: Mapping[str, float], frames: Frames | None = None) -> Refusal | None:
        """Judges the samples of a message.

        Args:
            stamp: of the message (ns).
            values: by signal name, SI units.
            frames: of the message; ``None`` if it has none.

        Returns:
            ``None`` if the car can have produced them, else why not.
        """
        if frames is not None and (other := self._check_frames(frames)) is not None:
            return other
        if self.is_beyond(values):
            return Refusal.IMPLAUSIBLE
        refusal: Refusal | None = None
        for name, value in values.items():
            limit = self._ranges.get(name)
            if limit is None or not math.isfinite(value):
                continue
            before = self._accepted.get(name)
            if before is not None and not _can_follow(before, stamp, value, limit):
                suspect, self._suspect[name] = self._suspect.get(name), (stamp, value)
                if suspect is None or suspect[0] == stamp or not _can_follow(suspect, stamp, value, limit):
                    self.last = f"{name} = {value:.4g} after {before[1]:.4g}"
                    refusal = Refusal.JUMPED
                    continue
            self._suspect.pop(name, None)
            self._accepted[name] = stamp, value
        return refusal or self._check_motion(stamp, values)

    def is_beyond(self, values: Mapping[str, float]) -> bool:
        """Whether one of the values by signal name is beyond what the car can do; ``last`` says which."""
        for name, value in values.items():
            limit = self._ranges.get(name)
            if limit is not None and math.isfinite(value) and not limit.low <= value <= limit.high:
                self.last = f"{name} = {value:.4g}; expected {limit.low:.4g} to {limit.high:.4g}"
                return True
        return False

    def _check_frames(self, frames: Frames) -> Refusal | None:
        for expected, found, name in zip(self._frames, frames, ("frame_id", "child_frame_id"), strict=True):
            if expected and found != expected:
                self.last = f"{name} '{found[:_NAME]}'; expected '{expected[:_NAME]}'"
                return Refusal.FRAMES
        self._frames = frames
        return None

    def _check_motion(self, stamp: int, values: Mapping[str, float]) -> Refusal | None:
        pose = [values[name] for name in POSE_SIGNALS if name in values]
        if len(pose) < len(POSE_SIGNALS):
            return None
        if math.isnan(pose[2]) and math.isfinite(pose[0] + pose[1]):
            self.last = "an orientation whose length is not 1"
            return Refusal.NO_ORIENTATION
        seen = [values[name] for name in STATE_SIGNALS if name in values]
        if len(seen) < len(STATE_SIGNALS) or not all(map(math.isfinite, (*pose, *seen))):
            return None
        refusal = self._consistency.check(stamp, Pose(*pose), State(*seen))
        if refusal is not None:
            self.last = self._consistency.words
        return refusal

    def of_prediction(
        self,
        now: Iterable[float],
        following: Iterable[float],
        T_s: float,
        *,
        variance: Sequence[float],
        theta: Sequence[float],
    ) -> str:
        """What is wrong with a prediction, in words; empty if the car can do it.

        Args:
            now: measured ``v_x, v_y, omega``.
            following: predicted, ``T_s`` later.
            T_s: sampling time (s).
            variance: stated, three numbers, or none if the model states none.
            theta: the coefficients, or none if it has none.
        """
        for name, before, after in zip(STATE_SIGNALS, now, following, strict=True):
            limit = self._ranges.get(name)
            if limit is None:
                continue
            if not limit.low <= after <= limit.high:
                return f"predicted {name} = {after:.4g}; expected {limit.low:.4g} to {limit.high:.4g}"
            if abs(after - before) > limit.noise + limit.rate * T_s:
                return f"predicted {name} = {after:.4g} after {before:.4g}"
        if min(variance, default=1.0) <= 0:
            return f"predicted variance {min(variance):.4g}; expected more than zero"
        if theta and not (all(map(le, self._lower, theta)) and all(map(le, theta, self._upper))):
            values = np.array(theta)
            k = int(np.argmax(np.maximum(np.subtract(self._lower, values), np.subtract(values, self._upper))))
            return f"{COEFFICIENTS[k]} = {theta[k]:.4g}; expected {self._lower[k]:.4g} to {self._upper[k]:.4g}"
        return ""


def _can_follow(before: tuple[int, float], stamp: int, value: float, limit: Range) -> bool:
    elapsed = abs(stamp - before[0]) / 1e9
    return abs(value - before[1]) <= limit.noise + limit.rate * elapsed
