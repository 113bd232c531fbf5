"""The whole diagnosis: show, name, extend, measure."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from dynssm_ros.diagnosis.candidates import candidates
from dynssm_ros.diagnosis.car import Car, knowledge
from dynssm_ros.diagnosis.gain import Gain, measure
from dynssm_ros.diagnosis.place import driven_line, lap_context, lap_number
from dynssm_ros.diagnosis.selection import Refined, Search, Selection
from dynssm_ros.diagnosis.study import Fit, Study, unit
from dynssm_ros.diagnosis.systematic import Systematic, systematic
from dynssm_ros.diagnosis.windows import WARM_UP, Track, Windows
from dynssm_ros.errors import ConfigurationError, RecordingError
from dynssm_ros.evaluation.metrics import CHANNELS
from dynssm_ros.evaluation.open_loop import default_min_speed
from dynssm_ros.signals.recording import Recording
from dynssm_ros.simulation.lines import ClosedLine
from dynssm_ros.vehicle import Vehicle
from dynssm_ros.vehicle.effects import EFFECTS, require_context
from dynssm_ros.vehicle.single_track import Integrator

Vector = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]
Verdict = Literal["effects", "none", "unexplained"]
Say = Callable[[str], None]

_HORIZON = 0.5  # s
_HOLDOUT = 0.25
_MOST = 1500  # windows in the fit
_LEAST = 24  # windows with which a fit can begin
_LEAST_LAPS = 3  # with which whole laps are held out
_CLEARLY = 20.0  # difference of twice the log-likelihood for which another integrator is taken than Runge-Kutta
_GIVEN, _RECALIBRATED, _EXTENDED = "as given", "recalibrated", "extended"


@dataclass(frozen=True)
class Cause:
    """An effect that the data ask for.

    Attributes:
        effect: its name.
        values: parameters with which it acts.
        std: standard deviations of those that were fitted.
        gain: decrease of twice the negative log-likelihood by it.
        delta_bic: what is left when its parameters are paid for.
        heldout_gain: share of the error on the held-out rows that is gone by it.
        alternatives: effects that explain the data as well.
    """

    effect: str
    values: dict[str, float]
    std: dict[str, float]
    gain: float
    delta_bic: float
    heldout_gain: float
    alternatives: tuple[str, ...]


@dataclass(frozen=True)
class Diagnosis:
    """What the simulation gets wrong, and why.

    Attributes:
        verdict: ``effects``: causes are named; ``none``: right within noise; ``unexplained``: wrong, and nothing of the
            library says why.
        causes: the strongest first.
        vehicle: the vehicle with effects and refitted nominal values.
        gain: on the held-out rows.
        before: systematic part of the errors of the car as given, ``after`` of the extended one, both on the rows of
            the fit.
        selection: how it was found.
        car: the extended car as fitted.
        std: standard deviations of the 17 coefficients and of the mass, relative to what was known of them.
        notes: what limits the diagnosis.
        protocol: how it was obtained, by name.
        windows: of the fit.
    """

    verdict: Verdict
    causes: tuple[Cause, ...]
    vehicle: Vehicle
    gain: Gain
    before: Systematic
    after: Systematic
    selection: Selection
    car: Car
    std: Vector
    notes: tuple[str, ...]
    protocol: Mapping[str, str]
    windows: Windows

    def to_json(self, vehicle_path: str) -> dict[str, Any]:
        """For programs; ``vehicle_path`` is where the extended vehicle was written."""
        at = self.gain.horizon
        rmse = {name: by_channel(values[at]) for name, values in self.gain.rmse.items()}
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
                    "evidence": {"delta_bic": cause.delta_bic, "heldout_gain": cause.heldout_gain},
                    "alternatives": list(cause.alternatives),
                }
                for cause in self.causes
            ],
            "gain": {
                "horizon_s": float(self.gain.horizons[at]),
                "before": rmse[_GIVEN],
                "recalibrated": rmse[_RECALIBRATED],
                "after": rmse[_EXTENDED],
                "reduction": by_channel(self.gain.reduction[at]),
                "interval_95": {
                    channel: [float(low), float(high)]
                    for channel, low, high in zip(CHANNELS, *self.gain.interval[:, at], strict=True)
                },
            },
            "systematic": {"before": by_channel(self.before.share), "after": by_channel(self.after.share)},
            "notes": list(self.notes),
            "vehicle": vehicle_path,
        }


def by_channel(values: Vector) -> dict[str, float]:
    """Values of the three channels by name."""
    return {channel: float(value) for channel, value in zip(CHANNELS, values, strict=True)}


def diagnose(
    recording: Recording,
    vehicle: Vehicle,
    horizon: float = _HORIZON,
    holdout: float = _HOLDOUT,
    min_speed: float | None = None,
    integrator: Integrator | None = None,
    line: ClosedLine | None = None,
    say: Say = lambda words: None,
) -> Diagnosis:
    """Finds out what a vehicle file gets wrong about a recording.

    Args:
        recording: measured laps of one car.
        vehicle: the nominal car. How well its coefficients are known decides whether one that has to move is a cause.
        horizon: time that is simulated from a measured state on (s).
        holdout: share of the recording, at its end, that neither fit nor selection sees; whole laps if there are three.
        min_speed: stretches below are left out (m/s); ``None``: :func:`default_min_speed`.
        integrator: of the simulation; ``None``: Runge-Kutta, unless Euler steps are clearly closer to the data.
        line: of the track, from which positions on the lap are counted; ``None``: the first full lap of the recording.
        say: told what is being done.

    Raises:
        RecordingError: another sampling time than the vehicle's, a constant or missing channel, too few rows.
        ConfigurationError: an effect of the vehicle needs a signal that the recording has not; options out of range.
    """
    at = _prepare(recording, vehicle, horizon, holdout, min_speed, integrator, line, say)
    found, impossible = candidates(at.study, at.car)
    search = Search(at.study, at.car, found, say)
    selection = search.run()
    limits = [f"{name} cannot be judged: {why}" for name, why in impossible.items()]
    blind = [name for name in {c.effect: None for c in found} if name not in selection.tried]
    if blind:
        limits.append(f"no excitation: {', '.join(blind)} would change nothing that was measured")
    say("measuring the gain on held-out laps")
    steps, fit = at.study.windows.steps, selection.fit
    gain = measure(at.unseen, {_GIVEN: at.car, _RECALIBRATED: selection.base.car, _EXTENDED: fit.car}, steps)
    std = np.sqrt(np.diag(at.study.covariance(fit)[0]))
    causes = tuple(_cause(one, selection, search, at.unseen, steps, std) for one in selection.chosen)
    before, after = (
        systematic(at.study.windows, errors.reshape(-1, steps, 3), at.study.block)
        for errors in (at.study.errors(at.car), fit.errors)
    )
    return Diagnosis(
        "effects" if causes else "unexplained" if after.is_there else "none",
        causes,
        fit.car.extended(np.minimum(std[:17], 1.0) * knowledge(vehicle)),
        gain,
        before,
        after,
        selection,
        fit.car,
        std[:18],
        (*at.notes, *limits),
        at.protocol,
        at.study.windows,
    )


class _Prepared(NamedTuple):
    """What a diagnosis works on."""

    study: Study
    unseen: Windows
    car: Car
    notes: list[str]
    protocol: dict[str, str]


def _prepare(
    recording: Recording,
    vehicle: Vehicle,
    horizon: float,
    holdout: float,
    min_speed: float | None,
    integrator: Integrator | None,
    line: ClosedLine | None,
    say: Say,
) -> _Prepared:
    """Checks what was given, holds laps out and lays the simulations along the rest; see :func:`diagnose`."""
    if not 0.05 <= holdout <= 0.8:
        raise ConfigurationError(f"holdout {holdout:g}: expected a share between 0.05 and 0.8")
    recording.require_sampling_time(vehicle.sampling_time, f"vehicle {vehicle.name}")
    steps = int(np.ceil(horizon / recording.T_s - 1e-9))
    if steps < 2:
        raise ConfigurationError(
            f"horizon {horizon:g} s: expected at least two sampling times ({2 * recording.T_s:g} s)"
        )
    notes = _check_signals(recording)
    speed = default_min_speed(recording) if min_speed is None else min_speed
    cut, split = _cut(recording, holdout)
    line = driven_line(recording.select(slice(None, cut))) if line is None else line
    if line is None:
        notes.append("no full lap with positions: effects that live at a place of the track cannot be judged")
    context = lap_context(recording, line)
    source = ", ".join(recording.info.source)
    require_context(vehicle.active_effects, context, f"recording {source}")
    track = Track(recording.matrix.T, context, recording.T_s, (recording.time - recording.time[0]) / 1e9)
    fitted, unseen = _windows(recording, track, steps, speed, cut)
    car = Car.of(vehicle)
    fitted = fitted.stepping(integrator or _integrator(fitted, car, say), vehicle)
    protocol = {
        "Recording": source,
        "Commands": recording.info.commands,
        "Vehicle": vehicle.name,
        "Held out": split,
        "Fit": f"{len(fitted)} simulations of {steps * recording.T_s:g} s, from {speed:g} m/s, {fitted.integrator}",
        "Measured on": f"{len(unseen)} simulations of up to {unseen.steps * recording.T_s:g} s",
    }
    unseen = replace(unseen, integrator=fitted.integrator, substeps=fitted.substeps)
    return _Prepared(Study(fitted, car), unseen, car, notes, protocol)


def _cause(one: Refined, selection: Selection, search: Search, unseen: Windows, steps: int, std: Vector) -> Cause:
    effect, fit = one.candidate.effect, selection.fit
    known = {
        name: float(std[18 + k]) * unit(effect, name) for k, (owner, name) in enumerate(fit.free) if owner == effect
    }
    other = search.leave_out(selection, one).car
    errors = [unseen.errors(car)[:, steps - 1] for car in (other, fit.car)]
    without, with_it = ((e**2).mean(axis=0) for e in errors)
    return Cause(
        effect,
        dict(fit.car.effects[effect]),
        known,
        one.gain,
        float(one.delta_bic),
        float(1.0 - np.sqrt((with_it / np.maximum(without, 1e-300)).mean())),
        tuple(selection.alternatives[effect]),
    )


def _check_signals(recording: Recording) -> list[str]:
    where = f"recording {', '.join(recording.info.source)}"
    for name in CHANNELS:
        if np.ptp(recording[name]) == 0:
            raise RecordingError(f"{where}: {name} is constant at {recording[name][0]:g}; expected a measured channel")
    notes = []
    for name, feedback, command in (("throttle", "r_fb", "r_cmd"), ("steering", "delta_fb", "delta_cmd")):
        if np.ptp(recording[feedback] + recording[command]) == 0:
            notes.append(f"{name} is constant: effects that need it to change cannot be judged")
    return notes


def _cut(recording: Recording, holdout: float) -> tuple[int, str]:
    """First held-out row, and in words."""
    N = len(recording)
    line = driven_line(recording)
    lap = lap_number(recording, line)
    if lap is not None:
        # laps are counted from the first row's place, so that the last full ones are held out
        total = int(lap[-1] - lap[0])
        held = max(1, round(holdout * total))
        if total >= _LEAST_LAPS:
            cut = int(np.argmax(lap >= lap[-1] - held))
            if 0 < cut < N:
                return cut, f"the last {held} of {total} laps and what follows"
    cut = N - max(1, round(holdout * N))
    return cut, f"the last {100 * holdout:.0f} % as one block (fewer than {_LEAST_LAPS} laps)"


def _windows(recording: Recording, track: Track, steps: int, min_speed: float, cut: int) -> tuple[Windows, Windows]:
    """Simulations for the fit, end to end before ``cut``, and for measuring, overlapping behind it."""
    warm = round(WARM_UP / recording.T_s)
    ends = recording.window_ends(warm + 1, horizon=steps, min_speed=min_speed)
    usable = ends[ends + steps < cut]
    starts: list[int] = []
    for row in usable:
        if not starts or row >= starts[-1] + steps:
            starts.append(int(row))
    if len(starts) < _LEAST:
        raise RecordingError(
            f"recording {', '.join(recording.info.source)}: {len(starts)} stretches of {steps * recording.T_s:g} s at "
            f"{min_speed:g} m/s or more beside the held-out part; expected at least {_LEAST}"
        )
    chosen = np.array(starts)[:: -(-len(starts) // _MOST)]
    long = 2 * steps
    ends = recording.window_ends(warm + 1, horizon=long, min_speed=min_speed)
    later = ends[ends - warm >= cut]
    if len(later) < _LEAST:
        raise RecordingError(
            f"recording {', '.join(recording.info.source)}: {len(later)} rows in the held-out part from which "
            f"{long * recording.T_s:g} s can be simulated; expected at least {_LEAST}: record longer or hold out more"
        )
    every = max(1, steps // 4, len(later) // (2 * _MOST))
    return Windows(track, chosen, steps, warm), Windows(track, later[::every], long, warm)


def _integrator(windows: Windows, car: Car, say: Say) -> Integrator:
    """Runge-Kutta, unless the data were clearly made by Euler steps."""
    say("choosing the integrator")
    some = windows.select(np.arange(0, len(windows), -(-len(windows) // 300)))
    fits: dict[Integrator, Fit] = {}
    for name in ("rk4", "euler"):
        study = Study(some.stepping(name, car.vehicle), car)
        fits[name] = study.fit(car, (), rounds=2)
    return "euler" if fits["euler"].objective < fits["rk4"].objective - _CLEARLY else "rk4"
