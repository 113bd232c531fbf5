"""Faster every lap: how fast the line is driven next follows from the laps that were driven.

The line's speed has a share of the car's accelerations for each section of the lap, which begins at a safe share. After
a lap:

- A section is driven a step faster, if the car stayed away from the borders and was not slower than before; two steps
while below the safe share, and from the second lap on where the car stayed far away.
- A section that came too close to a border, and the one before it, stay below what they were driven with. So does,
once, one where the rear slipped nearly as far as it may, if the controller tracks the line's speed.
- A section that was slower than it has been goes back to what was fastest.

The coefficients are calibrated on the last laps, and the grip of each section beside them. The cornering limit that
most cars within their covariance reach, over that of the file's car, bounds the shares. The grip of the sections counts
if it predicts a new lap clearly better. If the coefficients predict it clearly better than the model's own, the
calibrated car is planned with them, and what was too close before counts no longer.

Rosolia, Borrelli, "Learning model predictive control for iterative tasks", 2018, without their terminal set.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import Any

import numpy as np
import numpy.typing as npt

from dynssm_ros.arrays import Vector
from dynssm_ros.control.prediction_model import stepped
from dynssm_ros.control.reference import Reference
from dynssm_ros.control.settings import HORIZON, Settings
from dynssm_ros.errors import ConfigurationError, RecordingError, UserError
from dynssm_ros.identification.problem.car import prior_std
from dynssm_ros.identification.result.calibration import calibrate
from dynssm_ros.signals.inputs import WINDOW_COLUMNS
from dynssm_ros.signals.recording import Recording, RecordingInfo
from dynssm_ros.track.speed_profile import speed_profile
from dynssm_ros.track.tracks import Track
from dynssm_ros.vehicle import COEFFICIENTS, CarModel, State, Vehicle
from dynssm_ros.vehicle.kinematics import Pose, advance_pose, axle_direction
from dynssm_ros.vehicle.limits import vehicle_limits

SAFE = 0.7
"""Share of the car's accelerations to begin with."""
_STEP = 0.06
_MOST = 1.3  # of what the coefficients allow: racing lines ask for less than the borders do
_CLOSE = 0.75  # half the car's width over the distance from its centre to the border, from which on it is too close
_LITTLE = 0.5  # likewise, below which it is far: the racing line's own is 0.4 to 0.45
_NEARLY = 0.95  # of the bound on its slip, from which on the rear slips too far
_SLOWER = 0.01  # share of a section's best time
_SECTION_HORIZONS = 1.5  # length of a section, in horizons at the line's mean speed
_FEWEST_SECTIONS, _MOST_SECTIONS = 4, 40
_REMEMBERED = 3  # laps that coefficients are calibrated on
_CLEARLY = 0.9  # of the path error, below which other coefficients, or the grip of each section, are believed
_DRAWS, _CAREFUL = 40, 0.1  # cars within the covariance, and the share of them that are allowed to grip less
_PEAK = np.isin(COEFFICIENTS, ("D_f", "D_r"))
_GRIP_STD, _CHANGE = 0.1, 0.02  # of a section's grip before any lap, and to differentiate with


@dataclass(frozen=True)
class LapLog:
    """A lap as it was measured."""

    time: Vector  # of each row (s), (n,); the last is the first of the next lap
    s: Vector  # along the centre line, counted on (m), (n,)
    room: Vector  # from the car's centre to the nearer border (m), (n,)
    caution: Vector  # standard deviation of where the car is at the end of a horizon (m), (n,)
    velocities: Vector  # v_x, v_y, omega as the controller knew them, (n, 3)
    rows: Vector  # with the columns WINDOW_COLUMNS, (n, 7)


@dataclass(frozen=True)
class LearnedLap:
    """What a lap has shown.

    ``margin_used`` is half the car's width over the least room less caution; 1: a wheel may have been on the border.
    The first lap counts without caution, which is only being learned.
    """

    time: float  # of the lap (s)
    shares: Vector  # that it was driven with, (sections,)
    allowed: Vector  # shares that the coefficients allowed, (sections,)
    margin_used: float
    grip: Vector  # of each section over that of these coefficients, (sections,); 1 as long as that is not believed
    vehicle: Vehicle  # with the coefficients, and what was known of them, before the lap
    planned: bool  # whether the controller planned with them

    def to_json(self) -> dict[str, Any]:
        """For programs."""
        return {
            "lap_time_s": self.time,
            "speed_scale": self.shares.tolist(),
            "allowed": self.allowed.tolist(),
            "margin_used": self.margin_used,
            "grip": self.grip.tolist(),
            "coefficients_planned_with": self.planned,
            "coefficients": {
                name: {"nominal": known.nominal, "std": known.std} for name, known in self.vehicle.coefficients.items()
            },
        }


class LapLearner:
    """Chooses the speed along a line lap by lap.

    Args:
        vehicle: as its file describes it.
        track: where.
        reference: the line, at the speed to begin with.
        settings: of the controller.
        car: the physics of its model; effects that depend on more than the rows of a lap are left out here.
        theta: the model's coefficients, ``(17,)``.

    Raises:
        ConfigurationError: the line has a speed of its own.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        track: Track,
        reference: Reference,
        settings: Settings,
        *,
        car: CarModel,
        theta: Vector,
    ) -> None:
        if reference.limits is None or reference.share is None:
            raise ConfigurationError(
                f"line {reference.name} has a speed of its own, which is not learned; expected centre or racing"
            )
        self._limits = reference.limits
        self._line = reference
        self._vehicle = vehicle
        self._car = replace(car, effects=tuple(effect for effect in car.effects if not effect.needs))
        self._theta = theta
        self._N = settings.N
        self._known = vehicle
        self._planned = False
        self._half_width = settings.margin
        self._most_slip = _NEARLY * settings.slip[1] if settings.objective == "tracking" else np.inf
        horizon = HORIZON * settings.scale.time * track.length / reference.lap_time
        sections = int(np.clip(track.length / (_SECTION_HORIZONS * horizon), _FEWEST_SECTIONS, _MOST_SECTIONS))
        self._edges = np.linspace(0.0, track.length, sections + 1)
        self._centres = (self._edges[1:] + self._edges[:-1]) / 2
        self._at = track.project(reference.line.points)[0]  # of the line's points on the track
        self._grip, self._careful_grip = np.ones((2, sections))
        self._is_local = False
        self._safe = reference.share
        self._shares = np.full(sections, self._safe)
        self._ceiling = np.full(sections, np.inf)
        self._best_time, self._best_share = np.full(sections, np.inf), self._shares.copy()
        self._logs: list[LapLog] = []
        self.laps: list[LearnedLap] = []
        self._allowed = self._allowance()

    @property
    def reference(self) -> Reference:
        """The line with the speed for the next lap."""
        share = np.interp(self._at, self._centres, np.minimum(self._shares, self._allowed), period=self._edges[-1])
        return Reference.within(self._line.name, self._line.line, self._limits, share)

    def theta(self, s: Vector) -> Vector:
        """Coefficients of the calibrated car at places of the next lap (m), ``(N, 17)``."""
        return self._known_at(s, self._believed_grip) if self._planned else np.tile(self._theta, (len(s), 1))

    @property
    def _believed_grip(self) -> Vector:
        """Grip of each section that is planned with; 1 as long as what was learned of it has not proved to be better."""
        return self._grip if self._is_local else np.ones_like(self._grip)

    def _known_at(self, s: Vector, grip: Vector) -> Vector:
        """The calibrated coefficients with the grip of the sections, at places (m), ``(N, 17)``."""
        here = np.interp(s, self._centres, grip, period=self._edges[-1])
        return np.asarray(self._known.nominal * np.where(_PEAK, here[:, None], 1.0))

    def learn(self, lap: LapLog) -> None:
        """Takes a lap that was driven with :attr:`reference`."""
        driven = np.minimum(self._shares, self._allowed)
        times, used = self._by_section(lap)
        self.laps.append(
            LearnedLap(
                time=float(lap.time[-1] - lap.time[0]),
                shares=driven,
                allowed=self._allowed,
                margin_used=used.max(),
                grip=self._believed_grip,
                vehicle=self._known,
                planned=self._planned,
            )
        )
        close = used > _CLOSE
        is_new = self._believe(lap)
        if is_new:
            self._ceiling[:] = np.inf  # what was too close was planned with other coefficients
        close |= np.roll(close, -1)  # what leads there
        close |= self._slips(lap) & np.isinf(self._ceiling)  # once: the plan goes as far at a little less speed
        again = driven <= self._best_share  # if still slower, the best owed its time to something else, as to the start
        slower = ~close & ~again & (times > (1 + _SLOWER) * self._best_time)
        better = ~close & (again | (times < self._best_time))
        self._best_time = np.where(better, times, self._best_time)
        self._best_share = np.where(better, driven, self._best_share)
        lower = np.minimum(self._ceiling, driven - _STEP / 2)
        self._ceiling = np.where(close & ~is_new, lower, self._ceiling)
        far = (used < _LITTLE) & (len(self.laps) > 1)  # the first lap counts without caution
        raised = np.clip(np.where(far, 1.0, self._safe), driven + _STEP, driven + 2 * _STEP)
        faster = np.minimum(np.where(close, driven, raised), self._ceiling)
        self._shares = np.where(slower, np.minimum(self._best_share, self._ceiling), faster)
        self._logs = [*self._logs, lap][-_REMEMBERED:]
        self._known = self._calibrated()
        self._grip, self._careful_grip = self._local_grip()
        self._allowed = self._allowance()

    def _believe(self, lap: LapLog) -> bool:
        """Chooses what to plan with, by how well it predicts a lap that it had no part in. Returns whether that is the
        calibrated coefficients for the first time, or again.
        """
        if not self._logs:
            return False
        planned = self._planned
        own = self._path_error(lambda s: self._theta, lap)
        same = self._path_error(lambda s: self._known.nominal, lap)
        local = self._path_error(lambda s: self._known_at(s, self._grip), lap)
        self._is_local = _better(local, same, self._is_local)
        self._planned = _better(local if self._is_local else same, own, planned)
        return self._planned and not planned

    def _slips(self, lap: LapLog) -> npt.NDArray[np.bool_]:
        """In which sections the rear slipped nearly as far as it may."""
        far = np.abs(axle_direction(np, -self._vehicle.constants.l_r, *lap.velocities.T)) > self._most_slip
        return np.isin(np.arange(len(self._shares)), self._section(lap.s[far]))

    def _by_section(self, lap: LapLog) -> tuple[Vector, Vector]:
        """Time in each section (s), and the margin used there at most."""
        s = np.maximum.accumulate(lap.s - lap.s[0])
        first = lap.s[0] % self._edges[-1]
        marks = np.interp((self._edges - first) % self._edges[-1], s, lap.time)
        around = lap.time[-1] - lap.time[0]
        times = np.diff(marks) % around
        room = lap.room - (lap.caution if self.laps else 0.0)
        used = np.zeros(len(times))
        np.maximum.at(used, self._section(lap.s), self._half_width / np.maximum(room, 1e-9))
        return times, used

    def _calibrated(self) -> Vehicle:
        """The file's car with the coefficients of the laps so far; what was known before, where they cannot be calibrated."""
        rows = np.concatenate([log.rows[:-1] for log in self._logs])
        T_s = self._vehicle.sampling_time
        info = RecordingInfo(sampling_time=T_s, commands="topics", source=("laps",))
        stamps = np.round(np.arange(len(rows)) * T_s * 1e9).astype(np.int64)
        columns = dict(zip(WINDOW_COLUMNS, rows.T, strict=True))
        recording = Recording(info, stamps, np.zeros(len(rows), dtype=np.int32), columns)
        try:
            return calibrate(recording, self._vehicle, integrator=self._car.integrator, starts=1).vehicle
        except (RecordingError, ConfigurationError):
            return self._known

    def _path_error(self, theta: Callable[[Vector], Vector], lap: LapLog) -> float:
        """RMS distance (m) between predicted and measured paths at the end of a horizon, both from their velocities."""
        starts = np.arange(0, len(lap.rows) - self._N - 1, max(1, self._N // 4))
        rows = lap.rows[starts]
        predicted = measured = Pose(*np.zeros((3, len(starts))))
        for k in range(self._N):
            following = stepped(self._car, rows, theta(lap.s[starts + k]))
            now, seen = lap.rows[starts + k], lap.rows[starts + k + 1]
            predicted = _moved(predicted, rows, following, self._car.T_s)
            measured = _moved(measured, now, seen, self._car.T_s)
            rows = np.concatenate([following, seen[:, 3:]], axis=1)
        return float(np.sqrt(np.mean((predicted.x - measured.x) ** 2 + (predicted.y - measured.y) ** 2)))

    def _allowance(self) -> Vector:
        """Largest share of each section, by what is known of the coefficients."""
        lateral = np.array([np.interp(self._limits.speed, *each) for each in self._possible_limits()])
        careful = np.quantile(lateral, _CAREFUL, axis=0) / self._limits.lateral
        speed = speed_profile(self._line.line, self._limits)
        at_points = np.interp(speed, self._limits.speed, careful)
        section = self._section(self._at)
        least = np.full(len(self._shares), np.inf)
        np.minimum.at(least, section, at_points)
        local = self._careful_grip if self._is_local else 1.0
        return _MOST * local * np.where(np.isfinite(least), least, careful.min())

    def _local_grip(self) -> tuple[Vector, Vector]:
        """Grip of each section over that of the known coefficients: the likely one, and one that nine of ten reach.

        Least squares of the one-step errors of v_y and omega on what more grip of all tyres would change, with a prior of 1.
        """
        total, along = np.zeros((2, len(self._shares)))
        theta = self._known.nominal
        more, less = (np.where(_PEAK, (1 + change) * theta, theta) for change in (_CHANGE, -_CHANGE))
        for log in self._logs:
            rows = log.rows[:-1]
            error = (log.rows[1:, :3] - stepped(self._car, rows, theta))[:, 1:]
            answer = (stepped(self._car, rows, more) - stepped(self._car, rows, less))[:, 1:] / (2 * _CHANGE)
            weight = 1.0 / np.maximum(np.mean(error**2, axis=0), 1e-12)
            section = self._section(log.s[:-1])
            np.add.at(total, section, (answer**2 * weight).sum(axis=1))
            np.add.at(along, section, (answer * error * weight).sum(axis=1))
        precision = total + _GRIP_STD**-2
        grip = 1.0 + along / precision
        return grip, grip - NormalDist().inv_cdf(1.0 - _CAREFUL) * precision**-0.5

    def _section(self, s: Vector) -> npt.NDArray[np.intp]:
        """In which section places (m) are."""
        found = np.searchsorted(self._edges, s % self._edges[-1], "right") - 1
        return np.asarray(found.clip(0, len(self._shares) - 1))

    def _possible_limits(self) -> Sequence[tuple[Vector, Vector]]:
        """Speeds and cornering limits of cars within the covariance of the coefficients; the known car's first."""
        known, rng = self._known, np.random.default_rng(0)
        std = prior_std(known)
        covariance = std[:, None] * known.known_correlation * std
        drawn = rng.multivariate_normal(known.nominal, covariance, _DRAWS, method="eigh")
        found = []
        for theta in (known.nominal, *np.clip(drawn, known.lower, known.upper)):
            try:
                limits = vehicle_limits(known.with_nominal(theta))
            except UserError:
                continue  # no car that drives
            found.append((limits.speed, limits.lateral))
        return found


def _better(error: float, other: float, is_believed: bool) -> bool:
    """Whether what errs by the first is believed: only if it is clearly better, and from then on till it is clearly worse."""
    return _CLEARLY * error < other if is_believed else error < _CLEARLY * other


def _moved(pose: Pose, before: Vector, after: Vector, T_s: float) -> Pose:
    """Poses one step of T_s (s) on, by the velocities of the rows before and after it."""
    return advance_pose(np, pose, State(*before[:, :3].T), State(*after[:, :3].T), T_s)
