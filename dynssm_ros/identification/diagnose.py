"""The whole diagnosis: show, name, extend, measure."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.errors import ConfigurationError, RecordingError
from dynssm_ros.identification.car import CarEstimate
from dynssm_ros.identification.confirmation import Confirmation
from dynssm_ros.identification.improvement import Improvement, measure_improvement
from dynssm_ros.identification.integrator import SearchResult, search_causes
from dynssm_ros.identification.minimum_effect import minimum_detectable
from dynssm_ros.identification.noise import weights
from dynssm_ros.identification.problem import IdentificationProblem, per_unit
from dynssm_ros.identification.recordings import LeftOut, RecordingSet, driven_alike
from dynssm_ros.identification.residuals import ClusteredResiduals, ExplainedVariance, clustered, explained_variance
from dynssm_ros.identification.selection import Refined, Search, Selection
from dynssm_ros.identification.windows import SimulationWindows, compared_every, fit_windows, held_out_windows
from dynssm_ros.progress import OnProgress
from dynssm_ros.signals.recording import Recording
from dynssm_ros.signals.signal_map import STATE_SIGNALS
from dynssm_ros.track.lines import ClosedLine
from dynssm_ros.vehicle import COEFFICIENTS, Vehicle
from dynssm_ros.vehicle.effects import EFFECTS, require_context
from dynssm_ros.vehicle.single_track import Integrator

Verdict = Literal["effects", "none", "unexplained"]

_HORIZON = 0.5  # s
_HOLDOUT = 0.25
_NO_WORSE = 0.01  # of the error on held-out laps, that the car may be worse with a cause than without
_MOVED = 3.0  # standard deviations beyond which recalibration is a finding
_DRIVEN_ALIKE = 0.5  # of a recording, that others must have for causes of it alone
_SMALL = 0.01  # of the error on held-out rows: less is within the structure of the model
_HELD = {"zero": "held", "first": "a line from row to row"}
GIVEN, RECALIBRATED, EXTENDED = "as given", "recalibrated", "extended"


@dataclass(frozen=True)
class Cause:
    """An effect that the data ask for.

    Attributes:
        effect: its name.
        values: parameters with which it acts.
        std: standard deviations of those that were fitted.
        improvement: decrease of twice the negative log-likelihood by it.
        delta_bic: what is left when its parameters are paid for.
        heldout_gain: share of the error on the held-out rows that is gone by it.
        confirmation: what it gains on parts of the fitted rows that were left out.
        on_bound: its parameters that the data push against a bound: they are at least that far off.
        alternatives: effects that explain the data as well.
        only_in: names of the recordings in which it acts; empty: in all.
        without: what the car with all other causes errs on the held-out rows, at the horizon, ``(W, 3)``.
    """

    effect: str
    values: dict[str, float]
    std: dict[str, float]
    improvement: float
    delta_bic: float
    heldout_gain: float
    confirmation: Confirmation
    on_bound: tuple[str, ...]
    alternatives: tuple[str, ...]
    only_in: tuple[str, ...] = ()
    without: Vector = field(default_factory=lambda: np.empty((0, 3)), repr=False)

    @property
    def small(self) -> bool:
        """Whether it hardly matters on held-out laps, however sure it is: no model is right to the last per mille."""
        return self.heldout_gain < _SMALL


@dataclass(frozen=True)
class Diagnosis:
    """What the simulation gets wrong, and why.

    Attributes:
        verdict: ``effects``: causes are named; ``none``: right within noise; ``unexplained``: wrong, and nothing of the
            library says why.
        causes: the strongest first.
        moved: coefficients, and ``m``, that are now more than three of the stated standard deviations off what the vehicle
            file has; by name, how many.
        vehicle: the vehicle with effects and refitted nominal values.
        improvement: on the held-out rows.
        left: what is systematic in the errors of the extended car, on the rows of the fit.
        clustered: how those errors are spread over time.
        minimum_detectable: how far off neutral each effect that is not named would have to be to be named (the unit of its
            first parameter).
        selection: how it was found.
        car: the extended car as fitted.
        std: standard deviations of the 17 coefficients and of the mass, relative to what was known of them.
        notes: what limits the diagnosis.
        protocol: how it was obtained, by name.
        windows: of the fit.
        recordings: what was diagnosed.
    """

    verdict: Verdict
    causes: tuple[Cause, ...]
    moved: Mapping[str, float]
    vehicle: Vehicle
    improvement: Improvement
    left: ExplainedVariance
    clustered: ClusteredResiduals
    minimum_detectable: Mapping[str, float]
    selection: Selection
    car: CarEstimate
    std: Vector
    notes: tuple[str, ...]
    protocol: Mapping[str, str]
    windows: SimulationWindows
    recordings: RecordingSet

    @property
    def recalibrated(self) -> dict[str, tuple[float, float]]:
        """What :attr:`moved` names: as the vehicle file has it, and now."""
        given, now = self.car.vehicle, self.vehicle
        return {
            name: (given.constants.m, now.constants.m)
            if name == "m"
            else (given.coefficients[name].nominal, now.coefficients[name].nominal)
            for name in self.moved
        }

    def to_json(self, vehicle_path: str) -> dict[str, Any]:
        """For programs; ``vehicle_path`` is where the extended vehicle was written."""
        improvement = self.improvement
        at = improvement.horizon
        rmse = {name: by_channel(values[at]) for name, values in improvement.rmse.items()}
        return {
            "verdict": self.verdict,
            "causes": [
                {
                    "effect": cause.effect,
                    "parameters": {
                        name: {
                            "value": value,
                            "std": cause.std.get(name),
                            "unit": EFFECTS[cause.effect].PARAMETERS[name].unit,
                        }
                        for name, value in cause.values.items()
                    },
                    "evidence": {
                        "delta_bic": cause.delta_bic,
                        "heldout_gain": cause.heldout_gain,
                        "left_out": {
                            "gain": cause.confirmation.total,
                            "std": cause.confirmation.std,
                            "units": cause.confirmation.gain.tolist(),
                            "error_gone": by_channel(cause.confirmation.share),
                        },
                    },
                    "on_bound": list(cause.on_bound),
                    "alternatives": list(cause.alternatives),
                    "only_in": list(cause.only_in),
                    "small": cause.small,
                }
                for cause in self.causes
            ],
            "gain": {
                "horizon_s": float(improvement.horizons[at]),
                "before": rmse[GIVEN],
                "recalibrated": rmse[RECALIBRATED],
                "after": rmse[EXTENDED],
                "reduction": by_channel(improvement.reduction[at]),
                "interval_95": _intervals(improvement.interval[:, at]),
                "reduction_from_recalibrated": by_channel(improvement.reduction_from(RECALIBRATED)[at]),
                "interval_95_from_recalibrated": _intervals(improvement.interval_from(RECALIBRATED)[:, at]),
            },
            "systematic": {
                "before": by_channel(improvement.explained_variance[GIVEN][at].share),
                "recalibrated": by_channel(improvement.explained_variance[RECALIBRATED][at].share),
                "after": by_channel(improvement.explained_variance[EXTENDED][at].share),
                "gone": by_channel(improvement.systematic_gone(GIVEN)[at]),
            },
            "noticeable": {
                effect: size if np.isfinite(size) else None for effect, size in self.minimum_detectable.items()
            },
            "moved": {
                name: {"from": was, "to": now, "standard_deviations": self.moved[name]}
                for name, (was, now) in self.recalibrated.items()
            },
            "notes": list(self.notes),
            "vehicle": vehicle_path,
        }


def by_channel(values: Vector) -> dict[str, float | None]:
    """Values of the three channels by name; ``None`` where there is none."""
    return {c: float(value) if np.isfinite(value) else None for c, value in zip(STATE_SIGNALS, values, strict=True)}


def _intervals(bounds: Vector) -> dict[str, list[float]]:
    return {channel: [float(low), float(high)] for channel, low, high in zip(STATE_SIGNALS, *bounds, strict=True)}


def diagnose(
    recordings: Recording | Sequence[Recording],
    vehicle: Vehicle,
    horizon: float = _HORIZON,
    holdout: float = _HOLDOUT,
    min_speed: float | None = None,
    integrator: Integrator | None = None,
    line: ClosedLine | None = None,
    on_progress: OnProgress = lambda words: None,
    exclude: Collection[str] = (),
    suspect: Sequence[Recording] = (),
) -> Diagnosis:
    """Finds out what a vehicle file gets wrong about recordings.

    An effect acts in all recordings, or in one of several and not in the others. With ``suspect`` it acts in all or in
    those: what has changed since the others.

    Args:
        recordings: measured laps of one car.
        vehicle: the nominal car. How well its coefficients are known decides whether one that has to move is a cause.
        horizon: time that is simulated from a measured state on (s).
        holdout: share of each recording, at its end, that neither fit nor selection sees; whole laps if there are three.
        min_speed: stretches below are left out (m/s); ``None``: the vehicle file's.
        integrator: of the simulation; ``None``: Runge-Kutta, unless Euler steps are clearly closer to the data.
        line: of the track, from which positions on the lap are counted; ``None``: the first full lap of the recording.
        on_progress: told what is being done.
        exclude: names of effects that are impossible there, such as wind in a hall.
        suspect: recordings of the same car in which something may have changed.

    Raises:
        RecordingError: another sampling time than the vehicle's, a constant or missing channel, too few rows.
        ConfigurationError: an effect of the vehicle needs a signal that the recording has not; options out of range.
    """
    first = [recordings] if isinstance(recordings, Recording) else list(recordings)
    at = _prepare([*first, *suspect], vehicle, horizon, holdout, min_speed, line)
    suspects = tuple(range(len(first), len(first) + len(suspect)))
    if unknown := sorted(set(exclude) - set(EFFECTS)):
        raise ConfigurationError(f"exclude {', '.join(unknown)}: no such effect; expected some of {', '.join(EFFECTS)}")
    groups = _groups(at, suspects)
    found = search_causes(at.fitted, at.car, at.left_out, integrator, on_progress, exclude, groups)
    problem, windows = found.problem, found.problem.windows
    at = at._replace(unseen=at.unseen.stepped_as(windows))
    on_progress("measuring the improvement on held-out laps")
    selection, improvement = _gated(found, at)
    fit = selection.fit
    sizes = minimum_detectable(problem, fit, found.search.found)
    limits = [f"{name} cannot be judged: {why}" for name, why in found.impossible.items()]
    covariance = problem.covariance(fit)
    extended = fit.car.extended(covariance, suspects[-1] if suspects else None)
    extended = extended.model_copy(update={"integrator": windows.integrator})
    std = np.sqrt(np.diag(covariance))
    if vehicle.integrator not in (None, windows.integrator):
        limits.append(
            f"the vehicle file was calibrated for {vehicle.integrator} steps, the data are closer to {windows.integrator}; "
            f"calibrate with --integrator {windows.integrator}, else what the steps differ by may be named"
        )
    if windows.hold == "first":
        limits.append(
            "the car answers to the inputs half a step earlier than if they were held, so that they are interpolated between "
            "rows; a live prediction cannot, and errs by that: record them faster, or take the commands"
        )
    limits += [*_hidden(sizes), *_not_live(extended), *_not_written(fit.car, extended)]
    causes = tuple(_cause(one, selection, found.search, at, std) for one in selection.chosen)
    left, together = _left(problem, selection)
    return Diagnosis(
        "effects" if causes else "unexplained" if left.is_there or together.is_there else "none",
        causes,
        _moved(fit.car),
        extended,
        improvement,
        left,
        together,
        sizes,
        selection,
        fit.car,
        std[:18],
        (*at.notes, *limits),
        at.protocol | {"Integrator": windows.integrator, "Inputs between rows": _HELD[windows.hold]},
        windows,
        at.recordings,
    )


def _groups(at: _Prepared, suspects: tuple[int, ...]) -> list[tuple[int, ...]]:
    """The groups of recordings that may differ from the others: the suspects, else each that was driven like others."""
    names = at.recordings.names
    single = [(k,) for k in np.unique(at.fitted.number).tolist()]
    if len(single) == 1:
        return []
    alike = {group: driven_alike(at.fitted, group) for group in ([suspects] if suspects else single)}
    for group, share in alike.items():
        if share < _DRIVEN_ALIKE:
            at.notes.append(
                f"{' and '.join(names[k] for k in group)}: {100 * share:.0f} % driven like the others (speed, steering, "
                "throttle), so that what differs there can hardly be told from what its driving shows"
                + ("" if suspects else "; causes of it alone are not tried")
            )
    return [group for group, share in alike.items() if suspects or share >= _DRIVEN_ALIKE]


def _gated(found: SearchResult, at: _Prepared) -> tuple[Selection, Improvement]:
    """A selection of which no cause is worse on held-out rows beside the others, nor all together; and what it gains."""
    selection = found.selection
    while selection.chosen:
        gains = [_held_out_gain(*_held_out_errors(one, selection, found.search, at)) for one in selection.chosen]
        worst = selection.candidates[int(np.argmin(gains))].effect
        strange = [one.candidate.effect for one in selection.chosen if not one.is_met]
        if min(gains) <= -_NO_WORSE:
            at.notes.append(_not_kept(worst))
            selection = found.search.reject(worst)
        elif strange and any(rest.is_there for rest in _left(found.problem, selection)):
            at.notes.append(
                f"{strange[0]} would be on the side of neutral on which no car has it, and leaves errors that come together: "
                "it stands for something else, so that nothing of it is kept"
            )
            selection = found.search.reject(strange[0])
        else:
            break
    cars = {GIVEN: at.car, RECALIBRATED: selection.base.car, EXTENDED: selection.fit.car}
    improvement = measure_improvement(at.unseen, cars, at.steps)
    if selection.chosen and _worse(improvement):
        at.notes.append(_not_kept(", ".join(one.effect for one in selection.candidates)))
        return found.search.dropped(()), improvement.ending_with(RECALIBRATED)
    return selection, improvement


def _left(problem: IdentificationProblem, selection: Selection) -> tuple[ExplainedVariance, ClusteredResiduals]:
    """What the selected car leaves: what is systematic, and what comes together in time."""
    windows, fit = problem.windows, selection.fit
    white = fit.noise.whiten(fit.errors)
    size = weights(white) * (white**2).mean(axis=1)
    size = size / (np.bincount(windows.number, size) / np.bincount(windows.number))[windows.number]
    ends = fit.errors.reshape(len(windows), -1, 3)[:, -1]
    together = clustered(size, windows.time, problem.block, selection.inflation)
    return explained_variance(windows, ends, problem.block), together


def _not_kept(effects: str) -> str:
    return f"{effects} explained the fitted laps but not the held-out ones, so that nothing of it is kept"


def _held_out_errors(one: Refined, selection: Selection, search: Search, at: _Prepared) -> tuple[Vector, Vector]:
    """Errors at the horizon without one of the causes and with all, each ``(W, 3)``."""
    without, with_it = (
        at.unseen.errors(car)[:, at.steps - 1] for car in (search.leave_out(selection, one).car, selection.fit.car)
    )
    return without, with_it


def _held_out_gain(without: Vector, with_it: Vector) -> float:
    """Share of the error that is gone, as a mean of the channels."""
    left = (with_it**2).mean(axis=0) / np.maximum((without**2).mean(axis=0), 1e-300)
    return float(1.0 - np.sqrt(left.mean()))


def _worse(improvement: Improvement) -> bool:
    """Whether the extended car errs more than the recalibrated one, in the geometric mean of the channels.

    Causes that a recalibration would make up for, such as more mass for less drive, change nothing but noise.
    """
    ratio = 1.0 - improvement.reduction_from(RECALIBRATED)[improvement.horizon]
    return bool(np.log(np.maximum(ratio, 1e-300)).mean() > _NO_WORSE)


def _moved(car: CarEstimate) -> dict[str, float]:
    """See :attr:`Diagnosis.moved`."""
    names = (*COEFFICIENTS, "m")
    return {name: float(by) for name, by in zip(names, car.moved, strict=True) if abs(by) > _MOVED}


class _Prepared(NamedTuple):
    """What a diagnosis works on."""

    recordings: RecordingSet
    fitted: SimulationWindows
    left_out: tuple[LeftOut, LeftOut]
    steps: int
    unseen: SimulationWindows
    car: CarEstimate
    notes: list[str]
    protocol: dict[str, str]


def _prepare(
    recordings: Sequence[Recording],
    vehicle: Vehicle,
    horizon: float,
    holdout: float,
    min_speed: float | None,
    line: ClosedLine | None,
) -> _Prepared:
    """Checks what was given, holds laps out and lays the simulations along the rest; see :func:`diagnose`."""
    if not 0.05 <= holdout <= 0.8:
        raise ConfigurationError(f"holdout {holdout:g}: expected a share between 0.05 and 0.8")
    together = RecordingSet.of(recordings, holdout)
    recording = together.recording
    recording.require_sampling_time(vehicle.sampling_time, f"vehicle {vehicle.name}")
    steps = int(np.ceil(horizon / recording.T_s - 1e-9))
    if steps < 2:
        raise ConfigurationError(
            f"horizon {horizon:g} s: expected at least two sampling times ({2 * recording.T_s:g} s)"
        )
    asked = steps
    every = compared_every(steps)
    steps = every * -(-steps // every)
    notes = _check_signals(recording)
    speed = vehicle.minimum_speed if min_speed is None else min_speed
    line = together.fitted_lap() if line is None else line
    if line is None:
        notes.append("no full lap with positions: effects that live at a place of the track cannot be judged")
    data = together.rows(line)
    source = ", ".join(recording.info.source)
    require_context(vehicle.active_effects, data.context, f"recording {source}")
    fitted = fit_windows(recording, data, steps * recording.T_s, speed, together.held_out)
    unseen = held_out_windows(recording, data, steps, 2 * asked, speed, together.held_out)
    protocol = {
        "Recording": source,
        "Commands": recording.info.commands,
        "Vehicle": vehicle.name,
        "Held out": together.split,
        "Fit": f"{len(fitted)} simulations of {steps * recording.T_s:g} s, from {speed:g} m/s",
        "Measured on": f"{len(unseen)} simulations of up to {unseen.steps * recording.T_s:g} s",
    }
    left_out = together.left_out(fitted.starts, line)
    return _Prepared(together, fitted, left_out, asked, unseen, CarEstimate.of(vehicle), notes, protocol)


def _cause(one: Refined, selection: Selection, search: Search, at: _Prepared, std: Vector) -> Cause:
    effect, fit = one.candidate.effect, selection.fit
    known = {
        name: float(std[18 + k]) * per_unit(effect, name, fit.car.effects[effect][name])
        for k, (owner, name) in enumerate(fit.free)
        if owner == effect
    }
    assert one.confirmation is not None
    errors = _held_out_errors(one, selection, search, at)
    return Cause(
        effect,
        dict(fit.car.effects[effect]),
        known,
        one.improvement,
        float(one.delta_bic),
        _held_out_gain(*errors),
        one.confirmation,
        one.bounded,
        tuple(selection.alternatives[effect]),
        tuple(at.recordings.names[k] for k in one.candidate.only_in),
        errors[0],
    )


def _hidden(sizes: Mapping[str, float]) -> Iterator[str]:
    """What these laps cannot show at any size that is possible, and how to drive so that they do."""
    hidden = [effect for effect, size in sizes.items() if size > EFFECTS[effect].magnitude().span]
    if hidden:
        yield (
            f"no excitation: {', '.join(hidden)} would not be noticed at any possible size, because these laps hardly show "
            "it or the nominal values are known too badly; what would show it: "
            + "; ".join(dict.fromkeys(EFFECTS[effect].MANOEUVRE for effect in hidden))
        )


def _not_live(vehicle: Vehicle) -> Iterator[str]:
    """What of the extended car reads signals that a live window has not."""
    for effect in vehicle.active_effects:
        if effect.needs:
            yield (
                f"{effect.NAME} reads {', '.join(effect.needs)}: simulate and diagnose know it, train and the predictor node "
                "do not and say so; take it out of the vehicle file for those"
            )


def _not_written(car: CarEstimate, vehicle: Vehicle) -> Iterator[str]:
    """What was found in some recordings and is not in the vehicle file."""
    written = {entry.name for entry in vehicle.effects}
    if left := [name for name in car.only_in if name not in written]:
        yield f"{', '.join(left)}: not in the vehicle file, because not all recordings have it"


def _check_signals(recording: Recording) -> list[str]:
    where = f"recording {', '.join(recording.info.source)}"
    for name in STATE_SIGNALS:
        if np.ptp(recording[name]) == 0:
            raise RecordingError(f"{where}: {name} is constant at {recording[name][0]:g}; expected a measured channel")
    notes = []
    for name, feedback, command in (("throttle", "r_fb", "r_cmd"), ("steering", "delta_fb", "delta_cmd")):
        if np.ptp(recording[feedback] + recording[command]) == 0:
            notes.append(f"{name} is constant: effects that need it to change cannot be judged")
    return notes
