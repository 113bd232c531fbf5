"""The whole diagnosis: show, name, extend, measure."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.errors import ConfigurationError, RecordingError
from dynssm_ros.extras import missing_libraries
from dynssm_ros.identification import tuning
from dynssm_ros.identification.problem.car import CarEstimate
from dynssm_ros.identification.problem.fit import Fit, IdentificationProblem, per_unit
from dynssm_ros.identification.problem.levels import Levels
from dynssm_ros.identification.problem.recordings import CrossValidation, RecordingSet, driven_alike
from dynssm_ros.identification.problem.windows import SimulationWindows, fit_windows, held_out_windows, steps_of
from dynssm_ros.identification.result.diagnosis import Cause, Diagnosis, NotJudged
from dynssm_ros.identification.result.formula import Formula, formulas
from dynssm_ros.identification.result.gate import Gated, Without, gated
from dynssm_ros.identification.result.minimum_effect import minimum_detectable
from dynssm_ros.identification.result.recalibration import MOVABLE, Recalibration, hidden_candidates, recalibration
from dynssm_ros.identification.search.candidates import Candidate
from dynssm_ros.identification.search.integrator import SearchResult, search_causes
from dynssm_ros.identification.search.selection import Refined, Selection
from dynssm_ros.parallel import IN_TURN, Pool
from dynssm_ros.progress import OnProgress
from dynssm_ros.signals.recording import Recording
from dynssm_ros.signals.signal_map import STATE_SIGNALS
from dynssm_ros.track.lines import Line
from dynssm_ros.vehicle import Vehicle
from dynssm_ros.vehicle.effects import EFFECTS, require_context
from dynssm_ros.vehicle.integrators import Integrator

_HELD = {"zero": "held", "first": "a line from sample to sample"}


def diagnose(
    recordings: Recording | Sequence[Recording],
    vehicle: Vehicle,
    *,
    horizon: float = tuning.HORIZONS_S[0],
    holdout: float | None = None,
    min_speed: float | None = None,
    integrator: Integrator | None = None,
    line: Line | None = None,
    on_progress: OnProgress = lambda words: None,
    exclude: Collection[str] = (),
    suspect: Sequence[Recording] = (),
    pool: Pool = IN_TURN,
) -> Diagnosis:
    """Finds out what a vehicle file gets wrong about recordings.

    Args:
        recordings: measured laps of one car.
        vehicle: the nominal car. How well its coefficients are known decides whether one that has to move is a cause.
        horizon: time that is simulated from a measured state on (s).
        holdout: share of each recording, at its end, that neither fit nor selection sees; whole laps if there are three.
            ``None``: what the vehicle file left out of the same recording, else a quarter.
        min_speed: stretches below are left out (m/s); ``None``: the vehicle file's.
        integrator: of the simulation; ``None``: the vehicle's, else Runge-Kutta, unless others are clearly closer.
        line: of the track, from which positions on the lap are counted; ``None``: the first full lap of the recording.
        on_progress: told what is being done.
        exclude: names of effects that are impossible there, such as wind in a hall.
        suspect: recordings of the same car in which something may have changed.
        pool: where candidates are tried; the result is the same.

    Raises:
        RecordingError: another sampling time than the vehicle's, a constant or missing channel, too few rows.
        ConfigurationError: an effect of the vehicle needs a signal that the recording has not; options out of range.
    """
    first = [recordings] if isinstance(recordings, Recording) else list(recordings)
    if unknown := sorted(set(exclude) - set(EFFECTS)):
        raise ConfigurationError(f"exclude {', '.join(unknown)}: no such effect; expected some of {', '.join(EFFECTS)}")
    at = _prepare(first, list(suspect), vehicle, horizon=horizon, holdout=holdout, min_speed=min_speed, line=line)
    found = search_causes(
        at.fitted,
        at.car,
        at.left_out,
        integrator=integrator,
        on_progress=on_progress,
        exclude=exclude,
        levels=_driven_alike(at),
        pool=pool,
    )
    on_progress("measuring the improvement on held-out laps")
    gate = gated(found, at.car, at.unseen.stepped_as(found.problem.windows), at.steps, at.notes)
    return _diagnosis(at, found, gate, vehicle, on_progress)


def _diagnosis(at: _Prepared, found: SearchResult, gate: Gated, vehicle: Vehicle, on_progress: OnProgress) -> Diagnosis:
    """What passed the gate, with the car to write and what limits the diagnosis."""
    problem, windows, selection, fit = found.problem, found.problem.windows, gate.selection, gate.selection.fit
    sizes = minimum_detectable(problem, fit, found.search.found)
    covariance = problem.covariance(fit)
    std = np.sqrt(np.diag(covariance))
    causes = [
        replace(_cause(one, rest, selection, at.recordings, std), nearest=nearest)
        for one, rest, nearest in zip(selection.chosen, gate.without, gate.nearest, strict=True)
    ]
    small = [cause.effect for cause in causes if cause.small]
    off = recalibration(problem, fit, at.car, gate.improvement, small=small)
    if off is not None:
        tried = found.search.found, found.search.responses
        hiding = hidden_candidates(problem, fit, at.car, *tried)
        off = replace(off, candidates=tuple(one for one in hiding if np.isfinite(sizes.get(one.effect, np.inf))))
    live, known = _as_held(problem, fit, covariance, at.car)
    suspects = at.recordings.levels.suspects
    extended = live.extended(known, suspects[-1] if suspects else None)
    extended = extended.model_copy(update={"integrator": windows.integrator})
    extended = extended.calibrated_on(at.recordings.recording.select(~at.recordings.held_out).fingerprints, vehicle)
    extended = extended.with_held_out(at.recordings.shares)
    has_no_name = gate.left.is_there and all(cause.small or cause.nearest for cause in causes)
    terms = _formulas(windows, gate.named, at.left_out, at.notes, on_progress) if has_no_name else ()
    notes = (
        *at.notes,
        *_steps_otherwise(vehicle, windows, fit.car, live),
        *_passed_once(at.left_out, selection.candidates),
        *_not_confirmed(selection.unconfirmed),
        *_moved_together(fit.car),
        *_not_live(extended),
        *_not_written(fit.car, extended),
    )
    return Diagnosis(
        tuple(sorted(causes, key=lambda cause: (cause.small, cause.nearest))),
        _moved(fit.car, off),
        extended,
        gate.improvement,
        gate.left.systematic,
        gate.left.clustered,
        sizes,
        selection,
        fit.car,
        gate.named,
        notes,
        at.protocol | {"Integrator": windows.integrator, "Inputs between samples": _HELD[windows.hold]},
        windows,
        at.recordings,
        terms,
        off,
        tuple(_not_judged(found.impossible, sizes)),
    )


def _formulas(
    windows: SimulationWindows, car: CarEstimate, left_out: CrossValidation, notes: list[str], on_progress: OnProgress
) -> tuple[Formula, ...]:
    """Terms that the car lacks, as far as the library for it is there."""
    if missing := missing_libraries("formula"):
        notes.append(
            f"what is left could be searched for a formula with {', '.join(missing)}: pip install 'dynssm_ros[formula]'"
        )
        return ()
    on_progress("looking for a formula of what is left")
    return formulas(windows, car, left_out)


def _driven_alike(at: _Prepared) -> Levels:
    """The levels with those groups that were driven like the other recordings: others show another side of the car."""
    levels, names, fitted = at.recordings.levels, at.recordings.names, set(np.unique(at.fitted.number).tolist())
    alike = {group: driven_alike(at.fitted, group) for group in levels.groups if fitted & set(group) < fitted}
    tried = tuple(group for group, share in alike.items() if levels.suspects or share >= tuning.ALIKE_SHARE)
    for group, share in alike.items():
        if share < tuning.ALIKE_SHARE:
            others = tuple(k for k in range(len(names)) if k not in group)
            these, those = (" and ".join(names[k] for k in each) for each in (group, others))
            at.notes.append(
                f"{these}: {100 * share:.0f} % driven like the others (speed, steering, throttle), so that what "
                "differs there can hardly be told from what its driving shows"
                + ("" if levels.suspects else "; causes of it alone are not tried")
                + (f", and what is named of {those} alone may be the opposite there" if others in tried else "")
            )
    return replace(levels, groups=tried)


def _moved(car: CarEstimate, off: Recalibration | None = None) -> dict[str, float]:
    """See :attr:`Diagnosis.moved`."""
    named = {one.name for one in off.coefficients} if off is not None else set()
    each = zip(MOVABLE, car.moved, strict=True)
    return {name: float(by) for name, by in each if abs(by) > tuning.SURE_STD or name in named}


def _passed_once(left_out: CrossValidation, chosen: Iterable[Candidate]) -> Iterator[str]:
    """What acts at places that were passed once in these laps: nothing tells the place from the moment."""
    if left_out.has_places_once and not left_out.has_recordings:
        for candidate in chosen:
            if candidate.by_place:
                yield (
                    f"{candidate.effect} was seen in one pass of most places and is confirmed by stretches of "
                    f"{tuning.BLOCK_S:g} s that were left out in turn; it may be of the moment and not of the place, which "
                    "another lap tells"
                )


def _not_confirmed(doubtful: Refined | None) -> Iterator[str]:
    """What would explain most of what is left, if left-out parts of the drive agreed."""
    if doubtful is not None and doubtful.confirmation is not None:
        effect, units = doubtful.candidate.effect, doubtful.confirmation.improvement
        values = ", ".join(f"{name} {value:.3g}" for name, value in doubtful.values.items())
        yield (
            f"{effect} ({values}) would explain most of what is left (information criterion {doubtful.delta_bic:.0f}), but "
            f"not where parts of the drive are left out: there the logarithm of the likelihood changes by "
            f"{', '.join(f'{one:+.0f}' for one in units)}. Nothing of it is kept. What would tell: "
            f"{EFFECTS[effect].MANOEUVRE}"
        )


def _moved_together(car: CarEstimate) -> Iterator[str]:
    """How far coefficients went as a whole, where none did alone: of correlated ones some combinations are known better."""
    shares = car.moved * (car.prior_precision @ car.moved)
    squared = float(shares.sum())
    if not _moved(car) and squared > tuning.MOVED_TOGETHER:
        most = [MOVABLE[k] for k in np.argsort(-shares)[:4] if shares[k] > 0.0]
        yield (
            f"together the coefficients moved by {np.sqrt(squared):.0f} standard deviations, though none by more than "
            f"{tuning.SURE_STD:g} alone: "
            f"{', '.join(most)} most, in a combination that the vehicle file knows better than each of them"
        )


class _Prepared(NamedTuple):
    """What a diagnosis works on."""

    recordings: RecordingSet
    fitted: SimulationWindows
    left_out: CrossValidation
    steps: int
    unseen: SimulationWindows
    car: CarEstimate
    notes: list[str]
    protocol: dict[str, str]


def _prepare(
    recordings: list[Recording],
    suspect: list[Recording],
    vehicle: Vehicle,
    *,
    horizon: float,
    holdout: float | None,
    min_speed: float | None,
    line: Line | None,
) -> _Prepared:
    """Checks what was given, holds laps out and lays the simulations along the rest; see :func:`diagnose`."""
    least, most = tuning.HOLDOUT_RANGE
    share = tuning.HOLDOUT if holdout is None else holdout
    if not least <= share <= most:
        raise ConfigurationError(f"holdout {share:g}: expected a share between {least:g} and {most:g}")
    known = {name: share for name, share in vehicle.held_out.items() if least <= share <= most}
    suspects = tuple(range(len(recordings), len(recordings) + len(suspect)))
    together = RecordingSet.of([*recordings, *suspect], share, line, suspects, known=known if holdout is None else None)
    recording = together.recording
    recording.require_sampling_time(vehicle.sampling_time, f"vehicle {vehicle.name}")
    recording.require_set_point(vehicle.inputs.set_point, f"vehicle {vehicle.name}")
    asked, T_s = steps_of(horizon, recording.T_s), recording.T_s
    if asked < 2:
        raise ConfigurationError(f"horizon {horizon:g} s: expected at least two sampling times ({2 * T_s:g} s)")
    notes = _check_signals(recording)
    if not together.has_places:
        notes.append(
            "no full lap with positions among the fitted rows: effects that live at a place of the track cannot be judged "
            "unless the track is given"
        )
    speed = vehicle.minimum_speed if min_speed is None else min_speed
    data, source = together.rows(), ", ".join(recording.info.source)
    require_context(vehicle.active_effects, data.context, f"recording {source}")
    fitted = fit_windows(recording, data, horizon, speed, together.held_out)
    steps = fitted.steps
    unseen = held_out_windows(recording, data, steps=steps, long=2 * asked, min_speed=speed, held_out=together.held_out)
    protocol = {
        "Recording": source,
        "Commands": recording.info.commands,
        "Vehicle": vehicle.name,
        "Held out": together.split,
        "Fit": f"{len(fitted)} simulations of {steps * T_s:g} s, from {speed:g} m/s",
        "Measured on": f"{len(unseen)} simulations of up to {unseen.steps * T_s:g} s",
    }
    before = vehicle.known_before(recording.fingerprints)
    if before is not vehicle:
        notes.append(
            "the vehicle file was calibrated on these laps, which tell nothing new a second time: its coefficients count as "
            "they were known before"
        )
    car = CarEstimate.of(before).at(vehicle.nominal)
    return _Prepared(together, fitted, together.left_out(fitted.starts), asked, unseen, car, notes, protocol)


def _cause(one: Refined, without: Without, selection: Selection, recordings: RecordingSet, std: Vector) -> Cause:
    effect, fit = one.candidate.effect, selection.fit
    known = {
        name: float(std[18 + k]) * per_unit(effect, name, fit.car.effects[effect][name])
        for k, (owner, name) in enumerate(fit.free)
        if owner == effect
    }
    assert one.confirmation is not None
    return Cause(
        effect,
        dict(fit.car.effects[effect]),
        known,
        float(one.delta_bic),
        without.improvement,
        one.confirmation,
        one.bounded,
        tuple(selection.alternatives[effect]),
        tuple(recordings.names[k] for k in one.candidate.only_in),
        recordings.levels.level(one.candidate.only_in),
        without.errors,
        without.of_given,
    )


def _as_held(
    problem: IdentificationProblem, fit: Fit, covariance: Vector, given: CarEstimate
) -> tuple[CarEstimate, Vector]:
    """The car with the same causes where inputs are held from sample to sample, as live; and the fit's covariance."""
    if problem.windows.hold == "zero":
        return fit.car, covariance
    held = IdentificationProblem(replace(problem.windows, hold="zero"), given.as_known, problem.tempering)
    live = held.fit(fit.car, fit.free)
    return live.car, held.covariance(live)


def _steps_otherwise(
    vehicle: Vehicle, windows: SimulationWindows, car: CarEstimate, live: CarEstimate
) -> Iterator[str]:
    """Where the data ask for other steps than the vehicle file was calibrated for, or than a live prediction can make."""
    if vehicle.integrator not in (None, windows.integrator):
        yield (
            f"the vehicle file was calibrated for {vehicle.integrator} steps, the data are closer to {windows.integrator}; "
            f"calibrate with --integrator {windows.integrator}, else what the steps differ by may be named"
        )
    if windows.hold == "first":
        differ = (
            f"; {effect}: {name} {live.effects[effect][name]:.3g} there, {value:.3g} in a simulation"
            for effect, values in car.effects.items()
            for name, value in values.items()
            if abs(live.effects[effect][name] - value) > tuning.NOTED_CHANGE * abs(value)
        )
        samples = " and ".join(f"{n * windows.data.T_s:g}" for n in dict.fromkeys(windows.data.rows_per_sample))
        yield (
            f"inputs are taken for lines between samples {samples} s apart, as the data ask for; live they are held, and "
            "vehicle.yaml is fitted to that. Record them faster, or take the commands" + "".join(differ)
        )


def _not_judged(impossible: Mapping[str, str], sizes: Mapping[str, float]) -> Iterator[NotJudged]:
    """What cannot be tried, and what these laps cannot show at any size that is possible."""
    yield from (NotJudged(effect, why, "") for effect, why in impossible.items())
    for effect, size in sizes.items():
        if size > EFFECTS[effect].magnitude().span:
            yield NotJudged(effect, "would not be noticed at any possible size", EFFECTS[effect].MANOEUVRE)


def _not_live(vehicle: Vehicle) -> Iterator[str]:
    """What of the extended car a live window does not tell."""
    for effect in vehicle.active_effects:
        if effect.needs:
            yield (
                f"{effect.NAME} reads {', '.join(effect.needs)}: simulate, race, calibrate and diagnose know it; models of "
                "windows do not, so that train leaves it to the online layer"
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
    notes = list[str]()
    first = "throttle" if recording.info.set_point == "throttle" else "speed set-point"
    for name, feedback, command in ((first, "r_fb", "r_cmd"), ("steering", "delta_fb", "delta_cmd")):
        if np.ptp(recording[feedback] + recording[command]) == 0:
            notes.append(f"{name} is constant: effects that need it to change cannot be judged")
    return notes
