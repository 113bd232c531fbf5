"""Short simulations along a recording: each starts at a measured row and runs free from there.

The effects' own states are led along the measured rows before the start, so that a lag is where it was.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from dynssm_ros.arrays import Indices, Mask, Vector
from dynssm_ros.errors import RecordingError
from dynssm_ros.identification import tuning
from dynssm_ros.identification.problem.car import CarBatch, CarEstimate
from dynssm_ros.identification.problem.compiled_simulation import simulate
from dynssm_ros.signals.inputs import applied_inputs
from dynssm_ros.signals.recording import Recording
from dynssm_ros.signals.signal_map import Hold
from dynssm_ros.vehicle import Applied, CarModel, Coefficients, State, Vehicle
from dynssm_ros.vehicle.effects.step_errors import StepErrors
from dynssm_ros.vehicle.integrators import Integrator
from dynssm_ros.vehicle.single_track import StageEffect, settling_rate


@dataclass(frozen=True)
class RecordedRows:
    """The rows of a recording as the simulations read them.

    Attributes:
        rows: model inputs, shape ``(7, N)``.
        context: other signals by name, each of shape ``(N,)``.
        T_s: sampling time (s).
        time: of each row since the first (s), shape ``(N,)``.
        number: of the recording that each row is of, shape ``(N,)``.
        rows_per_sample: of throttle and steering: that many rows show a sample before the next one comes.
        v_y_variance: of ``v_y`` as stated by what estimated it ((m/s)^2); 0 where it is measured.
    """

    rows: Vector
    context: dict[str, Vector]
    T_s: float
    time: Vector
    number: Indices
    rows_per_sample: tuple[int, int] = (1, 1)
    v_y_variance: float = 0.0

    @property
    def on_one_lap(self) -> bool:
        """Whether all places are those of one lap: recordings of another road have the same place elsewhere."""
        return "s" in self.context and bool(np.ptp(self.context["lap_length"]) == 0.0)

    @cached_property
    def _cut(self) -> Mask:
        """Where a row is not the one a sampling time after the row before, or of another recording, ``(N - 1,)``."""
        return np.asarray((np.diff(self.time) > 1.5 * self.T_s) | (np.diff(self.number) != 0))

    def told_by(self, effect: StageEffect) -> dict[str, Vector]:
        """What the drive until each row tells of the effect's own states; nothing of it is told across a gap."""
        parts = [effect.before(part) for part in np.split(self.rows, np.flatnonzero(self._cut) + 1, axis=1)]
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}

    @cached_property
    def applied(self) -> Vector:
        """Applied throttle and steering, shape ``(2, N)``."""
        return np.array(applied_inputs(self.rows), dtype=np.float64)

    @cached_property
    def lines(self) -> Vector:
        """Applied throttle and steering if they move in lines from one sample to the next, shape ``(2, N)``.

        Rows that hold a sample tell when it was taken only where they change: a line begins as long before as samples are
        apart, and after the last change.
        """
        cut = self._cut
        rows, lines = np.arange(len(self.time)), self.applied.copy()
        for held, apart in zip(lines, self.rows_per_sample, strict=True):
            ends = np.flatnonzero((np.diff(held) != 0) | cut) + 1
            if len(ends):
                begins = np.maximum(ends - np.where(cut[ends - 1], 1, apart), np.concatenate([[0], ends[:-1]]))
                at, values = np.stack([begins, ends], axis=1), np.stack([held[ends - 1], held[ends]], axis=1)
                held[:] = np.interp(rows, at.ravel(), values.ravel())
        return lines

    @cached_property
    def lines_between(self) -> Vector:
        """What :attr:`lines` are from a row to the next on average, shape ``(2, N)``."""
        return np.asarray((self.lines + np.hstack([self.lines[:, 1:], self.lines[:, -1:]])) / 2)


@dataclass(frozen=True)
class SimulationWindows:
    """``W`` simulations, compared with the measurement at ``K`` rows each.

    Attributes:
        data: what is simulated.
        starts: rows from which the simulations start, shape ``(W,)``; ``warm`` rows before each belong to its stretch.
        steps: sampling times simulated, a multiple of ``every``.
        warm: rows of warm-up.
        integrator: how the model steps.
        substeps: integration steps per sampling time.
        every: compared is every so many rows, so that ``K = steps / every``.
        hold: of the inputs between samples. A line, which a live prediction cannot know, acts half a sample earlier.
        filtered: whether a simulation is led up to its start by the rows before as an observer is, and not put on the
            measured row. The noise of a row would otherwise be seen in what the car does next, and effects that answer
            to it, such as a relaxing tyre, be taken for smaller than they are.
    """

    data: RecordedRows = field(repr=False)
    starts: Indices
    steps: int
    warm: int
    integrator: Integrator = "rk4"
    substeps: int = 1
    every: int = 1
    filtered: bool = False
    hold: Hold = "zero"

    def __len__(self) -> int:
        return len(self.starts)

    def select(self, chosen: Indices | Mask | slice) -> SimulationWindows:
        """Some of the simulations."""
        return replace(self, starts=self.starts[chosen])

    def blocks(self) -> list[slice]:
        """All of them, so many at a time as are stepped together."""
        return [slice(first, first + tuning.AT_ONCE) for first in range(0, len(self), tuning.AT_ONCE)]

    def with_integrator(self, integrator: Integrator, vehicle: Vehicle) -> SimulationWindows:
        """The same in Euler steps of the sampling time, or in Runge-Kutta steps that are short for :func:`settling_rate`."""
        if integrator == "euler":
            return replace(self, integrator=integrator, substeps=1)
        slow = max(float(np.quantile(np.abs(self.data.rows[0, self.starts]), 0.05)), 0.1)
        rate = settling_rate(Coefficients(*vehicle.nominal), vehicle.constants) / slow
        count = int(np.clip(np.ceil(self.data.T_s * rate / tuning.STEP_LIMIT), 1, tuning.MAX_SUBSTEPS))
        return replace(self, integrator=integrator, substeps=count)

    def stepped_as(self, other: SimulationWindows) -> SimulationWindows:
        """The same simulations in the steps of others."""
        return replace(self, integrator=other.integrator, substeps=other.substeps, hold=other.hold)

    @cached_property
    def target(self) -> Vector:
        """Measured states of the predicted rows, shape ``(W, K, 3)``."""
        at = self.starts[:, None] + np.arange(self.every, self.steps + 1, self.every)
        return np.moveaxis(self.data.rows[:3, at], 0, -1)

    @property
    def driven(self) -> Vector:
        """Mean of each model input along each simulation, shape ``(7, W)``."""
        return np.asarray(self.data.rows[:, self.passed].mean(axis=2))

    @cached_property
    def steered(self) -> float:
        """The largest mean steering angle of a simulation (rad)."""
        return float(np.abs(self.driven[4] + self.driven[6]).max())

    @property
    def passed(self) -> Indices:
        """Rows from which each simulation steps, shape ``(W, steps)``."""
        return self.starts[:, None] + np.arange(self.steps)

    def single_steps(self, rows: Indices) -> SimulationWindows:
        """Steps of one sampling time, each from a measured row ``(M,)``."""
        return replace(self, starts=rows, steps=1, every=1, filtered=False)

    @cached_property
    def time(self) -> Vector:
        """Time of each start (s), shape ``(W,)``."""
        return self.data.time[self.starts]

    @cached_property
    def block(self) -> Indices:
        """Number of the stretch of 3 s in which each starts, ``(W,)``: errors of different ones count as independent."""
        return np.unique((self.time // tuning.BLOCK_S).astype(np.intp), return_inverse=True)[1]

    @property
    def number(self) -> Indices:
        """Number of the recording of each simulation, shape ``(W,)``."""
        return self.data.number[self.starts]

    def context(self, shift: int) -> dict[str, Vector]:
        """The other signals ``shift`` rows after the starts."""
        return {name: values[self.starts + shift] for name, values in self.data.context.items()}

    def errors(self, car: CarEstimate, context: dict[str, float] | None = None) -> Vector:
        """Predicted minus measured states (m/s, m/s, rad/s), shape ``(W, K, 3)``; see :meth:`errors_of`."""
        return np.asarray(self.errors_of([car], context)[0])

    def errors_of(self, cars: Sequence[CarEstimate], context: dict[str, float] | None = None) -> Vector:
        """Predicted minus measured states of ``P`` cars at once, shape ``(P, W, K, 3)``.

        Args:
            cars: what is simulated; they differ in values alone.
            context: values that replace signals of the recording, the same in all rows.
        """
        out = np.empty((len(cars), len(self), self.steps // self.every, 3))
        for block in self.blocks():
            some = self.select(block)
            some._simulate(CarBatch.of(cars, some.number), context, out[:, block])
        limit = tuning.WILD * self.spread
        out -= self.target
        return np.asarray(np.clip(np.nan_to_num(out, copy=False, nan=1e9, posinf=1e9, neginf=-1e9), -limit, limit))

    def _simulate(self, fleet: CarBatch, context: dict[str, float] | None, out: Vector) -> None:
        """Writes the states of the rows that are compared, shape ``(P, W, K, 3)``."""
        car = self._bound(fleet)
        shift = -self.warm if car.effect_states or self.filtered else 0
        taken = 1.0 - np.exp(-self.data.T_s / tuning.OBSERVER_S) if self.filtered else 1.0
        rows, beside, kept = self.data.rows, self._signals(car, context), self.every
        if simulate(
            self._bound, fleet, rows, self._acting, beside,
            out=out, starts=self.starts, begin=shift, every=kept, taken=taken,
        ):  # fmt: skip
            return
        first = self.data.rows[:, self.starts + shift]
        state = State(*first[:3])
        here = self._read(beside, shift)
        effect_states = car.settled(state, Applied(*first[3:5]), fleet.theta, context=here)
        with np.errstate(all="ignore"):
            for k in range(shift, self.steps):
                if k <= 0:
                    measured = self.data.rows[:3, self.starts + k]
                    state = State(*(led + taken * (row - led) for led, row in zip(state, measured, strict=True)))
                applied = Applied(*self._acting[:, self.starts + k])
                state, effect_states = car.step(
                    state, applied, fleet.theta, effect_states, context=self._read(beside, k)
                )
                if k >= 0 and (k + 1) % self.every == 0:
                    for channel, value in enumerate(state):
                        out[:, :, k // self.every, channel] = value

    def transitions(self, car: CarEstimate) -> Vector:
        """Derivatives of each compared row by the one before, along the measured rows, shape ``(W, K, 3, 3)``."""
        single = self.single_steps(self.passed.ravel())
        fleet = CarBatch.of([car], single.number)
        fleet = fleet._replace(effects=tuple(effect for effect in fleet.effects if not effect.carries))

        def stepped(add: Vector) -> Vector:
            moved = self.data.rows.copy()
            moved[:3] += add[:, None]
            there = np.empty((1, len(single), 1, 3))
            replace(single, data=replace(self.data, rows=moved))._simulate(fleet, None, there)
            return there[0, :, 0]

        h = 1e-4 * self.spread
        base = stepped(np.zeros(3))
        out = np.stack([(stepped(add) - base) / add.sum() for add in np.diag(h)], axis=-1)
        steps = np.clip(np.nan_to_num(out), -10.0, 10.0).reshape(len(self), -1, self.every, 3, 3)
        through = steps[:, :, 0]
        for k in range(1, self.every):
            through = steps[:, :, k] @ through
        return np.asarray(through)

    @cached_property
    def spread(self) -> Vector:
        """Standard deviation of the measured states, shape ``(3,)``."""
        return np.asarray(np.maximum(self.target.reshape(-1, 3).std(axis=0), 1e-6))

    @property
    def _acting(self) -> Vector:
        """Throttle and steering from each row to the next, shape ``(2, N)``."""
        return self.data.lines_between if self.hold == "first" else self.data.applied

    def _signals(self, car: CarModel, context: Mapping[str, float] | None) -> dict[str, Any]:
        """The other signals that effects of the car read, by row; ``context`` replaces them."""
        signals = self.data.context
        needs = dict.fromkeys(name for effect in car.effects for name in effect.needs if name in signals)
        told = {name: values for effect in car.effects for name, values in self.data.told_by(effect).items()}
        return told | {name: (context or {}).get(name, signals[name]) for name in needs}

    def _read(self, signals: Mapping[str, Any], k: int) -> dict[str, Any]:
        """Signals by row, ``k`` rows after the starts."""
        return {name: value[self.starts + k] if np.ndim(value) else value for name, value in signals.items()}

    def _bound(self, fleet: CarBatch) -> CarModel:
        return CarModel(
            fleet.constants, self.data.T_s, fleet.effects, self.integrator, self.substeps, set_point=fleet.set_point
        )


def step_errors(windows: SimulationWindows, car: CarEstimate) -> StepErrors:
    """Errors of single steps of a car from the rows that simulations pass, each from the measured row."""
    rows, data = np.unique(windows.passed), windows.data
    errors = windows.single_steps(rows).errors(car)[:, 0]
    context = {name: values[rows] for name, values in data.context.items()}
    return StepErrors(data.rows[:, rows], context, -errors, data.number[rows], data.T_s)


def recorded_rows(recording: Recording, context: dict[str, Vector]) -> RecordedRows:
    """The rows of a single recording with other signals by name."""
    time, number = (recording.time - recording.time[0]) / 1e9, np.zeros(len(recording), dtype=np.intp)
    samples, variance = rows_per_sample(recording), v_y_variance(recording)
    return RecordedRows(recording.matrix.T, context, recording.T_s, time, number, samples, variance)


def v_y_variance(recording: Recording) -> float:
    """Of an estimated ``v_y`` ((m/s)^2), as the recording states it; 0 where it is measured."""
    return recording.info.standard_deviations.get("v_y", 0.0) ** 2


def rows_per_sample(recording: Recording) -> tuple[int, int]:
    """Rows from one sample of the applied first input and steering to the next; see :class:`RecordedRows`."""
    source = "command" if recording.info.commands == "topics" else "feedback"
    throttle, steering = (
        max(1, round(recording.info.held_periods.get(f"{name}_{source}", 0.0) / recording.T_s))
        for name in (recording.info.set_point, "steering")
    )
    return throttle, steering


def steps_of(horizon: float, T_s: float) -> int:
    """Sampling times that cover ``horizon`` (s)."""
    return int(np.ceil(horizon / T_s - 1e-9))


def fit_windows(
    recording: Recording, data: RecordedRows, horizon: float, min_speed: float, held_out: Mask | None = None
) -> SimulationWindows:
    """Simulations for a fit, end to end.

    Args:
        recording: what was measured.
        data: the same, as simulations read it.
        horizon: of each simulation (s), rounded up to rows that are compared.
        min_speed: of all rows (m/s).
        held_out: rows that no simulation may reach, ``(N,)``; ``None``: all may be used.

    Raises:
        RecordingError: too few stretches.
    """
    steps = max(1, steps_of(horizon, recording.T_s))
    every = -(-steps // tuning.COMPARED_ROWS)
    steps = every * -(-steps // every)
    warm = round(tuning.WARM_UP_S / recording.T_s)
    ends = recording.window_ends(warm + 1, horizon=steps, min_speed=min_speed)
    starts: list[int] = []
    for row in ends if held_out is None else ends[~held_out[ends + steps]]:
        if not starts or row >= starts[-1] + steps:
            starts.append(int(row))
    if len(starts) < tuning.MIN_WINDOWS:
        beside = " beside the held-out part" if held_out is not None else ""
        raise RecordingError(
            f"recording {', '.join(recording.info.source)}: {len(starts)} stretches of {steps * recording.T_s:g} s at "
            f"{min_speed:g} m/s or more{beside}; expected at least {tuning.MIN_WINDOWS}"
        )
    spread = _spread_evenly(np.array(starts), data.number)
    return SimulationWindows(data, spread, steps, warm, every=every, filtered=True)


def _spread_evenly(starts: Indices, number: Indices) -> Indices:
    """At most as many starts as a fit takes, evenly spread; a short recording gives all that it has."""
    parts = sorted((starts[number[starts] == k] for k in np.unique(number[starts])), key=len)
    chosen: list[Indices] = []
    for k, part in enumerate(parts):
        share = (tuning.MAX_WINDOWS - sum(map(len, chosen))) // (len(parts) - k)
        chosen.append(part[np.linspace(0, len(part) - 1, min(len(part), share)).round().astype(int)])
    return np.sort(np.concatenate(chosen))


def held_out_windows(
    recording: Recording, data: RecordedRows, *, steps: int, long: int, min_speed: float, held_out: Mask
) -> SimulationWindows:
    """Overlapping simulations of ``long`` steps for measuring, on the rows ``held_out``; ``steps``: of those of the fit.

    Raises:
        RecordingError: too few rows.
    """
    warm = round(tuning.WARM_UP_S / recording.T_s)
    ends = recording.window_ends(warm + 1, horizon=long, min_speed=min_speed)
    later = ends[held_out[ends - warm]]
    if len(later) < tuning.MIN_WINDOWS:
        raise RecordingError(
            f"recording {', '.join(recording.info.source)}: {len(later)} rows in the held-out part from which "
            f"{long * recording.T_s:g} s can be simulated; expected at least {tuning.MIN_WINDOWS}: record longer or hold "
            "out more"
        )
    every = max(1, steps // 4, len(later) // tuning.MEASURED_WINDOWS)
    return SimulationWindows(data, later[::every], long, warm)
